"""Where one training run left a ``.nn`` beside its frozen graph: both are the same policy, and the recorded one.

``golden.npz`` holds what the trainer's own TensorFlow computed. Recorded normal draws are fed as ``epsilon``, ``b3s4``
(3 sequences of 4 steps) as four steps with the memory fed back.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from converters.graph.run import run_graph
from exporter.parity.compare import compare
from exporter.parity.tolerances import Tolerance, tolerance_for
from exporter.sources import read_source
from signatures.errors import DamagedFileError
from signatures.spec import Policy, TensorSpec
from tests.barracuda.conftest import BROKEN, SHARED, genuine_files, params

pytestmark = pytest.mark.corpus

Arrays = Mapping[str, np.ndarray]
CASES = [c for c in genuine_files() if c[0].parent.name != BROKEN]


def only(path: Path) -> Policy:
    (policy,) = read_source(path).policies()
    return policy


def recorded(archive: Arrays, run: str, spec: TensorSpec) -> np.ndarray:
    """A tensor of a golden run, by what the source calls it; the joined memories are TensorFlow's recurrent tensors."""
    name = spec.source.removesuffix(":0") if isinstance(spec.source, str) else spec.name
    keys = [f"{run}/{part}/{name}" for part in ("in", "rand", "out")]
    return next(archive[key] for key in keys if key in archive)


def play(policy: Policy, archive: Arrays, run: str) -> list[tuple[dict[str, np.ndarray], dict[str, np.ndarray]]]:
    """Per step of a golden run: (what the policy gives, what was recorded)."""
    memory = policy.signature.memory
    steps = 4 if run.endswith("s4") else 1
    feeds = {s.name: recorded(archive, run, s) for s in policy.signature.inputs}
    known = [s for s in policy.signature.outputs if s.source is not None]
    expected = {s.name: recorded(archive, run, s) for s in known}
    state = None if memory is None or memory.input is None else feeds.pop(memory.input)
    results = []
    for step in range(steps):
        current = {name: array[step::steps] for name, array in feeds.items()}
        wanted = {name: array[step::steps] for name, array in expected.items()}
        if memory is not None and memory.input is not None and state is not None and memory.output is not None:
            current[memory.input] = state
            # The golden has the memory after the last step only.
            wanted[memory.output] = expected[memory.output]
            if step < steps - 1:
                del wanted[memory.output]
        got = run_graph(policy.graph, current, [s.name for s in policy.signature.outputs])
        if memory is not None and memory.output is not None:
            state = got[memory.output]
        results.append((got, wanted))
    return results


def runs(archive: Arrays, policy: Policy) -> list[str]:
    found = sorted({key.split("/")[0] for key in archive})
    return found if policy.signature.memory is not None else [run for run in found if not run.endswith("s4")]


@pytest.mark.parametrize("case", params(CASES, lambda c: c[0].parent.name))
def test_the_nn_gives_what_the_trainer_computed(case: tuple[Path, Path, dict[str, Any]], shared: Path) -> None:
    path = case[0]
    policy = only(path)
    archive = dict(np.load(path.parent / "golden.npz"))
    compared = 0
    for run in runs(archive, policy):
        for got, wanted in play(policy, archive, run):
            for name, value in wanted.items():
                close = compare(value, got[name], tolerance_for(policy.signature, name, Tolerance()))
                assert close.passed, f"{run}: {name}: {close}"
                compared += 1
    assert compared >= 3


@pytest.mark.parametrize("case", params(CASES, lambda c: c[0].parent.name))
def test_the_nn_and_the_frozen_graph_are_one_policy(case: tuple[Path, Path, dict[str, Any]], shared: Path) -> None:
    ours, frozen = only(case[0]), only(case[1])
    a, b = ours.signature, frozen.signature
    assert [(s.name, s.role, s.dtype, s.shape) for s in a.inputs] == [
        (s.name, s.role, s.dtype, s.shape) for s in b.inputs
    ]
    shared_outputs = [s.name for s in a.outputs if s.name in {o.name for o in b.outputs}]
    assert {s.name for s in a.outputs} >= {"action", "deterministic_action"}
    for name in shared_outputs:
        assert (a.output(name).role, a.output(name).dtype, a.output(name).shape) == (
            b.output(name).role,
            b.output(name).dtype,
            b.output(name).shape,
        )
    assert (a.action_space, a.branches, a.constants, a.family) == (b.action_space, b.branches, b.constants, b.family)
    assert a.algorithm == b.algorithm
    assert (a.memory is None) == (b.memory is None)
    if a.memory is not None and b.memory is not None:
        assert (a.memory.size, a.memory.input, a.memory.output) == (b.memory.size, b.memory.input, b.memory.output)
        assert a.memory.layout == b.memory.layout
    archive = dict(np.load(case[0].parent / "golden.npz"))
    for run in runs(archive, ours):
        for (got, _), (other, _) in zip(play(ours, archive, run), play(frozen, archive, run), strict=True):
            for name in shared_outputs:
                close = compare(other[name], got[name], tolerance_for(b, name, Tolerance()))
                assert close.passed, f"{run}: {name}: {close}"


def test_the_file_that_its_converter_broke_is_refused_with_the_reason(shared: Path) -> None:
    path = SHARED / "genuine" / BROKEN / "Brain.nn"
    with pytest.raises(DamagedFileError, match="AddV2") as caught:
        read_source(path)
    assert caught.value.fix is not None
    assert "frozen_graph_def.pb" in caught.value.fix


def test_no_case_falls_out_unseen(shared: Path) -> None:
    """44 genuine cases with both forms, one of them the file that is refused."""
    assert len(genuine_files()) == 44
    assert len(CASES) == 43
