"""``compare`` on what the official converters make: it passes where they are right, and names what is wrong."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.frozen_graph.encode import encode
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportResult
from export_model.signatures.roles import Role
from tests.comparing import compare_artefacts
from tests.peers.agreement import POLICIES
from tests.peers.conftest import Theirs
from tests.peers.environment import Peers

pytestmark = [pytest.mark.slow, pytest.mark.peers, pytest.mark.xdist_group("peers")]
RUNTIMES = "tensorflow,onnxruntime,tfjs-cpu"


@pytest.mark.parametrize("name", POLICIES)
def test_right_conversions_pass(
    name: str, official: Theirs, by_tf2onnx: Theirs, bundles: dict[str, ExportResult], pool: RuntimePool
) -> None:
    bundle, theirs = bundles[name], [official(name), by_tf2onnx(name)]
    signature = bundle.policy.signature
    report = compare_artefacts(bundle.folder / "saved_model", theirs, runtimes=RUNTIMES, pool=pool)
    # tf2onnx gives the seed 0 to every Multinomial: it draws the same after every start.
    drawn = any(s.role is Role.SAMPLED for s in signature.outputs)
    wrong = {(c.kind, c.runtime, c.output) for c in report.failures}
    assert wrong == ({("draws", "onnxruntime", "action")} if drawn else set()), report.failures
    assert {c.runtime for c in report.comparisons} == {"tfjs-cpu", "onnxruntime"}
    assert {c.output for c in report.comparisons} == {s.name for s in signature.outputs}


def test_what_lost_its_signature_names_is_compared_by_role(
    tmp_path: Path, official: Theirs, bundles: dict[str, ExportResult], pool: RuntimePool
) -> None:
    """What converters of old did to a SavedModel of TensorFlow 2: its keys gone, Identity nodes in their place."""
    bundle = bundles["discrete"]
    theirs = shutil.copytree(official("discrete"), tmp_path / "tfjs")
    model = json.loads((theirs / "model.json").read_text())
    for place in (model, model.get("userDefinedMetadata", {})):
        outputs = place.get("signature", {}).get("outputs", {})
        if outputs:
            place["signature"]["outputs"] = {f"Identity_{i}": info for i, info in enumerate(outputs.values())}
    model.get("userDefinedMetadata", {}).pop("structuredOutputKeys", None)
    (theirs / "model.json").write_text(json.dumps(model))
    report = compare_artefacts(bundle.folder / "saved_model", [theirs], runtimes=RUNTIMES, pool=pool)
    assert report.passed is True
    assert {c.output for c in report.comparisons} >= {"action", "value_estimate"}
    assert any("by their roles" in note for note in report.notes)


def test_an_op_that_tf2onnx_writes_all_the_same_is_named(tmp_path: Path, peers: Peers, pool: RuntimePool) -> None:
    """tf2onnx logs that it does not know Expm1, writes it, and ends with status 0."""
    float32 = np.dtype(np.float32)
    weights = np.random.default_rng(0).standard_normal((4, 2)).astype(np.float32) * 0.3
    nodes = [
        Node("vector_observation", "Placeholder", (), {"dtype": float32, "shape": TensorShape((None, 4))}),
        Node("kernel", "Const", (), {}, weights),
        Node("dense", "MatMul", ("vector_observation", "kernel"), {"transpose_a": False, "transpose_b": False}),
        Node("action", "Expm1", ("dense",)),
    ]
    source = tmp_path / "policy.bytes"
    source.write_bytes(encode(Graph(tuple(nodes))).SerializeToString(deterministic=True))
    theirs, names = tmp_path / "theirs.onnx", ["--inputs", "vector_observation:0", "--outputs", "action:0"]
    peers.run([*peers.tf2onnx(), "--graphdef", str(source), *names, "--output", str(theirs)])
    report = compare_artefacts(source, [theirs], runtimes=RUNTIMES, pool=pool)
    assert report.passed is False
    (failure,) = report.failures
    assert (failure.runtime, failure.kind) == ("onnxruntime", "failure")
    assert "Expm1" in failure.reason


def test_a_conversion_of_other_weights_differs(
    tmp_path: Path, official: Theirs, bundles: dict[str, ExportResult], pool: RuntimePool
) -> None:
    bundle = bundles["continuous"]
    theirs = shutil.copytree(official("continuous"), tmp_path / "tfjs")
    shard = next(theirs.glob("*.bin"))
    values = np.frombuffer(shard.read_bytes(), np.uint8).copy()
    values[: len(values) // 2] = 0
    shard.write_bytes(values.tobytes())
    report = compare_artefacts(bundle.folder / "saved_model", [theirs], runtimes=RUNTIMES, pool=pool)
    assert report.passed is False
    assert all(f.kind in ("numbers", "failure") for f in report.failures)
