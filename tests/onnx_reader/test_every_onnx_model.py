"""Every public and genuine ONNX model: four formats that agree with the file itself, goldens, the frozen graph."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from converters.graph.run import run_graph
from exporter.parity.compare import compare
from exporter.parity.tolerances import Tolerance, tolerance_for
from exporter.pipeline import ExportOptions, export
from exporter.sources import read_source
from exporter.summary import failure_lines
from signatures.roles import Role
from signatures.sampling import draw_cases
from signatures.spec import Policy
from tests.corpus.conftest import NEEDED, SHARED
from tests.onnx_reader.models import Array, Bench

pytestmark = [pytest.mark.corpus, pytest.mark.slow, pytest.mark.xdist_group("onnx-corpus")]

CORPUS = sorted(SHARED.glob("corpus/onnx/*.onnx"))
GENUINE = sorted(SHARED.glob("genuine/*/*.onnx"))
ABSENT = [pytest.param(Path("absent"), id="shared-is-absent")]
#: tf2onnx folds x/d to x·(1/d) and 1/3 to a constant, so numbers may differ from TensorFlow's by some units in the
#: last place before the layers amplify them.
CLOSE = Tolerance(1e-5, 1e-5)


@pytest.fixture(autouse=True)
def _shared_data() -> None:
    if not SHARED.is_dir():
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")


def test_nothing_has_fallen_out() -> None:
    assert (len(CORPUS), len(GENUINE)) == (18, 24)


@pytest.mark.parametrize(
    "source",
    [pytest.param(p, id=f"{p.parent.name}-{p.stem}"[:90]) for p in (*CORPUS, *GENUINE)] or ABSENT,
)
def test_exports_to_four_formats_that_agree(source: Path, bench: Bench, tmp_path: Path) -> None:
    for runtime in NEEDED:
        bench.need(runtime)
    (result,) = export([source], ExportOptions(tmp_path), pool=bench.pool)
    report = result.report
    assert report is not None
    assert report.passed is True, "\n".join(failure_lines(report))
    assert report.reference == "source/onnxruntime"
    assert {c.runtime for c in report.comparisons} == {"numpy", *NEEDED}
    assert {c.format for c in report.comparisons} >= {"bytes", "saved_model", "tfjs", "onnx"}


# ------------------------------------------------------------------ goldens


def node(tensor: str) -> str:
    return tensor.rpartition(":")[0] or tensor


class Golden:
    """One run of a golden.npz, seen through the policy of the ONNX file.

    tf2onnx gave the sampler a name of its own; there is one of it, so the recorded draw is found by its kind.
    """

    def __init__(self, archive: dict[str, Array], run: str, policy: Policy) -> None:
        self.archive, self.run, self.policy = archive, run, policy

    def feeds(self) -> dict[str, Array]:
        found = {}
        for spec in self.policy.signature.inputs:
            assert isinstance(spec.source, str)
            found[spec.name] = (
                self.draw() if spec.role is Role.NOISE else self.archive[f"{self.run}/in/{node(spec.source)}"]
            )
        return found

    def draw(self) -> Array:
        (draw,) = [a for key, a in self.archive.items() if key.startswith(f"{self.run}/rand/")]
        return draw

    def expected(self) -> dict[str, Array]:
        return {
            s.name: self.archive[f"{self.run}/out/{node(s.source)}"]
            for s in self.policy.signature.outputs
            if isinstance(s.source, str)
        }


@pytest.mark.parametrize("source", [pytest.param(p, id=p.parent.name) for p in GENUINE] or ABSENT)
def test_goldens(source: Path) -> None:
    """b1, b3, b16, and for memories b3s4: three sequences of four steps, the memory fed back."""
    (policy,) = read_source(source).policies()
    archive = dict(np.load(source.parent / "golden.npz"))
    runs = sorted({key.split("/")[0] for key in archive})
    memory = policy.signature.memory
    assert runs[:3] == ["b1", "b16", "b3"]
    assert ("b3s4" in runs) == (memory is not None)
    for run in runs:
        golden = Golden(archive, run, policy)
        steps = 4 if run.endswith("s4") else 1
        feeds, expected = golden.feeds(), golden.expected()
        state = None if memory is None or memory.input is None else feeds[memory.input]
        for step in range(steps):
            current = {n: a if memory and n == memory.input else a[step::steps] for n, a in feeds.items()}
            if state is not None and memory is not None and memory.input is not None:
                current[memory.input] = state
            got = run_graph(policy.graph, current, list(expected))
            for name, wanted in expected.items():
                if memory is not None and name == memory.output:
                    state = got[name]
                    if step < steps - 1:
                        continue  # the golden has the memory after the last step only
                    rows = wanted
                else:
                    rows = wanted[step::steps]
                difference = compare(rows, got[name], tolerance_for(policy.signature, name, CLOSE))
                assert difference.passed, f"{run} step {step}: {name}: {difference}"


@pytest.mark.parametrize("source", [pytest.param(p, id=p.parent.name) for p in GENUINE] or ABSENT)
def test_the_frozen_graph_beside_it_is_the_same_policy(source: Path) -> None:
    case = json.loads((source.parent / "case.json").read_text())
    (mine,) = read_source(source).policies()
    (frozen,) = read_source(source.parent / case["frozen"]["file"]).policies()
    a, b = mine.signature, frozen.signature
    assert {s.name: (s.role, s.dtype, s.shape) for s in a.inputs} == {
        s.name: (s.role, s.dtype, s.shape) for s in b.inputs
    }
    assert {s.name: (s.role, s.dtype, s.shape) for s in a.outputs} == {
        s.name: (s.role, s.dtype, s.shape) for s in b.outputs
    }
    assert (a.action_space, a.branches, a.algorithm, a.memory) == (b.action_space, b.branches, b.algorithm, b.memory)
    assert dict(a.constants) == dict(b.constants)
    names: list[str] = [s.name for s in a.outputs]
    for inputs in draw_cases(a)[:8]:
        ours, theirs = (run_graph(p.graph, inputs.feeds, names) for p in (mine, frozen))
        for name in names:
            difference = compare(theirs[name], ours[name], tolerance_for(a, name, CLOSE))
            assert difference.passed, f"{inputs.name}: {name}: {difference}"


def test_what_the_generations_are() -> None:
    families: dict[str, Any] = {}
    for path in CORPUS:
        (policy,) = read_source(path).policies()
        families.setdefault(policy.signature.family, []).append(path.name)
    assert {family: len(names) for family, names in families.items()} == {
        "ML-Agents 0.20-0.22 (PyTorch)": 2,
        "ML-Agents 0.23-0.25 (PyTorch)": 6,
        "ML-Agents 0.24-0.25 (PyTorch)": 2,
        "ML-Agents 0.25 (PyTorch)": 1,
        "ML-Agents 0.26-0.27 (PyTorch)": 4,
        "ML-Agents 0.28-1.1 (PyTorch)": 3,
    }
