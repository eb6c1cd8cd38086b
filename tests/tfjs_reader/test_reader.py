"""TensorFlow.js graph models: the official converter's, with what it fuses and quantises; our own; damaged ones."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.tfjs.reader import read_model
from export_model.converters.formats.tfjs.unfuse import unfuse
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import (
    DamagedFileError,
    ExportModelError,
    NotAPolicyError,
    SourceError,
    UnsupportedOpError,
)
from export_model.signatures.sampling import draw_cases
from fixtures import FIXTURES
from fixtures import path as fixture
from tests.saved_model.models import assert_agrees, roles

OFFICIAL = Path(__file__).with_name("official")
F32 = np.dtype(np.float32)


@pytest.mark.parametrize(
    ("name", "archive", "atol"),
    [
        ("function", "function", 2e-6),
        ("keys", "keys", 1e-6),
        ("keras", "keras", 1e-6),
        ("keras-uint16", "keras", 1e-4),
        ("keras-float16", "keras", 2e-3),
        ("keras-uint8", "keras", 2e-2),
    ],
)
@pytest.mark.parametrize("file", ["", "model.json"])
def test_reads_what_the_official_converter_wrote(name: str, archive: str, atol: float, file: str) -> None:
    source = read_source(OFFICIAL / name / file)
    (policy,) = source.policies()
    assert policy.name == name
    assert source.models[0].original is None
    assert [f.name for f in source.models[0].files] == ["model.json", "group1-shard1of1.bin"]
    assert_agrees(policy, OFFICIAL / f"{archive}.npz", atol)


def test_the_signature_tells_the_roles() -> None:
    (policy,) = read_source(OFFICIAL / "keys").policies()
    assert roles(policy) == {
        "state": "vector_observation",
        "action_masks": "masks",
        "action": "log_probs",
        "value_estimate": "value_estimate",
    }


@pytest.mark.parametrize("name", ["keras", "keys"])
def test_exports_to_every_format(name: str, tmp_path: Path) -> None:
    """Fused ops exist in none but TensorFlow.js: a .bytes needs the plain ones."""
    (result,) = export([OFFICIAL / name], ExportOptions(tmp_path, verify="none"))
    assert set(result.sizes) == {"bytes", "saved_model", "tfjs", "onnx"}


@pytest.mark.parametrize("name", FIXTURES)
def test_our_own_are_read_back(name: str, tmp_path: Path) -> None:
    for result in export([fixture(f"{name}.bytes")], ExportOptions(tmp_path, targets=("tfjs",), verify="none")):
        (policy,) = read_source(result.folder / "tfjs").policies()
        assert policy.name == result.policy.name
        names = [s.name for s in policy.signature.outputs if s.role != "sampled"]
        for case in draw_cases(policy.signature, seed=2, samples=1):
            got = run_graph(policy.graph, case.feeds, names)
            wanted = run_graph(result.policy.graph, case.feeds, names)
            for output in names:
                assert got[output].dtype == wanted[output].dtype
                np.testing.assert_allclose(got[output], wanted[output], rtol=1e-6, atol=1e-6)


# ------------------------------------------------------------------ weights


def model(tmp_path: Path, change: Callable[[dict[str, Any]], None] = lambda content: None) -> Path:
    """A copy of an official model, changed."""
    folder = tmp_path / "model"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(OFFICIAL / "keys", folder)
    content = json.loads((folder / "model.json").read_text())
    change(content)
    (folder / "model.json").write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize(
    "name", ["../outside.bin", "/etc/hostname", "https://example.com/a.bin", "file:///etc/hostname", "", "a/../../b"]
)
def test_weights_outside_the_folder_are_not_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "outside.bin").write_bytes(bytes(1000))

    def change(content: dict[str, Any]) -> None:
        content["weightsManifest"][0]["paths"] = [name]

    with pytest.raises(SourceError) as caught:
        read_source(model(tmp_path, change))
    assert caught.value.why is not None and "nothing else is read" in caught.value.why


def test_a_missing_shard_is_named(tmp_path: Path) -> None:
    folder = model(tmp_path)
    (folder / "group1-shard1of1.bin").unlink()
    with pytest.raises(SourceError, match=r"group1-shard1of1\.bin: cannot be read"):
        read_source(folder)


@pytest.mark.parametrize("change", [-4, 4])
def test_shards_of_another_length_are_refused(tmp_path: Path, change: int) -> None:
    folder = model(tmp_path)
    shard = folder / "group1-shard1of1.bin"
    data = shard.read_bytes()
    shard.write_bytes(data[:change] if change < 0 else data + bytes(change))
    with pytest.raises(DamagedFileError, match=r"beyond the end of its files|left over"):
        read_source(folder)


def test_claims_are_bounded(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["weightsManifest"][0]["weights"][0]["shape"] = [1 << 40, 1 << 40]

    with pytest.raises(DamagedFileError, match="beyond the end of its files"):
        read_source(model(tmp_path, change))


def test_weights_over_several_shards_and_groups(tmp_path: Path) -> None:
    """A weight may begin in one shard and end in the next; every group starts anew."""

    def change(content: dict[str, Any]) -> None:
        content["weightsManifest"][0]["paths"] = ["a.bin", "b.bin"]
        content["weightsManifest"].append({"paths": ["c.bin"], "weights": []})

    folder = model(tmp_path, change)
    data = (folder / "group1-shard1of1.bin").read_bytes()
    (folder / "a.bin").write_bytes(data[:7])
    (folder / "b.bin").write_bytes(data[7:])
    (folder / "c.bin").write_bytes(b"")
    assert_agrees(read_source(folder).policies()[0], OFFICIAL / "keys.npz")


# ------------------------------------------------------------------ topology


def test_functions_are_refused(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["modelTopology"]["library"] = {"function": [{"signature": {"name": "body"}}]}
        content["modelTopology"]["node"][-1]["op"] = "StatelessWhile"

    with pytest.raises(NotAPolicyError, match="calls a function"):
        read_source(model(tmp_path, change))


def test_a_model_without_a_signature_goes_by_names(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        del content["signature"]
        for node in content["modelTopology"]["node"]:
            if node["op"] == "Log":
                node["name"] = "log"
        content["modelTopology"]["node"].append({"name": "action", "op": "AddV2", "input": ["add", "add"], "attr": {}})

    found = read_model(Fetched(model(tmp_path, change)))
    assert found.signature.outputs == {}


@given(data=st.data())
def test_any_change_of_the_json_is_a_clear_error(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    """One value anywhere in model.json becomes something else."""

    def change(content: dict[str, Any]) -> None:
        place: Any = content
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            key = data.draw(st.sampled_from(keys))
            inner = place[key]
            if not isinstance(inner, dict | list) or not inner or data.draw(st.integers(0, 5)) == 0:
                place[key] = data.draw(st.sampled_from([None, 0, -1, 1e40, "", "x", [], {}, [1], {"a": 1}, True]))
                return
            place = inner

    folder = model(tmp_path_factory.mktemp("changed"), change)
    try:
        read_source(folder).policies()
    except ExportModelError as error:
        assert error.exit_status == 2
        assert str(folder) in str(error)


# ------------------------------------------------------------------ fused ops


def fused(op: str, steps: tuple[str, ...], extra: dict[str, np.ndarray], **attrs: Any) -> Graph:
    nodes = [Node("x", "Placeholder", (), {"dtype": F32, "shape": TensorShape((None, 2))})]
    kernel = np.array([[1, -2, 3], [4, 5, -6]], np.float32)
    nodes.append(Node("kernel", "Const", value=kernel))
    nodes += [Node(name, "Const", value=array) for name, array in extra.items()]
    nodes.append(
        Node("y", op, ("x", "kernel", *extra), {"fused_ops": steps, "num_args": len(extra), **attrs}, origin="y:0")
    )
    return Graph(tuple(nodes))


X = np.array([[1, -1], [0.5, 2]], np.float32)
PRODUCT = X @ np.array([[1, -2, 3], [4, 5, -6]], np.float32)
BIAS = np.array([0.5, -0.5, 1], np.float32)
SLOPES = np.array([0.1, 0.2, 0.3], np.float32)


@pytest.mark.parametrize(
    ("steps", "extra", "wanted"),
    [
        ((), {}, PRODUCT),
        (("BiasAdd",), {"b": BIAS}, PRODUCT + BIAS),
        (("BiasAdd", "Relu"), {"b": BIAS}, np.maximum(PRODUCT + BIAS, 0)),
        (("BiasAdd", "Relu6"), {"b": BIAS}, np.clip(PRODUCT + BIAS, 0, 6)),
        (("BiasAdd", "Sigmoid"), {"b": BIAS}, 1 / (1 + np.exp(-(PRODUCT + BIAS)))),
        (("BiasAdd", "Elu"), {"b": BIAS}, np.where(PRODUCT + BIAS > 0, PRODUCT + BIAS, np.expm1(PRODUCT + BIAS))),
        (("BiasAdd", "LeakyRelu"), {"b": BIAS}, np.maximum(PRODUCT + BIAS, 0.3 * (PRODUCT + BIAS))),
        (
            ("BiasAdd", "Prelu"),
            {"b": BIAS, "s": SLOPES},
            np.where(PRODUCT + BIAS > 0, PRODUCT + BIAS, SLOPES * (PRODUCT + BIAS)),
        ),
    ],
)
def test_fused_ops_are_taken_apart(steps: tuple[str, ...], extra: dict[str, np.ndarray], wanted: np.ndarray) -> None:
    from export_model.converters.compiler.passes.normalise import normalise

    attrs = {"leakyrelu_alpha": 0.3} if "LeakyRelu" in steps else {}
    made = unfuse(fused("_FusedMatMul", steps, extra, **attrs))
    assert made["y"].origin == "y:0"
    graph = normalise(Graph((*made.nodes, Node("action", "Identity", ("y",)))))
    np.testing.assert_allclose(run_graph(graph, {"x": X}, ["action"])["action"], wanted, rtol=1e-6)


@pytest.mark.parametrize(("steps", "extra"), [(("FusedBatchNorm",), {}), (("BiasAdd",), {}), (("Relu",), {"b": BIAS})])
def test_what_is_not_known_to_be_fused_is_refused(steps: tuple[str, ...], extra: dict[str, np.ndarray]) -> None:
    with pytest.raises(UnsupportedOpError, match="'y'"):
        unfuse(fused("_FusedMatMul", steps, extra))


def test_strings_in_attributes_are_base64() -> None:
    content = json.loads((OFFICIAL / "keras/model.json").read_text())
    node = next(n for n in content["modelTopology"]["node"] if n["op"] == "_FusedConv2D")
    steps = read_model(Fetched(OFFICIAL / "keras")).graph[node["name"]].attrs["fused_ops"]
    assert steps == tuple(base64.b64decode(s).decode() for s in node["attr"]["fused_ops"]["list"]["s"])
