"""Files that were changed at random still get a verdict, or one clear error; the process lives."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from export_model.converters.consumers.unity.checker import check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS
from export_model.signatures.errors import ExportModelError
from tests.commands import ROOT
from tests.conftest import examples
from tests.unity.policies import Draft

OPS = ("Gemm", "MatMul", "Reshape", "LSTM", "Conv", "Split", "Identity", "Constant", "Slice", "Transpose", "Expand", "")
KINDS = ("operands", "op", "results", "attributes", "dims", "data", "dtype", "input", "opset")
NAMES = ("", "nowhere", "obs_0", "version_number", "recurrent_in")


def rich() -> Any:
    """A policy with a memory, a picture and a cut, so that every rule has something to read."""
    draft = Draft()
    draft.inputs["recurrent_in"] = (TensorProto.FLOAT, ["N", 1, 8])
    draft.inputs["obs_1"] = (TensorProto.FLOAT, ["N", 6, 6, 3])
    model = draft.model()
    arrays = {"k": np.ones((2, 3, 3, 3)), "w": np.ones((1, 16, 2)), "r": np.ones((1, 16, 4)), "b": np.ones((1, 32))}
    for name, array in arrays.items():
        model.graph.initializer.append(numpy_helper.from_array(array.astype(np.float32), name))
    model.graph.initializer.append(numpy_helper.from_array(np.array([-1, 32], np.int64), "flat"))
    model.graph.node.extend(
        [
            helper.make_node("Transpose", ["obs_1"], ["nchw"], perm=[0, 3, 1, 2]),
            helper.make_node("Conv", ["nchw", "k"], ["seen"]),
            helper.make_node("Reshape", ["seen", "flat"], ["row"]),
            helper.make_node("Slice", ["recurrent_in"], ["h"], axes=[2], starts=[0], ends=[4]),
            helper.make_node("Slice", ["recurrent_in"], ["c"], axes=[2], starts=[4], ends=[8]),
            helper.make_node("LSTM", ["x", "w", "r", "b", "", "h", "c"], ["all", "h2", "c2"], hidden_size=4),
            helper.make_node("Concat", ["h2", "c2"], ["recurrent_out"], axis=2),
        ]
    )
    model.graph.output.append(helper.make_tensor_value_info("recurrent_out", TensorProto.FLOAT, ["N", 1, 8]))
    return model


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    model = rich()
    graph = model.graph
    for _ in range(draw(st.integers(1, 4))):
        node = graph.node[draw(st.integers(0, len(graph.node) - 1))]
        tensor = graph.initializer[draw(st.integers(0, len(graph.initializer) - 1))]
        dims = graph.input[draw(st.integers(0, len(graph.input) - 1))].type.tensor_type.shape.dim
        kind = draw(
            st.sampled_from(("operands", "op", "results", "attributes", "dims", "data", "dtype", "input", "opset"))
        )
        if kind == "operands":
            count = draw(st.integers(0, 3))
            del node.input[:]
            node.input.extend(draw(st.sampled_from(NAMES)) for _ in range(count))
        elif kind == "op":
            node.op_type = draw(st.sampled_from(OPS))
        elif kind == "results":
            del node.output[:]
        elif kind == "attributes":
            del node.attribute[:]
        elif kind == "dims":
            tensor.dims.append(draw(st.sampled_from((0, -1, 3, 1 << 40))))
        elif kind == "data":
            tensor.raw_data = tensor.raw_data[: draw(st.integers(0, 8))]
        elif kind == "dtype":
            tensor.data_type = draw(st.sampled_from((0, 7, 8, 10, 16, 99)))
        elif kind == "input" and dims:
            dims[draw(st.integers(0, len(dims) - 1))].dim_value = draw(st.sampled_from((0, -5, 7, 1 << 50)))
        elif kind == "opset":
            model.opset_import[0].version = draw(st.sampled_from((-3, 0, 1, 6, 99)))
    return bytes(model.SerializeToString())


@examples(200, derandomize=True, database=None)
@given(data=damaged())
def test_a_damaged_file_gets_a_verdict_or_one_clear_error(tmp_path_factory: Any, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.onnx"
    path.write_bytes(data)
    for consumer in CONSUMERS.values():
        try:
            verdict = check_file(path, consumer)
        except ExportModelError as error:
            assert error.what
        else:
            assert verdict.to_dict()["release"] == consumer.name


def test_the_whole_policy_is_understood(tmp_path: Path) -> None:
    path = tmp_path / "rich.onnx"
    path.write_bytes(rich().SerializeToString())
    for consumer in CONSUMERS.values():
        assert check_file(path, consumer).refused is None


def test_a_negative_length_does_not_abort_the_process(tmp_path: Path) -> None:
    """ONNX's shape inference does: std::clamp with its bounds the wrong way round."""
    draft = Draft(inputs={"obs_0": (TensorProto.FLOAT, ["N", -5])}, opset=11)
    model = draft.model()
    for name, value in (("s", 1), ("e", 4), ("a", 1)):
        model.graph.initializer.append(numpy_helper.from_array(np.array([value], np.int64), name))
    model.graph.node.append(helper.make_node("Slice", ["obs_0", "s", "e", "a"], ["cut"]))
    path = tmp_path / "negative.onnx"
    path.write_bytes(model.SerializeToString())
    command = [sys.executable, "-m", "export_model", "inspect", str(path), "--unity", "all"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode == 1, done.stderr
    assert "not accepted by R22" in done.stdout


@pytest.mark.parametrize(
    ("op", "constants"),
    [
        ("Expand", {"one": np.ones(1, np.float32), "n": np.array([-3])}),
        ("Pad", {"one": np.ones(1, np.float32), "n": np.array([-3, -3])}),
    ],
)
def test_a_length_that_comes_out_negative_does_not_abort_the_process_either(
    op: str, constants: dict[str, np.ndarray], tmp_path: Path
) -> None:
    draft = Draft(inputs={"obs_0": (TensorProto.FLOAT, ["N", 3])}, opset=13)
    model = draft.model()
    for name, value in {**constants, "s": np.array([0]), "e": np.array([2])}.items():
        model.graph.initializer.append(numpy_helper.from_array(value, name))
    model.graph.node.append(helper.make_node(op, list(constants), ["short"]))
    model.graph.node.append(helper.make_node("Slice", ["short", "s", "e"], ["cut"]))
    path = tmp_path / "negative.onnx"
    path.write_bytes(model.SerializeToString())
    command = [sys.executable, "-m", "export_model", "inspect", str(path), "--unity", "all"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", check=False)
    assert done.returncode in (0, 1), done.stderr
