"""Web models of TensorFlow.js before 1.0: read by any of their paths, and never as zeros."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.frozen_graph.tensors import to_array
from export_model.converters.formats.tfjs.split_graph import GRAPH, MANIFEST
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError, ExportModelError, SourceError
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_cases
from fixtures import FIXTURES, path
from tests.handmade import constant, graph_bytes, node, placeholder

_NARROW = {"int64": "int32", "float64": "float32", "float16": "float32"}
#: What tensorflowjs 0.8 cleared (tf_saved_model_conversion.py, CLEARED_TENSOR_FIELDS); those that a policy has.
_FIELDS = ("tensor_content", "half_val", "float_val", "double_val", "int_val", "int64_val", "bool_val")


def split(source: Path, folder: Path, *, quantised: bool = False, shards: int = 1) -> Path:
    """Write a frozen graph as tensorflowjs_converter did before 1.0."""
    definition = schema.parse(schema.GraphDef, source.read_bytes(), "graph")
    entries, data = [], b""
    for proto in definition.node:
        if proto.op != "Const" or proto.attr["value"].tensor.string_val:
            continue
        tensor = proto.attr["value"].tensor
        value = to_array(tensor)
        value = value.astype(_NARROW.get(value.dtype.name, value.dtype.name))
        entry: dict[str, Any] = {"name": proto.name, "shape": list(value.shape), "dtype": value.dtype.name}
        if quantised and value.dtype == np.float32 and value.size > 1:
            low, scale = float(value.min()), float(value.max() - value.min()) / 255 or 1.0
            entry["quantization"] = {"min": low, "scale": scale, "dtype": "uint8"}
            value = np.rint((value - low) / scale).astype(np.uint8)
        entries.append(entry)
        data += value.tobytes()
        for field in _FIELDS:
            tensor.ClearField(field)
    folder.mkdir(parents=True)
    size = -(-len(data) // shards)
    names = [f"group1-shard{i + 1}of{shards}" for i in range(shards)]
    for i, name in enumerate(names):
        (folder / name).write_bytes(data[i * size : (i + 1) * size])
    (folder / GRAPH).write_bytes(definition.SerializeToString())
    (folder / MANIFEST).write_text(json.dumps([{"paths": names, "weights": entries}]))
    return folder


@pytest.mark.parametrize("name", FIXTURES)
def test_is_the_frozen_graph_with_its_weights(name: str, tmp_path: Path) -> None:
    folder = split(path(name), tmp_path / name, shards=2)
    for whole, read in zip(read_source(path(name)).policies(), read_source(folder).policies(), strict=True):
        assert read.name == whole.name
        assert read.signature == whole.signature
        names = [s.name for s in whole.signature.outputs if s.role is not Role.SAMPLED]
        case = draw_cases(whole.signature)[0]
        expected, got = (run_graph(p.graph, case.feeds, names) for p in (whole, read))
        for output in names:
            np.testing.assert_array_equal(got[output], expected[output])


@pytest.mark.parametrize("part", ["", GRAPH, MANIFEST, "group1-shard1of1"])
def test_any_path_is_the_model_and_the_original_runs(part: str, tmp_path: Path) -> None:
    folder = split(path("recurrent"), tmp_path / "walker")
    verify = "tensorflow" if not part else "none"
    (result,) = export([folder / part], ExportOptions(tmp_path / "out", targets=("bytes",), verify=verify))
    assert result.policy.name == "walker"
    assert sorted(f.name for f in read_source(folder / part).models[0].files) == ["group1-shard1of1", GRAPH, MANIFEST]
    if not part:
        assert result.report is not None
        assert result.report.passed


def test_a_graph_of_another_name_and_quantised_weights(tmp_path: Path) -> None:
    folder = split(path("continuous"), tmp_path / "web", quantised=True)
    (folder / GRAPH).rename(folder / "web_model.pb")
    (policy,), (whole,) = read_source(folder).policies(), read_source(path("continuous")).policies()
    case = draw_cases(whole.signature)[0]
    expected, got = (run_graph(p.graph, case.feeds, ["action"])["action"] for p in (whole, policy))
    assert np.abs(got - expected).max() < 0.1 < np.abs(expected).max()


@pytest.mark.parametrize("name", FIXTURES)
def test_a_graph_without_its_shards_is_refused(name: str, tmp_path: Path) -> None:
    folder = split(path(name), tmp_path / name)
    (folder / MANIFEST).unlink()
    with pytest.raises(DamagedFileError, match="hold no values"):
        read_source(folder / GRAPH)


def test_half_a_model_says_what_is_missing(tmp_path: Path) -> None:
    folder = split(path("continuous"), tmp_path / "web")
    (folder / GRAPH).rename(tmp_path / "moved.pb")
    for given in (folder, folder / MANIFEST):
        with pytest.raises(SourceError, match=f"{GRAPH} is missing"):
            read_source(given)
    (tmp_path / "moved.pb").rename(folder / GRAPH)
    (folder / "group1-shard1of1").unlink()
    with pytest.raises(SourceError, match="group1-shard1of1"):
        read_source(folder)


@pytest.mark.parametrize(
    "text", ["", "{}", "[1]", "{", "[{}]", '[{"paths": 3}]', '[{"paths": [], "weights": []}]', '[{"paths": []}]']
)
def test_a_damaged_manifest_is_refused(text: str, tmp_path: Path) -> None:
    folder = split(path("continuous"), tmp_path / "web")
    (folder / MANIFEST).write_text(text)
    for given in (folder, folder / GRAPH, folder / MANIFEST):
        with pytest.raises(ExportModelError):
            read_source(given)


def test_zeros_as_tensorflow_writes_them_are_zeros() -> None:
    """Grappler's constant folding writes zeros without a value, of any shape; the other weights have theirs."""
    zeros = constant("bias", np.zeros(2, np.float32))
    weights = constant("weights", np.ones((3, 2), np.float32))
    zeros.attr["value"].tensor.ClearField("tensor_content")
    layers = [node("product", "MatMul", "x", "weights"), node("action", "BiasAdd", "product", "bias")]
    graph = read_graph(graph_bytes([placeholder("x"), zeros, weights, *layers]))
    assert not graph.constant("bias").any()  # type: ignore[union-attr]
    weights.attr["value"].tensor.ClearField("tensor_content")
    with pytest.raises(DamagedFileError, match="hold no values"):
        read_graph(graph_bytes([placeholder("x"), zeros, weights, *layers]))


@pytest.mark.parametrize("between", [(), ("Identity",), ("Identity", "Identity", "StopGradient")], ids=len)
@pytest.mark.parametrize("op", ["MatMul", "Conv2D", "DepthwiseConv2dNative"])
def test_a_kernel_without_values_is_no_zeros(op: str, between: tuple[str, ...]) -> None:
    """Beside filled constants, too: whoever cleared one field of several leaves those of one value."""
    kernel = constant("kernel", np.ones((3, 2) if op == "MatMul" else (1, 1, 3, 2), np.float32))
    ones = constant("ones", np.ones(2, np.float32))
    read, names = "kernel", [f"read_{i}" for i in range(len(between))]
    passed = []
    for name, kind in zip(names, between, strict=True):
        passed.append(node(name, kind, read))
        read = name
    nodes = [
        placeholder("x"),
        kernel,
        ones,
        *passed,
        node("product", op, "x", read),
        node("y", "Mul", "product", "ones"),
    ]
    read_graph(graph_bytes(nodes))
    kernel.attr["value"].tensor.ClearField("tensor_content")
    with pytest.raises(DamagedFileError, match="hold no values"):
        read_graph(graph_bytes(nodes))


def test_a_state_without_values_is_zeros() -> None:
    """What a product multiplies may be zeros, as a cell's first state is."""
    state, kernel = constant("state", np.ones((1, 3), np.float32)), constant("kernel", np.ones((3, 2), np.float32))
    state.attr["value"].tensor.ClearField("tensor_content")
    graph = read_graph(graph_bytes([state, kernel, node("product", "MatMul", "state", "kernel")]))
    assert not graph.constant("state").any()  # type: ignore[union-attr]


def test_a_saved_model_without_values_is_refused(tmp_path: Path) -> None:
    (made,) = export([path("continuous")], ExportOptions(tmp_path, targets=("saved_model",), verify="none"))
    file = made.folder / "saved_model" / "saved_model.pb"
    saved = schema.parse(schema.SavedModel, file.read_bytes(), "SavedModel")
    for proto in saved.meta_graphs[0].graph_def.node:
        if proto.op == "Const" and not proto.attr["value"].tensor.string_val:
            for field in _FIELDS:
                proto.attr["value"].tensor.ClearField(field)
    (tmp_path / "saved_model.pb").write_bytes(saved.SerializeToString())
    with pytest.raises(DamagedFileError, match="hold no values"):
        read_source(tmp_path / "saved_model.pb")


def test_other_files_beside_a_manifest_stay_what_they_are(tmp_path: Path) -> None:
    folder = split(path("continuous"), tmp_path / "web")
    (folder / "frozen.pb").write_bytes(path("discrete").read_bytes())
    assert read_source(folder / "frozen.pb").format.key == "bytes"
