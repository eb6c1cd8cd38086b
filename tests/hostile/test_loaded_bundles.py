"""A stranger's bundle in ``load_policy``, which runs it in the caller's own process."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

pytest.importorskip("onnxruntime")

from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import ExportModelError
from fixtures import path as fixture
from tests.exporting import load_policy

ESCAPE = "\x1b]0;owned\x07"


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    (result,) = export([fixture("continuous")], ExportOptions(tmp_path, ["onnx"], verify="none"))
    return result.folder


def rewritten(bundle: Path, model: onnx.ModelProto) -> None:
    """As a stranger writes it: the contract has the hash of the file that is there."""
    data = model.SerializeToString()
    (bundle / "continuous.onnx").write_bytes(data)
    contract = json.loads((bundle / "policy.json").read_text())
    contract["files"]["continuous.onnx"] = {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}
    (bundle / "policy.json").write_text(json.dumps(contract))


def test_names_of_the_file_reach_no_terminal(bundle: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """onnxruntime prints the name of a node that fails; the shape that does not fit is asked for at the first step."""
    model = onnx.load(bundle / "continuous.onnx")
    (action,) = (o for o in model.graph.output if o.name == "action")
    producer = next(n for n in model.graph.node if "action" in n.output)
    producer.output[list(producer.output).index("action")] = f"inner{ESCAPE}"
    model.graph.initializer.append(helper.make_tensor("wide", TensorProto.FLOAT, [1, 77], [0.0] * 77))
    model.graph.node.append(helper.make_node("Add", [f"inner{ESCAPE}", "wide"], ["action"], name=f"add{ESCAPE}"))
    action.type.tensor_type.shape.dim[1].Clear()
    rewritten(bundle, model)
    with pytest.raises(ExportModelError) as refused:
        policy = load_policy(bundle, runtime="onnxruntime")
        policy.decide(np.zeros((1, *policy.signature.observations[0].shape[1:]), np.float32))
    said = capfd.readouterr()
    assert ESCAPE not in f"{refused.value} {said.out} {said.err}"
    assert "\x1b" not in said.out + said.err


def test_a_loop_is_not_run(bundle: Path) -> None:
    model = onnx.load(bundle / "continuous.onnx")
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["more"]),
            helper.make_node("Identity", ["was"], ["is"]),
        ],
        "body",
        [
            helper.make_tensor_value_info("number", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("was", TensorProto.FLOAT, None),
        ],
        [
            helper.make_tensor_value_info("more", TensorProto.BOOL, []),
            helper.make_tensor_value_info("is", TensorProto.FLOAT, None),
        ],
    )
    producer = next(n for n in model.graph.node if "action" in n.output)
    producer.output[list(producer.output).index("action")] = "before"
    model.graph.initializer.append(helper.make_tensor("yes", TensorProto.BOOL, [], [True]))
    model.graph.node.append(helper.make_node("Loop", ["", "yes", "before"], ["action"], body=body))
    rewritten(bundle, model)
    with pytest.raises(ExportModelError):
        load_policy(bundle, runtime="onnxruntime")


def test_what_grows_without_bounds_is_refused(bundle: Path) -> None:
    """400 bytes that ask for 40 GB."""
    model = onnx.load(bundle / "continuous.onnx")
    producer = next(n for n in model.graph.node if "action" in n.output)
    producer.output[list(producer.output).index("action")] = "before"
    model.graph.initializer.append(helper.make_tensor("lengths", TensorProto.INT64, [2], [100_000, 100_000]))
    model.graph.node.extend(
        [
            helper.make_node("ConstantOfShape", ["lengths"], ["huge"]),
            helper.make_node("ReduceMax", ["huge"], ["most"], keepdims=0),
            helper.make_node("Add", ["before", "most"], ["action"]),
        ]
    )
    rewritten(bundle, model)
    with pytest.raises(ExportModelError):
        load_policy(bundle, runtime="onnxruntime")


def test_a_bundle_of_ours_loads_as_it_is(bundle: Path) -> None:
    policy = load_policy(bundle, runtime="onnxruntime")
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(3, *policy.signature.observations[0].shape[1:])).astype(np.float32)
    first = policy.decide(seen, deterministic=True)
    assert first.continuous is not None and np.isfinite(first.continuous).all()
