"""What a few bytes, written again and again, or one long name would make in memory; and names that are no text."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from export_model.converters.files.chunks import Pieces
from export_model.converters.files.file_probe import json_in
from export_model.converters.files.tensorflow_messages import field
from export_model.converters.formats.tfjs.artifact import safe_copy
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import ExportModelError
from tests.fuzz.changes import zipped
from tests.handmade import continuous_policy, graph_bytes
from tests.hostile.zoo import onnx_policy


def inside(number: int, *content: bytes) -> bytes:
    """A field that holds others."""
    return field(number, Pieces(*content)).to_bytes()


def attribute(value: bytes) -> bytes:
    """A graph with a node that has an attribute of this value."""
    node = (inside(1, b"n"), inside(2, b"NoOp"), inside(5, inside(1, b"a"), inside(2, value)))
    return graph_bytes(continuous_policy()) + inside(1, *node)


def attributes(count: int) -> bytes:
    entries = [inside(5, inside(1, b"%d" % i)) for i in range(count)]
    return graph_bytes(continuous_policy()) + inside(1, inside(1, b"n"), inside(2, b"NoOp"), *entries)


def saved(*parts: bytes) -> bytes:
    return b"\x08\x01" + inside(2, inside(2, graph_bytes(continuous_policy())), *parts)


def pickled(key: bytes) -> bytes:
    """A dictionary with one key, as torch.save writes it."""
    return zipped({"archive/data.pkl": b"\x80\x02}" + key + b"K\x01s.", "archive/version": b"3\n"})


def web(name: str) -> bytes:
    nodes = [
        {"name": "obs_0", "op": "Placeholder", "attr": {"dtype": {"type": 1}, "shape": {"shape": {}}}},
        {"name": name, "op": "Tanh", "input": ["obs_0"]},
        {"name": "action", "op": "Identity", "input": [name]},
    ]
    return json.dumps({"format": "graph-model", "modelTopology": {"node": nodes}, "weightsManifest": []}).encode()


#: file's name → content, what the refusal says
FILES: dict[str, tuple[str, Callable[[], bytes], str]] = {
    "ONNX, half a million empty types": (
        "p.onnx", lambda: onnx_policy() + inside(7, inside(13) * ((1 << 19) + 1)), "parts"),
    "ONNX, a shape beyond any array": (
        "p.onnx", lambda: onnx_policy(weights=[TensorProto(name="w", data_type=1, dims=[0, 1 << 62], raw_data=b"")]),
        "its shape"),
    "frozen graph, a list of empty shapes": (
        "p.bytes", lambda: attribute(inside(1, inside(7) * ((1 << 16) + 1))), "a list has"),
    "frozen graph, a shape of empty axes": ("p.bytes", lambda: attribute(inside(7, inside(2) * 255)), "a shape has"),
    "frozen graph, a thousand attributes": ("p.bytes", lambda: attributes(1025), "has 1025 attributes"),
    "SavedModel, empty graphs": ("saved_model.pb", lambda: saved() + inside(2) * 64, "65 graphs"),
    "SavedModel, empty signatures": (
        "saved_model.pb", lambda: saved(*(inside(5, inside(1, b"%d" % i)) for i in range(1025))), "1025 signatures"),
    "PyTorch, a number that Python does not write as text": (
        "p.pt", lambda: pickled(b"\x8b" + struct.pack("<i", 3000) + b"\1" * 3000), "bits"),
    "TensorFlow.js, a name of half a character": ("model.json", lambda: web("a\ud800"), "surrogates"),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_it_is_refused_by_what_it_has_too_much_of(name: str, tmp_path: Path) -> None:
    called, content, said = FILES[name]
    (tmp_path / called).write_bytes(content())
    with pytest.raises(ExportModelError, match=said):
        read_source(tmp_path / called)


def test_lists_in_lists_are_counted_before_they_are_made() -> None:
    with pytest.raises(ValueError, match="more than 4194304 values"):
        json_in(b"[" + b"[]," * (1 << 22) + b"[]]")


def test_a_long_name_is_not_handed_to_every_node_of_a_body(tmp_path: Path) -> None:
    name, count = "n" * 100_000, 200
    nodes = [helper.make_node("Neg", ["obs_0" if not i else f"b{i - 1}"], [f"b{i}"]) for i in range(count)]
    branch = helper.make_graph(nodes, "g", [], [helper.make_tensor_value_info(f"b{count - 1}", 1, None)])
    weights = [numpy_helper.from_array(np.array(True), "c"), numpy_helper.from_array(np.ones((8, 2), np.float32), "w")]
    body = [
        helper.make_node("If", ["c"], [name], then_branch=branch, else_branch=branch),
        helper.make_node("MatMul", [name, "w"], ["continuous_actions"]),
    ]
    ends = [helper.make_tensor_value_info(n, 1, [None, s]) for n, s in (("obs_0", 8), ("continuous_actions", 2))]
    graph = helper.make_graph(body, "g", ends[:1], ends[1:], weights)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8)
    (tmp_path / "p.onnx").write_bytes(made.SerializeToString())
    (model,) = read_source(tmp_path / "p.onnx").models
    assert len(model.graph.nodes) > count
    assert sum(len(n.name) for n in model.graph.nodes) < 2 * count * 1100


def test_a_runtime_gets_no_initialiser_of_a_web_model(tmp_path: Path) -> None:
    model = json.loads(web("a")) | {"modelInitializer": {"node": [{"name": "w", "op": "WriteFile"}]}, "other": 1}
    model["modelTopology"] |= {"more": 1}
    (tmp_path / "model.json").write_text(json.dumps(model))
    (tmp_path / "copy").mkdir()
    copy = json.loads((safe_copy(tmp_path, ["action"], tmp_path / "copy") / "model.json").read_text())
    assert set(copy) == {"format", "modelTopology", "weightsManifest"}
    assert set(copy["modelTopology"]) == {"node"}
