"""Checkpoints that ML-Agents' own modules and torch.save wrote, against their own forward and their own ONNX.

The files come from fixtures/torch_checkpoint (its README says how they were made). The images' checkpoints are put
together here, from the names and shapes of the genuine ones.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.roles import OBSERVATIONS, Role
from fixtures.goldens import read_npz
from fixtures.torch_checkpoint import FOLDER
from fixtures.torch_checkpoint.cases import CASES, Case
from tests.torch_checkpoint.pt_files import checkpoint, weights

STORED = [c for c in CASES if c.stored]
SAID = [c for c in CASES if not c.stored]
#: The widest gap between float32 sums in PyTorch's order and in ours, on weights and inputs of this size.
CLOSE = {"atol": 2e-6, "rtol": 2e-5}


def params(cases: list[Case]) -> list[Any]:
    return [pytest.param(c, id=c.name) for c in cases]


def compiled(path: Path, sensors: tuple[tuple[int, ...], ...] = ()) -> Policy:
    (policy,) = read_source(path, ReadOptions(sensors=sensors)).policies()
    return policy


def feeds(case: Case, policy: Policy) -> dict[str, np.ndarray]:
    """The case's inputs under the policy's names: vectors joined where the generation joins them."""
    given = case.inputs()
    vectors, lists, images = (
        [given.pop(f"obs_{i}") for i, s in enumerate(case.sensors) if len(s) == rank] for rank in (1, 2, 3)
    )
    names = {r: [s.name for s in policy.signature.inputs if s.role is r] for r in OBSERVATIONS}
    if len(names[Role.VECTOR]) == 1:
        vectors = [np.concatenate(vectors, axis=1)]
    assert len(names[Role.VECTOR]) == len(vectors) and len(names[Role.VISUAL]) == len(images)
    given |= dict(zip(names[Role.VECTOR], vectors, strict=True))
    given |= dict(zip(names[Role.VISUAL], images, strict=True))
    given |= dict(zip(names[Role.ENTITIES], lists, strict=True))
    assert set(given) == {s.name for s in policy.signature.inputs}
    return given


def agrees_with_torch(case: Case, policy: Policy) -> None:
    """Every output that is no draw equals what the modules' own forward gave."""
    golden = read_npz(FOLDER / f"{case.name}.npz")
    names = [s.name for s in policy.signature.outputs if s.role is not Role.SAMPLED]
    ours = run_graph(policy.graph, feeds(case, policy), names)
    golden_values = expected(case, golden)
    for name, wanted in golden_values.items():
        assert ours[name].reshape(wanted.shape) == pytest.approx(wanted, abs=CLOSE["atol"], rel=CLOSE["rtol"]), name
    unchecked = set(names) - set(golden_values)
    assert all(n.startswith("deterministic_") for n in unchecked), unchecked  # which came with 0.28


def expected(case: Case, golden: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The golden values by canonical names."""
    hybrid = bool(case.continuous and case.branches)
    found: dict[str, np.ndarray] = {}
    if "recurrent_out" in golden:
        found["recurrent_out"] = golden["recurrent_out"]
    if case.continuous:
        action = golden.get("continuous_actions", golden.get("action"))
        assert action is not None
        found["continuous_actions" if hybrid else "action"] = action
        mean = golden.get("deterministic_continuous_actions")
        if mean is not None:
            found["deterministic_continuous_actions" if hybrid else "deterministic_action"] = mean
    if case.branches and "log_probs" in golden:
        found["action_log_probs"] = golden["log_probs"]
        if "deterministic_discrete_actions" in golden:
            without = "deterministic_discrete_actions" if hybrid else "deterministic_action"
            found[without] = golden["deterministic_discrete_actions"]
    elif case.branches:
        log_probs = golden.get("discrete_actions", golden.get("action"))
        assert log_probs is not None
        found["discrete_actions" if hybrid else "action"] = log_probs
    return found


# ------------------------------------------------------------------ the files themselves


@pytest.mark.parametrize("case", params(STORED))
def test_gives_the_numbers_of_ml_agents_own_forward(case: Case) -> None:
    agrees_with_torch(case, compiled(FOLDER / f"{case.name}.pt"))


@pytest.mark.parametrize("case", params(STORED))
def test_is_the_policy_that_the_onnx_beside_it_is(case: Case) -> None:
    """Names, roles, dtypes, shapes and numbers; where they differ, the old exporter was at fault."""
    ours, theirs = compiled(FOLDER / f"{case.name}.pt"), compiled(FOLDER / f"{case.name}.onnx")
    outputs = {s.name: (s.role, s.dtype, s.shape) for s in ours.signature.outputs}
    exported = {s.name: (s.role, s.dtype, s.shape) for s in theirs.signature.outputs}
    if case.version < "0.23" and (case.continuous or case.memory):  # an action of rank 3, and no memory given back
        assert {n: s[:2] for n, s in exported.items()} == {n: s[:2] for n, s in outputs.items() if n in exported}
        assert set(outputs) - set(exported) == ({"recurrent_out"} if case.memory else set())
    else:
        assert outputs == exported
    described = [[(s.name, s.role, s.dtype, s.shape) for s in p.signature.inputs] for p in (ours, theirs)]
    assert described[0] == described[1]
    facts = ("action_space", "branches")
    assert [getattr(ours.signature, f) for f in facts] == [getattr(theirs.signature, f) for f in facts]
    given = feeds(case, ours)
    names = [n for n, (role, *_) in exported.items() if role is not Role.SAMPLED]
    mine, other = run_graph(ours.graph, given, names), run_graph(theirs.graph, given, names)
    for name in names:
        assert mine[name].reshape(other[name].shape) == pytest.approx(other[name], abs=1e-6, rel=1e-5), name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo_1_1", "ppo_1_1_hybrid_lstm", "sac_0_23", "ppo_0_25_discrete_lstm"])
def test_is_exported_and_its_verdict_is_self_consistent(name: str, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="onnxruntime is not here; get it with: pip install onnxruntime")
    (result,) = export([FOLDER / f"{name}.pt"], ExportOptions(tmp_path, verify=("onnxruntime",)))
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert not result.report.reference.startswith("source/")
    assert any("self-consistent" in note for note in result.policy.signature.notes)


def test_the_same_checkpoint_gives_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        list(export([FOLDER / "ppo_1_1_hybrid_lstm.pt"], ExportOptions(tmp_path / folder, verify="none")))
    names = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(names) > 4
    assert all((tmp_path / "a" / n).read_bytes() == (tmp_path / "b" / n).read_bytes() for n in names)


# ------------------------------------------------------------------ what follows from the weights


def generation(case: Case) -> str:
    number = case.version.rsplit(".", 1)[0]
    return "0.20-0.21" if number in ("0.20", "0.21") else "0.26-1.1" if number in ("0.26", "1.1") else number


GENERATIONS = {
    "ppo_0_20": "0.20-0.21",
    "ppo_1_1": "0.26-1.1",
    "poca_0_26_discrete": "0.26-1.1",
    "ppo_0_25_discrete_lstm": "0.25",
    "ppo_0_24_hybrid": "0.24",
    "sac_0_23": "0.23",
    "ppo_0_22_lstm": "0.22",
}


@pytest.mark.parametrize("name", GENERATIONS)
def test_the_generation_is_told(name: str) -> None:
    signature = compiled(FOLDER / f"{name}.pt").signature
    assert signature.family == f"ML-Agents {GENERATIONS[name]} (PyTorch)"
    assert signature.constants["version_number"] == (3 if name in ("ppo_1_1", "poca_0_26_discrete") else 2)


def test_the_memory_has_the_hidden_state_before_the_cell() -> None:
    signature = compiled(FOLDER / "ppo_1_1_hybrid_lstm.pt").signature
    assert signature.memory is not None
    assert tuple(signature.memory.layout) == ("h", "c")


def test_vectors_without_a_normaliser_are_one_input_and_a_note_says_so() -> None:
    signature = compiled(FOLDER / "sac_1_1.pt").signature
    assert [(s.name, s.shape) for s in signature.inputs if s.role is Role.VECTOR] == [("state", (None, 5))]
    assert any("how many vector sensors the 5 numbers come from" in note for note in signature.notes)


# ------------------------------------------------------------------ images, lists of entities, goals


@pytest.mark.parametrize("form", ["zip", "legacy"])
@pytest.mark.parametrize("case", params(SAID))
def test_what_sensors_say_gives_the_numbers_of_ml_agents_own(case: Case, form: str, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(checkpoint(weights(FOLDER / f"{case.name}.json"), form))
    policy = compiled(path, case.sensors)
    assert policy.signature.family == f"ML-Agents {generation(case)} (PyTorch)"
    agrees_with_torch(case, policy)
