"""Models without an axis for the agents, and models in half precision: read for any number, in float32, and said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from export_model.exporter.reports.summary import failure_lines
from tests.onnx_reader.models import Bench, floats, model, node

F = np.float32


def exported(message: Any, bench: Bench, folder: Path) -> ExportResult:
    """Exported, and equal to the file itself in onnxruntime, row by row."""
    (result,) = export([bench.place(message)], ExportOptions(folder, verify=("onnxruntime",)), pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    return result


AXIS = {"front": np.array([0])}
VECTOR = [
    node("MatMul", ["obs", "w"], "x"),
    node("Add", ["x", "b"], "h"),
    node("Softmax", ["h"], "s", axis=0),
    node("Concat", ["s", "h"], "j", axis=0),
    node("Gather", ["j", "order"], "action"),
]
IMAGE = [
    node("Unsqueeze", ["obs", "front"], "x"),
    node("Conv", ["x", "k"], "c", strides=[3, 3]),
    node("Flatten", ["c"], "f"),
    node("Gemm", ["f", "w"], "g"),
    node("Squeeze", ["g", "front"], "action"),
]
MEMORY = [
    node("Unsqueeze", ["obs", "front"], "o"),
    node("Unsqueeze", ["o", "front"], "x"),
    node("LSTM", ["x", "w", "r", "", "", "h_in", "c_in"], ["y", "h_out", "c_out"], hidden_size=6),
    node("Squeeze", ["y", "all"], "last"),
    node("MatMul", ["last", "v"], "action"),
]


@pytest.mark.parametrize(
    ("nodes", "inputs", "constants", "wanted"),
    [
        (VECTOR, {"obs": (F, [5])}, {"w": floats(5, 3), "b": floats(3), "order": np.array([5, 0, 2])}, (None, 5)),
        (IMAGE, {"obs": (F, [3, 9, 12])}, {**AXIS, "k": floats(4, 3, 3, 3), "w": floats(48, 2)}, (None, 3, 9, 12)),
        (
            MEMORY, {"obs": (F, [5]), "h_in": (F, [1, 1, 6]), "c_in": (F, [1, 1, 6])},
            {**AXIS, "all": np.array([0, 1, 2]), "w": floats(1, 24, 5), "r": floats(1, 24, 6), "v": floats(6, 2)},
            (None, 5),
        ),
    ],
    ids=["vector", "image", "memory"],
)  # fmt: skip
def test_an_axis_for_the_agents_is_added(
    nodes: list[Any], inputs: Any, constants: Any, wanted: tuple[int | None, ...], bench: Bench, tmp_path: Path
) -> None:
    outputs = ["action", "h_out", "c_out"] if nodes is MEMORY else ["action"]
    result = exported(model(nodes, inputs, outputs, constants), bench, tmp_path)
    signature = result.policy.signature
    assert signature.inputs[0].shape == wanted
    assert signature.output("action").shape[0] is None
    assert any("an axis for the agents is added" in note for note in signature.notes)
    assert (signature.memory is not None) == (nodes is MEMORY)


def test_a_model_for_one_row_whose_insides_are_for_one_row_is_computed_row_by_row(bench: Bench, tmp_path: Path) -> None:
    """As clean_c51: [1, 4] in, and an index into the rows that only the first has."""
    nodes = [
        node("MatMul", ["obs", "w"], "x"),
        node("GatherND", ["x", "place"], "best"),
        node("Add", ["x", "best"], "action"),
    ]
    constants = {"w": floats(4, 3), "place": np.array([[0, 2]])}
    result = exported(model(nodes, {"obs": (F, [1, 4])}, {"action": (F, [1, 3])}, constants), bench, tmp_path)
    assert result.policy.signature.inputs[0].shape == (None, 4)


@pytest.mark.parametrize("dims", [[1, 4], [4]])
def test_scores_that_a_mask_hides_are_read_row_by_row(dims: list[int], bench: Bench, tmp_path: Path) -> None:
    """The output's own op is one that has another form in TensorFlow 1.4: it keeps its name all the same."""
    nodes = [
        node("MatMul", ["obs", "w"], "z"),
        node("Greater", ["action_masks", "zero"], "open"),
        node("Where", ["open", "z", "far"], "logits"),
    ]
    constants = {"w": floats(4, 4), "zero": np.float32(0), "far": np.float32(-1e8)}
    message = model(nodes, {"obs": (F, dims), "action_masks": (F, dims)}, {"logits": (F, dims)}, constants)
    signature = exported(message, bench, tmp_path).policy.signature
    assert [s.shape for s in signature.inputs] == [(None, 4)] * 2


def test_frames_of_one_agent_are_not_taken_for_agents(bench: Bench, tmp_path: Path) -> None:
    """[3, 4] in and out, with a mean over the three: rows that know of each other are no agents."""
    nodes = [node("ReduceMean", ["obs"], "m", axes=[0]), node("Add", ["obs", "m"], "action")]
    result = exported(model(nodes, {"obs": (F, [3, 4])}, {"action": (F, [3, 4])}, {}, opset=13), bench, tmp_path)
    assert result.policy.signature.inputs[0].shape == (None, 3, 4)


@pytest.mark.parametrize("kind", [TensorProto.FLOAT16, TensorProto.DOUBLE])
def test_half_and_double_precision_are_computed_in_float32(kind: int, bench: Bench, tmp_path: Path) -> None:
    dtype = helper.tensor_dtype_to_np_dtype(kind)
    constants = {"w": floats(4, 3).astype(dtype), "b": floats(3).astype(dtype)}
    nodes = [node("Gemm", ["obs", "w", "b"], "h"), node("Tanh", ["h"], "t"), node("Cast", ["t"], "action", to=kind)]
    message = model(nodes, {"obs": (dtype, ["batch", 4])}, {"action": (dtype, ["batch", 3])}, constants)
    signature = exported(message, bench, tmp_path).policy.signature
    assert {s.dtype for s in (*signature.inputs, *signature.outputs)} == {"float32"}
    assert any(("half precision" if kind == TensorProto.FLOAT16 else "float64") in note for note in signature.notes)


def test_halves_are_read_as_the_numbers_that_they_are() -> None:
    from export_model.converters.formats.onnx.half_precision import widen

    values = np.array([1.5, -2.25, 65504.0, 6e-8], np.float16)
    message = model([node("Add", ["x", "c"])], {"x": (np.float16, ["batch", 4])}, ("y",), {"c": values})
    loose = message.graph.initializer[0]
    bits = values.view(np.uint16)
    loose.ClearField("raw_data")
    loose.int32_data.extend(bits.tolist())
    brain = helper.make_tensor("b", TensorProto.BFLOAT16, [2], b"\x80\x3f\x00\xc0", raw=True)
    message.graph.initializer.append(brain)
    assert widen(message)
    found = {t.name: numpy_helper.to_array(t) for t in message.graph.initializer}
    np.testing.assert_array_equal(found["c"], values.astype(np.float32))
    np.testing.assert_array_equal(found["b"], np.array([1, -2], np.float32))
    assert not widen(message)
