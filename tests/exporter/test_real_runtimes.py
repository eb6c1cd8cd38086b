"""The fixtures in every real runtime: all agree, and a single wrong weight in one format is found and named."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import DEFAULTS, WRITTEN
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.policy import Policy
from fixtures import FIXTURES
from fixtures import path as fixture
from tests.commands import export_model
from tests.conftest import NEEDED

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("runtimes"), pytest.mark.usefixtures("runtimes")]

PAIRS = {
    *(("bytes", "tensorflow"), ("onnx", "onnxruntime"), ("saved_model", "tensorflow")),
    *(("saved_model:deterministic", "tensorflow"), ("tfjs", "tfjs-cpu"), ("tfjs", "tfjs-wasm")),
    ("onnx", "onnxruntime-web"),
}
#: Not "auto": the old TensorFlows may be in this machine's cache or not; tests/legacy is about them.
VERIFY = ("--verify", ",".join(NEEDED))


def test_all_fixtures_agree_in_all_runtimes(tmp_path: Path) -> None:
    ran = export_model(*map(fixture, FIXTURES), "-o", tmp_path, *VERIFY, "--json")
    assert (ran.status, ran.err) == (0, "")
    assert len(ran.json["policies"]) == 7
    for policy in ran.json["policies"]:
        report = policy["parity"]
        assert policy["passed"] is True
        assert report["reference"] == "source/tensorflow"
        assert {(c["format"], c["runtime"]) for c in report["comparisons"]} == PAIRS | {("reference", "numpy")}
        assert {n for n, r in report["runtimes"].items() if r["status"] == "ran"} == {
            "numpy",
            *(runtime for _, runtime in PAIRS),
        }
        assert json.loads((Path(policy["folder"]) / "parity.json").read_text()) == report


@pytest.mark.parametrize(
    "flags", [["--names", "source"], ["--noise", "keep"], ["--noise", "zero"], ["--deterministic"]]
)
def test_the_variants_agree_too(flags: list[str], tmp_path: Path) -> None:
    sources = [fixture(n) for n in ("visual", "sampled", "recurrent")]
    ran = export_model(
        *sources, "-o", tmp_path, "--samples", "1", "--verify", "tensorflow,onnxruntime,tfjs-wasm", *flags, "--json"
    )
    assert (ran.status, ran.err) == (0, "")
    assert [p["passed"] for p in ran.json["policies"]] == [True, True, True]


def test_a_bundle_is_verified_again_with_its_source_and_without(tmp_path: Path) -> None:
    export_model(fixture("recurrent"), "-o", tmp_path, "--verify", "none")
    folder = tmp_path / "recurrent"
    with_source = export_model("verify", folder, "--source", fixture("recurrent"), "--json")
    assert with_source.status == 0
    report = with_source.json["reports"][0]
    assert (report["passed"], report["reference"]) == (True, "source/tensorflow")
    assert any(len(c.get("drift", [])) == 4 for c in report["comparisons"])
    ran = export_model("verify", folder, "--runtimes", "onnxruntime", "--steps", "2", "--seed", "9", "--json")
    report = ran.json["reports"][0]
    assert (ran.status, report["passed"], report["reference"], report["seed"]) == (0, True, "bytes/numpy", 9)
    assert {c["format"] for c in report["comparisons"]} == {"onnx"}
    assert report["runtimes"]["tensorflow"]["reason"] == "not asked for"
    table = export_model("verify", folder, "--runtimes", "onnxruntime")
    assert (table.status, table.err) == (0, "")
    last = table.out.splitlines()[-1]
    assert last.startswith("PASSED: onnx (1 of 4 formats; ask for tensorflow and ")
    assert last.endswith(" to check the others) agrees with the bundle's own .bytes")


def wrong_weight(graph: Graph, output: str) -> Graph:
    """The graph with one element of the last kernel before ``output`` moved by a tenth."""
    upstream = graph.ancestors([output])
    kernels = [n.inputs[1] for n in graph.nodes if n.op == "MatMul" and n.name in upstream]
    name = kernels[-1]
    value = np.array(graph[name].value)
    value[0, 0] += np.float32(0.1)
    return Graph(tuple(replace(n, value=value) if n.name == name else n for n in graph.nodes))


#: Rooms that are not called as their format is.
ROOMS = {"bytes": "frozen_graph"}


def plant(monkeypatch: pytest.MonkeyPatch, target: str, output: str = "action") -> None:
    """Let the writer of one format write a wrong weight."""
    module = importlib.import_module(f"export_model.converters.formats.{ROOMS.get(target, target)}.writer")
    write = module.write

    def wrong(policy: Policy, options: WriteOptions) -> Any:
        return write(replace(policy, graph=wrong_weight(policy.graph, output)), options)

    monkeypatch.setattr(module, "write", wrong)


@pytest.mark.parametrize("name", ["continuous", "discrete", "sampled", "recurrent"])
@pytest.mark.parametrize("target", DEFAULTS)
def test_a_wrong_weight_in_one_format_is_found_and_named(
    target: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One policy in all runtimes, so that no other is blamed; the others in those of the format and in TensorFlow."""
    plant(monkeypatch, target)
    runtimes = [r for r in WRITTEN[target].runtimes if r in NEEDED]
    asked = NEEDED if name == "recurrent" else dict.fromkeys(["tensorflow", *runtimes])
    ran = export_model(fixture(name), "-o", tmp_path, "--samples", "1", "--verify", ",".join(asked))
    assert (ran.status, ran.err) == (1, ""), ran.out
    for runtime in runtimes:
        assert f"\n  {target} in {runtime}: " in ran.out
    named = [line for line in ran.out.splitlines() if line.startswith(f"  {target} in ") and "differs" in line]
    outputs = {line.split(": ")[1].split()[0] for line in named}
    assert outputs & {"action", "action_log_probs"}
    report = json.loads((tmp_path / f"{name}.failed" / "parity.json").read_text())
    failed = {(c["format"].split(":")[0], c["runtime"]) for c in report["comparisons"] if not c["passed"]}
    assert failed == {(target, r) for r in runtimes}
    assert not (tmp_path / name).exists()


def test_a_wrong_weight_behind_the_memory_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plant(monkeypatch, "onnx", "recurrent_out")
    ran = export_model(fixture("recurrent"), "-o", tmp_path, "--samples", "1", "--json")
    assert ran.status == 1
    failed = [c for c in ran.json["policies"][0]["parity"]["comparisons"] if not c["passed"]]
    assert {(c["output"], c["kind"]) for c in failed} >= {("recurrent_out", "numbers"), ("recurrent_out", "rollout")}


def test_an_artefact_that_its_runtime_cannot_load_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("export_model.converters.formats.onnx.writer")
    monkeypatch.setattr(module, "write", lambda policy, options: {f"{policy.name}.onnx": Pieces(b"\x08\x08\x12\x01x")})
    ran = export_model(fixture("continuous"), "-o", tmp_path, "--samples", "1")
    assert (ran.status, ran.err) == (1, "")
    assert "\n  onnx in onnxruntime: onnxruntime failed: " in ran.out
