"""What LeRobot calls its observations, and what its folders hold (lerobot 0.4)."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from export_model.signatures.roles import Role
from tests.commands import export_model, is_refused


def model_of(path: Path, batch: int | str) -> Path:
    """State and camera to six joints, in LeRobot's names."""
    rng = np.random.default_rng(0)
    inputs = [
        helper.make_tensor_value_info("observation.state", TensorProto.FLOAT, [batch, 14]),
        helper.make_tensor_value_info("observation.images.top", TensorProto.FLOAT, [batch, 3, 24, 24]),
    ]
    nodes = [
        helper.make_node("MatMul", ["observation.state", "w"], ["a"]),
        helper.make_node("Flatten", ["observation.images.top"], ["f"], axis=1),
        helper.make_node("MatMul", ["f", "v"], ["b"]),
        helper.make_node("Add", ["a", "b"], ["c"]),
        helper.make_node("Tanh", ["c"], ["action"]),
    ]
    weights = [
        numpy_helper.from_array(rng.standard_normal(shape).astype(np.float32), name)
        for name, shape in (("w", (14, 6)), ("v", (3 * 24 * 24, 6)))
    ]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, [batch, 6])]
    graph = helper.make_graph(nodes, "act", inputs, outputs, weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, path)
    return path


@pytest.mark.parametrize("batch", [1, "batch"])
def test_its_state_and_its_cameras_are_observations(batch: int | str, tmp_path: Path) -> None:
    """``observation.state`` is no memory, which an output of its shape would be given back to."""
    found = export_model("inspect", model_of(tmp_path / "act.onnx", batch), "--json").json["policies"][0]
    assert [(i["source"], i["role"]) for i in found["inputs"]] == [
        ("observation.state", Role.VECTOR),
        ("observation.images.top", Role.VISUAL),
    ]
    assert found["memory"] is None


def test_its_folder_and_its_weights_are_called_what_they_are(tmp_path: Path) -> None:
    header = json.dumps({"w": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}).encode()
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(struct.pack("<Q", len(header)) + header + bytes(4))
    (tmp_path / "config.json").write_text(json.dumps({"type": "act"}))
    is_refused(export_model("inspect", weights), "weights without their network (safetensors)", "torch.onnx.export")
    is_refused(export_model("inspect", tmp_path), "no model found", "a policy of LeRobot", "torch.onnx.export")
