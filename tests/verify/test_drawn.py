"""What is drawn, judged in a file that is cut at its samplers: the numbers that follow, the odds, the sampler alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.policy.policy import Policy
from export_model.exporter.verify.checks.draws import (
    CALLED_ALIKE,
    MISFED,
    STARTED_ALIKE,
    STILL_DRAWN,
    draws,
)
from export_model.exporter.verify.participants import write_reference
from export_model.exporter.verify.report import ParityReport
from tests.handmade import constant, dense, node, placeholder, sampled_policy
from tests.verify.judged import Arrays, Feeds, compiled, judge_file
from tests.verify.test_judge import noisy

Array = npt.NDArray[Any]
NORMAL = "random_normal/RandomStandardNormal"
LOGITS = "logits"


def two_branches(first: str = "first", second: str = "second", widths: tuple[int, int] = (3, 2)) -> Policy:
    """Two branches of three and two classes, drawn by a sampler each."""
    nodes = [placeholder("vector_observation")]
    for name, width in zip((first, second), widths, strict=True):
        nodes += [
            *dense(f"{name}_logits", "vector_observation", 3, width),
            constant(f"{name}_one", 1),
            node(
                f"{name}_draw", "Multinomial", f"{name}_logits", f"{name}_one", output_dtype=np.int64, seed=1, seed2=2
            ),
        ]
    return compiled(
        [
            *nodes,
            constant("axis", 1),
            node("action", "ConcatV2", f"{first}_draw", f"{second}_draw", "axis", N=2, T=np.int64, Tidx=np.int32),
        ]
    )


def single() -> Policy:
    return compiled(sampled_policy())


POLICIES: dict[str, Callable[[], Policy]] = {"numbers": noisy, "classes": single, "branches": two_branches}


def anew(feeds: Feeds, answers: Arrays) -> Arrays:
    """As a runtime that is started again: no draw is like another's."""
    rng = np.random.default_rng()
    kinds = {n: a.dtype.kind for n, a in answers.items()}
    return {
        n: (rng.integers(0, 2, a.shape) if kinds[n] == "i" else a + rng.standard_normal(a.shape).astype(a.dtype))
        for n, a in answers.items()
    }


def judged(
    policy: Policy, folder: Path, how: dict[str, Callable[[Feeds, Array], Any]] | None = None, **options: Any
) -> ParityReport:
    """A file some of whose tensors are what ``how`` makes of the inputs and of what they are."""

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        changes = how or {}
        return {n: np.asarray(changes[n](feeds, a), a.dtype) if n in changes else a for n, a in answers.items()}

    return judge_file(policy, folder, spoil, checks=(draws,), **options)


def faults(report: ParityReport) -> list[tuple[str, str, str]]:
    return [(f.kind, f.output, f.reason) for f in report.failures]


@pytest.mark.parametrize("name", POLICIES)
def test_what_is_drawn_rightly_passes(name: str, tmp_path: Path) -> None:
    report = judged(POLICIES[name](), tmp_path, again=anew)
    assert report.passed is True, faults(report)
    assert {f.output for f in report.comparisons} == {"action"} and report.notes == ()


def _where(feeds: Feeds) -> Array:
    return np.asarray(feeds["state"])[:, :1] > 0.2


# ------------------------------------------------------------------ what follows from draws


@pytest.mark.parametrize(
    "change",
    [
        lambda f, a: a * 0,
        lambda f, a: a + 5 * _where(f),
        lambda f, a: a + 1e-3,
        lambda f, a: a[:1].repeat(len(a), axis=0),
        lambda f, a: a * np.array([1, 0]),
        lambda f, a: a + np.array([0, 3e-5]),
        lambda f, a: np.where(_where(f), np.nan, a),
    ],
)
def test_numbers_that_follow_from_noise_are_compared(change: Callable[[Feeds, Array], Array], tmp_path: Path) -> None:
    (fault,) = faults(judged(noisy(), tmp_path, {"action": change}))
    assert fault[1] == "action" and (fault[0] == "numbers" or CALLED_ALIKE in fault[2])


@pytest.mark.parametrize("policy", ["classes", "branches"])
@pytest.mark.parametrize(
    "change", [lambda f, a: a * 0, lambda f, a: np.where(_where(f), 0, a), lambda f, a: a[:1].repeat(len(a), axis=0)]
)
def test_classes_that_follow_from_classes_are_compared(
    policy: str, change: Callable[[Feeds, Array], Array], tmp_path: Path
) -> None:
    (fault,) = faults(judged(POLICIES[policy](), tmp_path, {"action": change}))
    assert fault[1] == "action"


# ------------------------------------------------------------------ what is drawn from


def _scores(policy: Policy, branch: int = 0) -> str:
    return [n.inputs[0] for n in policy.graph.nodes if n.op == "Multinomial"][branch]


@pytest.mark.parametrize(
    ("branch", "change"),
    [
        (0, lambda f, a: a * 1.01),
        (1, lambda f, a: a[:, ::-1]),
        (1, lambda f, a: a + _where(f) * np.array([1, 0])),
    ],
)
def test_odds_are_compared(branch: int, change: Callable[[Feeds, Array], Array], tmp_path: Path) -> None:
    policy = two_branches()
    report = judged(policy, tmp_path, {_scores(policy, branch): change})
    (fault,) = report.failures
    assert (fault.kind, fault.output) == ("numbers", "action")
    assert "the log-probabilities that its classes are drawn from differ by" in fault.reason
    assert fault.bisection is not None and fault.bisection.tensor == _scores(policy, branch)


def test_logits_that_are_moved_alike_are_the_same_odds(tmp_path: Path) -> None:
    policy = two_branches()
    report = judged(policy, tmp_path, {_scores(policy): lambda f, a: a + 4})
    assert report.passed is True, faults(report)


def test_odds_that_no_tensor_tells_of_are_the_samplers(tmp_path: Path) -> None:
    """Right wherever they are looked at, and wrong where the sampler reads them."""
    policy = two_branches()
    name = _scores(policy)

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        alone = set(answers) == {name} or "action" not in answers
        return answers if alone else {n: a * np.float32(1.5) if n == name else a for n, a in answers.items()}

    (fault,) = judge_file(policy, tmp_path, spoil, checks=(draws,)).failures
    assert fault.bisection is not None and fault.bisection.reason == MISFED
    assert fault.bisection.op == "Multinomial"


# ------------------------------------------------------------------ the sampler alone


def _normal(change: Callable[[Array], Array]) -> dict[str, Callable[[Feeds, Array], Array]]:
    return {NORMAL: lambda f, a: change(a)}


@pytest.mark.parametrize(
    "change",
    [
        lambda a: a * 1.15,
        lambda a: a + 0.15,
        lambda a: a[:1].repeat(len(a), axis=0),
        lambda a: np.repeat(a[::2], 2, axis=0)[: len(a)],
        lambda a: a[:, :1].repeat(2, axis=1),
        lambda a: a.clip(-1, 1),
        lambda a: np.where(a > 3, np.nan, a),
        lambda a: a * np.array([1, 1.2]),
        lambda a: np.abs(a),
    ],
)
def test_noise_is_normal_and_independent(change: Callable[[Array], Array], tmp_path: Path) -> None:
    (fault,) = judged(noisy(), tmp_path, _normal(change)).failures
    assert (fault.kind, fault.output) == ("draws", "action")
    assert fault.bisection is not None and fault.bisection.tensor == NORMAL
    assert fault.bisection.reason == "what it draws from agrees, what it draws does not"


def _draw(policy: Policy, branch: int) -> str:
    return [n.name for n in policy.graph.nodes if n.op == "Multinomial"][branch]


@pytest.mark.parametrize("branch", [0, 1])
@pytest.mark.parametrize(
    "change",
    [
        lambda a: a * 0,
        lambda a: a[:1].repeat(len(a), axis=0),
        lambda a: a + 1,
        lambda a: a - 1,
        lambda a: np.where(np.arange(len(a))[:, None] % 12 == 0, 0, a),
    ],
)
def test_a_sampler_of_classes_draws_by_its_odds(branch: int, change: Callable[[Array], Array], tmp_path: Path) -> None:
    policy = two_branches()
    name = _draw(policy, branch)
    (fault,) = judged(policy, tmp_path, {name: lambda f, a: change(a)}).failures
    assert (fault.kind, fault.output) == ("draws", "action")
    assert fault.bisection is not None and fault.bisection.tensor == name


def test_two_samplers_draw_apart(tmp_path: Path) -> None:
    """Each is right by itself; together one uniform number serves both."""
    policy = two_branches()
    names = [_draw(policy, i) for i in range(2)]
    scores = [_scores(policy, i) for i in range(2)]

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        if not {*names, *scores} <= set(answers):
            return answers
        lots = np.random.default_rng(0).random(len(answers[names[0]]))
        made = dict(answers)
        for name, score in zip(names, scores, strict=True):
            odds = np.exp(answers[score].astype(np.float64))
            below = np.cumsum(odds / odds.sum(axis=1, keepdims=True), axis=1)
            made[name] = (lots[:, None] > below[:, :-1]).sum(axis=1)[:, None]
        return made

    (fault,) = judge_file(policy, tmp_path, spoil, checks=(draws,)).failures
    assert "one draw serves several" in fault.reason


# ------------------------------------------------------------------ what draws where the policy does not


def test_what_still_draws_is_a_fault(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    report = judged(noisy(), tmp_path, {"action": lambda f, a: a + 1e-3 * rng.random()})
    assert [f.reason for f in report.failures] == [STILL_DRAWN]


@pytest.mark.parametrize("name", ["numbers", "branches"])
def test_a_seed_plays_one_game(name: str, tmp_path: Path) -> None:
    """After every start alike, or in every call."""
    policy = POLICIES[name]()
    report = judge_file(policy, tmp_path, again=lambda f, a: a, checks=(draws,))
    (fault,) = report.failures
    assert fault.reason.startswith(STARTED_ALIKE) and fault.kind == "draws"
    assert fault.reason.endswith("(branch 0, 1 of 2)") is (name == "branches")
    kept: dict[tuple[str, ...], Arrays] = {}

    def same(feeds: Feeds, answers: Arrays) -> Arrays:
        if set(feeds) != {"state"} or len(feeds["state"]) != 512:
            return answers
        return kept.setdefault(tuple(answers), answers)

    (fault,) = judge_file(policy, tmp_path / "calls", same, again=anew, checks=(draws,)).failures
    assert fault.reason.startswith(CALLED_ALIKE)


def test_one_branch_of_two_that_repeats_is_named(tmp_path: Path) -> None:
    policy = two_branches()
    kept: list[Array] = []

    def half(feeds: Feeds, action: Array) -> Array:
        if set(feeds) != {"state"} or len(action) != 512:
            return action
        kept.append(action)
        return np.stack([action[:, 0], kept[0][:, 1]], axis=1)

    (fault,) = judged(policy, tmp_path, {"action": half}).failures
    assert fault.reason == f"{CALLED_ALIKE} (branch 1 of 2)"


def test_a_source_that_starts_alike_allows_it(tmp_path: Path) -> None:
    policy = noisy()
    report = judge_file(policy, tmp_path, again=lambda f, a: a, checks=(draws,), seeded=True)
    assert report.passed is True and [STARTED_ALIKE in note for note in report.notes] == [True]


# ------------------------------------------------------------------ files of other tools


def written(policy: Policy, folder: Path) -> Path:
    return write_reference(policy, folder, "other")


def _by_distribution(report: ParityReport) -> list[str]:
    return [note for note in report.notes if "compared by distribution" in note]


def _lifted() -> Policy:
    nodes = [
        placeholder("vector_observation"),
        *dense("mean", "vector_observation", 3, 2),
        node("size", "Shape", "mean", T=np.float32, out_type=np.int32),
        node(NORMAL, "RandomStandardNormal", "size", dtype=np.float32, T=np.int32),
        constant("spread", np.array([0.5, 0.2], np.float32)),
        node("scaled", "Mul", NORMAL, "spread", T=np.float32),
        node("action", "Add", "mean", "scaled", T=np.float32),
    ]
    return compiled(nodes)


def _without_noise(policy: Policy) -> Callable[[Feeds], Feeds]:
    noise = {s.name for s in policy.signature.noise}
    return lambda feeds: {n: a for n, a in feeds.items() if n not in noise}


@pytest.mark.parametrize(
    ("output", "change", "kind"),
    [
        ("", lambda f, a: a, ""),
        ("action", lambda f, a: a + 5 * _where(f), "numbers"),
        ("action", lambda f, a: a + np.array([0, 3e-5]), "numbers"),
        (NORMAL, lambda f, a: a * 1.15, "draws"),
        (NORMAL, lambda f, a: a[:, :1].repeat(2, axis=1), "draws"),
    ],
)
def test_a_candidate_that_draws_what_the_policy_is_fed_is_cut(
    output: str, change: Callable[[Feeds, Array], Array], kind: str, tmp_path: Path
) -> None:
    policy = _lifted()
    file = written(noisy(), tmp_path)
    report = judged(
        policy, tmp_path, {output: change}, file=file, fed=_without_noise(policy), drawn=frozenset({"action"})
    )
    assert {f[:2] for f in faults(report)} == ({(kind, "action")} if kind else set()), faults(report)
    assert not _by_distribution(report) and any(f.output == "action" for f in report.comparisons)


@pytest.mark.parametrize("names", [("x", "a"), ("a", "x")])
@pytest.mark.parametrize("widths", [(3, 2), (2, 2)])
def test_samplers_of_other_names_are_found_by_trying(
    names: tuple[str, str], widths: tuple[int, int], tmp_path: Path
) -> None:
    """Whichever comes first in the file; where both fit in shape their odds tell them apart."""
    policy = two_branches(widths=widths)
    other = two_branches(*names, widths=widths)
    file = written(other, tmp_path)
    report = judged(policy, tmp_path, file=file, fed=lambda feeds: feeds)
    assert not report.failures and report.notes == (), (faults(report), report.notes)
    scores = _scores(other, 1)
    wrong = judged(policy, tmp_path, {scores: lambda f, a: a * 1.5}, file=file, fed=lambda feeds: feeds)
    assert {f.output for f in wrong.failures} == {"action"}


def test_a_candidate_with_other_samplers_is_compared_by_distribution(tmp_path: Path) -> None:
    """Its noise is of another kind; the note says why, and what the test sees."""
    report = judged(noisy(), tmp_path, file=written(truncated(), tmp_path), fed=lambda feeds: feeds)
    (note,) = _by_distribution(report)
    assert "as its samplers are not those of the policy: a shift of half" in note and "action" in note
    assert faults(report)


# ------------------------------------------------------------------ files that draw otherwise


def truncated() -> Policy:
    """Two numbers of a normal distribution that is cut at two deviations."""
    nodes = [
        placeholder("vector_observation"),
        *dense("mean", "vector_observation", 3, 2),
        node("size", "Shape", "mean", T=np.float32, out_type=np.int32),
        node("noise/Sampler", "TruncatedNormal", "size", dtype=np.float32, T=np.int32),
        node("action", "Add", "mean", "noise/Sampler", T=np.float32),
    ]
    return compiled(nodes, CompileOptions(noise="keep"))


@pytest.mark.parametrize(
    ("change", "right"), [(lambda a: a, True), (lambda a: a * 0.88, False), (lambda a: a + 0.1, False)]
)
def test_other_kinds_of_noise_are_of_their_own_kind(
    change: Callable[[Array], Array], right: bool, tmp_path: Path
) -> None:
    report = judged(truncated(), tmp_path, {"noise/Sampler": lambda f, a: change(a)})
    assert report.passed is right, faults(report)
