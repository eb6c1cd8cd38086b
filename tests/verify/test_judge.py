"""The judge's own tests: what each rule forgives, and that it forgives nothing beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.verify.checks.draws import draws
from export_model.exporter.verify.checks.numbers import numbers
from export_model.exporter.verify.checks.rollout import rollout
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.rounding import Hull
from export_model.exporter.verify.tolerances import Tolerance
from tests.handmade import constant, continuous_policy, dense, node, placeholder, sampled_policy
from tests.verify.judged import Arrays, Feeds, compiled, judge, spoiling, wrong

Array = npt.NDArray[Any]
F: dict[str, Any] = {"T": np.float32}


def logarithms(steep: float = 1.0) -> Policy:
    """``action`` = a layer of log(sigmoid) of another, and ``value_estimate``, which rests on nothing that is open."""
    return compiled(
        [
            placeholder("vector_observation"),
            *dense("first", "vector_observation", 3, 4),
            constant("steep", steep),
            node("wide", "Mul", "first", "steep", **F),
            node("squashed", "Sigmoid", "wide", **F),
            node("logarithm", "Log", "squashed", **F),
            *dense("action", "logarithm", 4, 2),
            *dense("value_estimate", "vector_observation", 3, 1),
        ]
    )


def recurrent(growth: float = 0.5) -> Policy:
    """A memory of two numbers, ``growth`` times the last one and what is seen; the action is what it holds."""
    return compiled(
        [
            placeholder("vector_observation", (None, 2)),
            placeholder("recurrent_in", (None, 2)),
            constant("growth", growth),
            node("kept", "Mul", "recurrent_in", "growth", **F),
            node("recurrent_out", "Add", "kept", "vector_observation", **F),
            node("action", "Identity", "recurrent_out", **F),
            constant("memory_size", 2),
        ]
    )


def branches(gap: float) -> Policy:
    """Two branches of two classes by their log-probabilities; those of the first are ``gap`` apart."""
    columns = [constant(f"at{i}", [0, i]) for i in (0, 2)]
    sizes = constant("size", [-1, 2])
    cut = {"T": np.float32, "Index": np.int32}
    matrix = np.array([[0.3, 0.3, 3.0, -3.0], [0.1, 0.1, 2.0, 1.0], [0.2, 0.2, -1.0, 4.0]], np.float32)
    return compiled(
        [
            placeholder("vector_observation"),
            constant("matrix", matrix),
            constant("bias", np.array([0, gap, 0, 0], np.float32)),
            node("product", "MatMul", "vector_observation", "matrix", transpose_a=False, transpose_b=False, **F),
            node("logits", "Add", "product", "bias", **F),
            *(*columns, sizes),
            *(node(f"part{i}", "Slice", "logits", f"at{i}", "size", **cut) for i in (0, 2)),
            *(node(f"soft{i}", "Softmax", f"part{i}", **F) for i in (0, 2)),
            *(node(f"log{i}", "Log", f"soft{i}", **F) for i in (0, 2)),
            constant("axis", 1),
            node("action", "ConcatV2", "log0", "log2", "axis", N=2, T=np.float32, Tidx=np.int32),
        ]
    )


def noisy() -> Policy:
    """Two numbers drawn around a mean, for each row; the noise stays inside."""
    nodes = [
        placeholder("vector_observation"),
        *dense("mean", "vector_observation", 3, 2),
        node("size", "Shape", "mean", T=np.float32, out_type=np.int32),
        node("random_normal/RandomStandardNormal", "RandomStandardNormal", "size", dtype=np.float32, T=np.int32),
        constant("spread", np.array([0.5, 0.2], np.float32)),
        node("scaled", "Mul", "random_normal/RandomStandardNormal", "spread", T=np.float32),
        node("action", "Add", "mean", "scaled", T=np.float32),
    ]
    return compiled(nodes, CompileOptions(noise="keep"))


SOUND: dict[str, Callable[[], Policy]] = {
    "logarithms": logarithms,
    "recurrent": recurrent,
    "tied": lambda: branches(0.0),
    "apart": lambda: branches(0.5),
    "noisy": noisy,
    "sampled": lambda: compiled(sampled_policy()),
    "continuous": lambda: compiled(continuous_policy()),
}


@pytest.mark.parametrize("name", SOUND)
def test_without_a_fault_all_is_well(name: str, tmp_path: Path) -> None:
    report = judge(SOUND[name](), tmp_path)
    assert report.passed is True, [f.explanation() for f in report.failures]
    assert {f.output for f in report.comparisons} == {s.name for s in SOUND[name]().signature.outputs}


# ------------------------------------------------------------------ what is open, and what beside it is not


def _ordinary(feeds: Feeds) -> Array:
    return np.asarray(np.abs(feeds["state"]).max(axis=1) < 2)[:, None]


@pytest.mark.parametrize("lie", [-np.inf, np.nan, 0.5])
def test_typical_inputs_are_no_edges(lie: float, tmp_path: Path) -> None:
    report = judge(
        logarithms(), tmp_path, spoiling("action", lambda f, a: np.where(_ordinary(f), lie, a).astype(a.dtype))
    )
    assert ("numbers", "action") in wrong(report)


def test_typical_inputs_are_asked_about_as_ordinary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where their sigmoids are no float32 either: what is not told from zero is for far inputs alone."""
    asked, forgive = list[bool](), Hull.forgive

    def watch(self: Hull, answer: Array, reference: Array, *, ordinary: bool) -> Any:
        asked.append(ordinary)
        return forgive(self, answer, reference, ordinary=ordinary)

    def moved(feeds: Feeds, action: Array) -> Array:
        return action + np.float32(0.5)

    monkeypatch.setattr(Hull, "forgive", watch)
    assert wrong(judge(logarithms(steep=40.0), tmp_path, spoiling("action", moved), checks=(numbers,)))
    assert True in asked and False in asked


@pytest.mark.parametrize("row", [0, 1])
def test_an_open_element_opens_no_other(row: int, tmp_path: Path) -> None:
    """Where inputs are ±1e3, the action rests on a sigmoid of zero; the value beside it does not."""

    def shift(feeds: Feeds, value: Array) -> Array:
        far = np.abs(feeds["state"]).max() == 1e3
        return np.where(far & (np.arange(len(value)) == row)[:, None], value * np.float32(1.01), value)

    assert wrong(judge(logarithms(), tmp_path, spoiling("value_estimate", shift))) == {("numbers", "value_estimate")}


def test_a_row_with_an_open_element_opens_no_other_row(tmp_path: Path) -> None:
    """Of each two far rows with other signs, one is decided where the other is not."""

    def shift(feeds: Feeds, action: Array) -> Array:
        far = np.abs(feeds["state"]).max() >= 5
        decided = np.isfinite(action).all(axis=1, keepdims=True) & (np.abs(action).max(axis=1, keepdims=True) < 20)
        return np.where(far & decided, action + np.float32(0.5), action)

    assert ("numbers", "action") in wrong(judge(logarithms(), tmp_path, spoiling("action", shift)))


@pytest.mark.parametrize("branch", [0, 1])
@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_a_tie_of_one_branch_frees_no_other(branch: int, gap: float, tmp_path: Path) -> None:
    def other(feeds: Feeds, chosen: Array) -> Array:
        made = np.array(chosen)
        made[:, branch] = 1 - made[:, branch]
        return made

    report = judge(branches(gap), tmp_path, spoiling("deterministic_action", other))
    free = branch == 0 and gap == 0
    assert wrong(report) == (set() if free else {("numbers", "deterministic_action")})


def test_a_tie_at_some_inputs_frees_none_at_others(tmp_path: Path) -> None:
    """At zero the gap decides; the scores are as good for no other input."""

    def other(feeds: Feeds, chosen: Array) -> Array:
        return np.where(np.arange(chosen.shape[0])[:, None] == chosen.shape[0] - 1, 1 - chosen, chosen)

    assert wrong(judge(branches(0.5), tmp_path, spoiling("deterministic_action", other)))


def test_a_tolerance_for_numbers_frees_no_typical_decision(tmp_path: Path) -> None:
    options = VerifyOptions(tolerance=Tolerance(1e-4, 1e-4))
    report = judge(branches(0.5), tmp_path, spoiling("deterministic_action", lambda f, a: 1 - a), options=options)
    assert wrong(report) == {("numbers", "deterministic_action")}


@pytest.mark.parametrize("output", ["action", "value_estimate"])
@pytest.mark.parametrize("by", [3e-5, np.nan, np.inf])
def test_each_output_is_judged_in_each_case(output: str, by: float, tmp_path: Path) -> None:
    """One row of one kind of input is wrong, whichever: the largest batch, zeros, all numbers equal."""
    policy = logarithms()
    for where in (lambda f: len(f["state"]) == 521, lambda f: not f["state"].any(), lambda f: len(f["state"]) == 1):
        shifted = spoiling(output, lambda f, a, w=where: a + np.float32(by if w(f) else 0))  # type: ignore[misc]
        assert ("numbers", output) in wrong(judge(policy, tmp_path, shifted, checks=(numbers,)))


def test_what_is_asked_for_may_be_narrower_or_wider(tmp_path: Path) -> None:
    shifted = spoiling("action", lambda f, a: a + np.float32(1e-4))
    policy = compiled(continuous_policy())
    for atol, right in ((1e-3, True), (1e-5, False)):
        options = VerifyOptions(tolerance=Tolerance(atol, 0.0))
        assert judge(policy, tmp_path, shifted, options=options, checks=(numbers,)).passed is right


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda a: a.astype(np.float64), "dtype float64 instead of float32"),
        (lambda a: a[:, :1], "instead of"),
        (lambda a: a.reshape(-1), "instead of"),
    ],
)
def test_another_dtype_or_shape_is_a_fault(change: Callable[[Array], Array], words: str, tmp_path: Path) -> None:
    report = judge(compiled(continuous_policy()), tmp_path, spoiling("action", lambda f, a: change(a)))
    assert any(words in f.reason for f in report.failures if f.output == "action")


# ------------------------------------------------------------------ memory


def test_each_runtime_is_fed_its_own_memory(tmp_path: Path) -> None:
    fed: list[Array] = []
    given: list[Array] = []

    def watch(feeds: Feeds, answers: Arrays) -> Arrays:
        if "recurrent_out" in answers and len(feeds["state"]) == 2:
            fed.append(feeds["recurrent_in"])
            given.append(answers["recurrent_out"])
        return answers

    assert judge(recurrent(), tmp_path, watch, checks=(rollout,), options=VerifyOptions(steps=4)).passed is True
    assert len(fed) == 4 and not fed[0].any()
    for before, now in zip(given, fed[1:], strict=False):
        assert np.array_equal(before, now) and now.any()


@pytest.mark.parametrize("step", range(4))
@pytest.mark.parametrize("output", ["action", "recurrent_out"])
def test_every_step_is_judged(step: int, output: str, tmp_path: Path) -> None:
    """Wrong once: in the memory, it goes on being wrong, and the first step is the one that is named."""
    count = iter(range(99))

    def once(feeds: Feeds, values: Array) -> Array:
        return values + np.float32(0.01 if next(count) == step else 0)

    options = VerifyOptions(steps=4)
    report = judge(recurrent(), tmp_path, spoiling(output, once), checks=(rollout,), options=options)
    found = next(f for f in report.failures if f.output == output)
    assert found.kind == "rollout" and len(found.drift) == 4
    assert all(d < 1e-5 for d in found.drift[:step]) and found.drift[step] == pytest.approx(0.01, rel=1e-3)
    assert found.bisection is not None and str(found.bisection.input) == f"step {step + 1} of 4"


def test_what_rounding_makes_of_the_last_step_excuses_no_earlier_one(tmp_path: Path) -> None:
    """A memory that grows 30 times a step: rounding moves the last by hundreds, and the first by nothing."""
    count = iter(range(99))

    def once(feeds: Feeds, values: Array) -> Array:
        return values + np.float32(0.01 if next(count) == 1 else 0)

    options = VerifyOptions(steps=7)
    policy = recurrent(30.0)
    assert judge(policy, tmp_path, checks=(rollout,), options=options).passed is True
    report = judge(policy, tmp_path, spoiling("action", once), checks=(rollout,), options=options)
    assert wrong(report) == {("rollout", "action")}


# ------------------------------------------------------------------ draws


def _classes(feeds: Feeds, drawn: Array) -> Array:
    return np.where(feeds["state"][:, :1] > 0.2, 0, drawn)


@pytest.mark.parametrize(
    "how",
    [
        _classes,
        lambda f, a: np.zeros_like(a),
        lambda f, a: np.where(a == 2, 1, a),
        lambda f, a: a + 1,
        lambda f, a: a.astype(np.int32),
        lambda f, a: a[:1].repeat(len(a), axis=0),
    ],
)
def test_classes_are_drawn_by_their_odds(how: Callable[[Feeds, Array], Array], tmp_path: Path) -> None:
    report = judge(compiled(sampled_policy()), tmp_path, spoiling("action", how))
    assert "action" in {f.output for f in report.failures}


@pytest.mark.parametrize("column", [0, 1])
@pytest.mark.parametrize(("by", "times"), [(0.3, 1.0), (0.0, 0.0), (0.0, 1.5), (np.nan, 1.0)])
def test_each_column_of_drawn_numbers_is_compared(column: int, by: float, times: float, tmp_path: Path) -> None:
    policy, center = noisy(), np.array([0.0, 0.0], np.float32)

    def one(feeds: Feeds, drawn: Array) -> Array:
        made = np.array(drawn)
        (mean,) = _means(policy, feeds)
        made[:, column] = mean[:, column] + (made[:, column] - mean[:, column]) * times + by
        return (made + center).astype(np.float32)

    report = judge(policy, tmp_path, spoiling("action", one), checks=(numbers, draws))
    assert "action" in {f.output for f in report.failures}


@pytest.mark.parametrize("column", [0, 1])
def test_each_column_is_compared_at_each_input(column: int, tmp_path: Path) -> None:
    """Moved at one input alone: all inputs together hardly show it."""
    policy, moved = noisy(), list[Array]()

    def one(feeds: Feeds, drawn: Array) -> Array:
        if len(drawn) < 4096:
            return drawn
        moved[:] = moved or [feeds["state"][3]]
        made = np.array(drawn)
        made[(feeds["state"] == moved[0]).all(axis=1), column] += (0.5, 0.2)[column]
        return made

    assert wrong(judge(policy, tmp_path, spoiling("action", one), checks=(draws,))) == {("draws", "action")}


def _means(policy: Policy, feeds: Feeds) -> Sequence[Array]:
    return [run_graph(policy.graph, dict(feeds), ["deterministic_action"])["deterministic_action"]]


# ------------------------------------------------------------------ what a finding says


def test_what_is_forgiven_is_counted(tmp_path: Path) -> None:
    """A log-probability of -∞ is said as -200: never, and nothing else is forgiven."""
    counts = []

    def never(feeds: Feeds, scores: Array) -> Array:
        counts.append(int(np.isneginf(scores).sum()))
        return np.where(np.isneginf(scores), -200, scores).astype(scores.dtype)

    report = judge(branches(0.5), tmp_path, spoiling("action", never), checks=(numbers,))
    (found,) = (f for f in report.comparisons if f.output == "action")
    assert report.passed is True and found.smallest_tolerance is None
    (forgiven,) = found.forgiven
    assert forgiven.excuse.title == "log-probabilities that say never"
    assert 0 < forgiven.elements == sum(counts) < found.elements


@pytest.mark.parametrize("by", [1e-3, 0.0])
def test_a_failure_alone_says_what_tolerance_would_do(by: float, tmp_path: Path) -> None:
    shifted = spoiling("action", lambda f, a: a + np.float32(by))
    report = judge(compiled(continuous_policy()), tmp_path, shifted, checks=(numbers,))
    (found,) = (f for f in report.comparisons if f.output == "action")
    assert (found.smallest_tolerance is None) == (by == 0)


def test_nan_beside_a_number_is_explained_or_a_fault(tmp_path: Path) -> None:
    """Where a sigmoid that is taken for zero makes NaN nothing is verified; where none is near zero it is a fault."""
    policy = logarithms()

    def logs_of(feeds: Feeds) -> Array:
        return run_graph(policy.graph, dict(feeds), ["logarithm"])["logarithm"]

    def explained(feeds: Feeds, action: Array) -> Array:
        logs = logs_of(feeds)
        taken = {**feeds, "logarithm": np.where(logs < -17, -np.inf, logs).astype(np.float32)}
        made = run_graph(policy.graph, taken, ["action"])["action"]
        return np.where(np.isnan(made), made, action)

    def unexplained(feeds: Feeds, action: Array) -> Array:
        far = np.abs(feeds["state"]).max(axis=1, initial=0) > 8
        return np.where((far & (logs_of(feeds) > -17).all(axis=1))[:, None], np.float32(np.nan), action)

    report = judge(policy, tmp_path, spoiling("action", explained), checks=(numbers,))
    assert report.passed is None, [f.explanation() for f in report.failures]
    assert "NaN or infinity beside a number" in report.undecided
    assert wrong(judge(policy, tmp_path, spoiling("action", unexplained), checks=(numbers,))) == {("numbers", "action")}
