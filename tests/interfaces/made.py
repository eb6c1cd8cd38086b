"""Sources with an interface: an ONNX of a small network, its metadata, the files beside it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

FILES = Path(__file__).parent / "files"
#: What mjlab 1.6.0 wrote of two of its own tasks (rl/exporter_utils.py, run on a processor).
MJLAB = json.loads((FILES / "mjlab-1.6.0.json").read_text())
#: Of the small files: three numbers and two joints.
SEEN, DONE = 5, 2


def write_onnx(path: Path, seen: int = SEEN, done: int = DONE, metadata: Mapping[str, str] | None = None) -> Path:
    """A layer and ELU, from ``obs`` to ``actions``."""
    random = np.random.default_rng(seen)
    weights = [
        numpy_helper.from_array(random.normal(0, 0.5, shape).astype(np.float32), name)
        for name, shape in (("w", (seen, done)), ("b", (done,)))
    ]
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["x"]),
        helper.make_node("Add", ["x", "b"], ["y"]),
        helper.make_node("Elu", ["y"], ["actions"]),
    ]
    ports = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in (("obs", seen), ("actions", done))
    ]
    graph = helper.make_graph(nodes, "policy", ports[:1], ports[1:], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8)
    for key, value in (metadata or {}).items():
        model.metadata_props.add(key=key, value=value)
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, path)
    return path


def mjlab(folder: Path, task: str) -> Path:
    """A policy with what mjlab wrote of one of its tasks."""
    known = MJLAB[task]
    return write_onnx(folder / "policy.onnx", known["observations"], known["actions"], known["metadata"])


def run_with(folder: Path, *files: str, place: str = "params") -> Path:
    """A run's folder: ``exported/policy.onnx``, and files of ours in ``params/``."""
    (folder / place).mkdir(parents=True, exist_ok=True)
    for name in files:
        shutil.copy(FILES / name, folder / place / name)
    return write_onnx(folder / "exported" / "policy.onnx")
