"""Parts of the judge by themselves: what is stated of an action, decisions, what has no number, what noise is fed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from msgspec.structs import replace

from export_model.converters.interfaces.isaac_lab import RAW_ACTION
from export_model.converters.policy.policy import Policy
from export_model.exporter.verify.baked import apply_stated
from export_model.exporter.verify.checks.decisions import _choices, _play_steps, compare_decisions
from export_model.exporter.verify.checks.numbers import numbers
from export_model.exporter.verify.cut import NEVER, cut_policy
from export_model.exporter.verify.original import Original
from export_model.exporter.verify.participants import policy_under_test
from export_model.exporter.verify.rounding import hull
from export_model.signatures.interface import Interface, Quantity, Range, Term
from export_model.signatures.sampling import draw_typical
from export_model.signatures.spec import PolicySignature
from tests.handmade import constant, continuous_policy, node, placeholder, sampled_policy
from tests.verify.judged import compiled, judge, spoiling
from tests.verify.test_judge import branches, noisy, recurrent

Array = npt.NDArray[Any]


def stating(*terms: Term, limit: tuple[Range, ...] = ()) -> PolicySignature:
    """A signature of two numbers of which ``terms`` are stated, and a limit of the raw action."""
    limits = (Quantity(name=RAW_ACTION, clip=limit, source="here"),) if limit else ()
    signature = compiled(continuous_policy()).signature
    return replace(signature, interface=Interface(actions=terms, limits=limits))


@pytest.mark.parametrize(
    ("terms", "limit", "expected"),
    [
        ((Term(name="a", source="x"),), (), [-3, 2]),
        ((Term(name="a", scale=(2.0,), offset=(0.5,), source="x"),), (), [-5.5, 4.5]),
        ((Term(name="a", scale=(2.0, 3.0), offset=(0.5, -1.0), source="x"),), (), [-5.5, 5]),
        ((Term(name="a", scale=(2.0,), clip=((-1.0, None), (None, 1.5)), source="x"),), (), [-1, 1.5]),
        ((Term(name="a", scale=(2.0,), source="x"),), ((-1.0, 1.0), (-1.0, 1.0)), [-2, 2]),
        (
            (Term(name="a", size=1, scale=(2.0,), source="x"), Term(name="b", size=1, offset=(1.0,), source="x")),
            (),
            [-6, 3],
        ),
        ((), (), [-3, 2]),
    ],
)
def test_what_is_stated_of_an_action_is_applied(
    terms: tuple[Term, ...], limit: tuple[Range, ...], expected: list[float]
) -> None:
    signature = stating(*terms, limit=limit)
    raw = np.array([[-3, 2]], np.float32)
    answers = {"action": raw, "deterministic_action": raw, "value_estimate": raw}
    made = apply_stated(signature, answers)
    for name, wanted in (("action", [expected]), ("deterministic_action", [expected]), ("value_estimate", [[-3, 2]])):
        np.testing.assert_array_equal(made[name], np.array(wanted, np.float32))
        assert made[name].dtype == np.float32
    assert apply_stated(replace(signature, interface=None), answers) == answers


def test_a_nan_is_clipped_to_nothing() -> None:
    signature = stating(Term(name="a", clip=((-1.0, 1.0),), source="x"))
    made = apply_stated(signature, {"action": np.array([[np.nan, 5]], np.float32)})["action"]
    assert np.isnan(made[0, 0]) and made[0, 1] == 1


# ------------------------------------------------------------------ decisions of rounded weights


def test_a_decision_is_the_best_of_each_branch() -> None:
    signature = branches(0.5).signature
    scores = np.array([[-1, -2, -3, -0.5], [-2, -1, -0.5, -3]], np.float32)
    assert _choices(signature, "action", scores).tolist() == [[0, 1], [1, 0]]
    assert _choices(signature, "action", scores[:, :3]).tolist() == [[0], [2]]
    classes = np.array([[1, 0]])
    assert _choices(signature, "deterministic_action", classes) is classes


@pytest.mark.parametrize(
    ("was", "made", "share"),
    [
        ([[0], [1], [2], [3]], [[0], [1], [2], [4]], 0.25),
        ([[0.0], [2.0]], [[0.1], [1.9]], 0.1),
        ([[5.0], [5.0]], [[5.0], [5.0]], 0.0),
        ([[1000.0], [1000.0]], [[1000.1], [1000.1]], 0.1),
        ([[0.0], [0.0]], [[0.1], [0.1]], np.inf),
        ([[0.0, 0.0], [2.0, 20.0]], [[0.0, 1.0], [2.0, 19.0]], 0.1),
        ([[0.0], [np.nan]], [[0.0], [1.0]], np.inf),
        ([[0.0], [1.0]], [[0.0, 1.0]], np.inf),
        ([[np.inf], [1.0], [3.0]], [[np.inf], [1.0], [3.0]], 0.0),
        ([[np.inf], [3.0], [3.0]], [[np.inf], [3.0], [0.0]], 3**0.5 / 2**0.5),  # an infinity hides no other
    ],
)
def test_how_far_decisions_move(was: Any, made: Any, share: float) -> None:
    off, said = compare_decisions(np.array(was), np.array(made))
    assert off == pytest.approx(share, rel=1e-6) and said


def test_steps_are_played_with_the_memory_fed_back() -> None:
    signature = recurrent().signature
    steps = draw_typical(signature, seed=0, count=3)
    fed: list[Array] = []

    def ask(feeds: Any) -> dict[str, Array]:
        fed.append(feeds["recurrent_in"])
        return {"recurrent_out": feeds["recurrent_in"] + 1}

    assert len(list(_play_steps(signature, steps, ask))) == 3
    assert [float(f.flat[0]) for f in fed] == [0, 1, 2]


# ------------------------------------------------------------------ what has no number


def test_an_output_without_a_number_is_not_decided(tmp_path: Path) -> None:
    nodes = [
        *(placeholder("vector_observation"), constant("least", -1e9)),
        node("moved", "Minimum", "vector_observation", "least", T=np.float32),
        node("action", "Sqrt", "moved", T=np.float32),
        node("value_estimate", "Identity", "vector_observation", T=np.float32),
    ]
    report = judge(compiled(nodes), tmp_path, checks=(numbers,))
    assert report.passed is None and not [f for f in report.failures if f.judges]
    undecided = {f.output for f in report.comparisons if f.kind == "undecided"}
    assert "action" in undecided and "value_estimate" not in undecided


def test_half_of_an_output_is_not_enough_and_less_is_said(tmp_path: Path) -> None:
    """NaN on both sides in half of all elements at ordinary inputs: nothing is verified; in a quarter, it is said."""

    def root(least: float) -> Policy:
        nodes = [
            *(placeholder("vector_observation"), constant("least", least)),
            node("moved", "Add", "vector_observation", "least", T=np.float32),
            node("action", "Sqrt", "moved", T=np.float32),
        ]
        return compiled(nodes)

    few, many = (judge(root(least), tmp_path, checks=(numbers,)) for least in (1.5, -0.5))
    assert few.passed is True and many.passed is None
    (said,) = (f for f in few.comparisons if f.output == "action")
    assert [f.excuse.title for f in said.forgiven] == ["NaN on both sides"] and 0 < said.forgiven[0].elements < 0.5 * (
        said.elements
    )


# ------------------------------------------------------------------ ends, cuts, what the source derives


@pytest.mark.parametrize(
    ("zero", "kept", "whole", "answer", "right"),
    [
        (1.0, 1.0, 1.0, 1.0, False),  # the ends are not apart
        (1.0, 2.0, 1.5, 1.2, True),
        (1.0, 2.0, 1.5, 3.0, True),  # as far again beyond
        (1.0, 2.0, 1.5, 3.1, False),
        (1.0, 2.0, 4.0, 7.0, True),
        (1.0, 2.0, 4.0, -2.1, False),
        (-np.inf, -87.0, -100.0, -97.0, True),
        (-np.inf, -87.0, -100.0, np.nan, False),
        (np.nan, 1.0, 2.0, 2.5, True),
        (np.nan, np.nan, 1.0, 1.0, False),
    ],
)
def test_an_answer_lies_between_the_ends(zero: float, kept: float, whole: float, answer: float, right: bool) -> None:
    ends = [np.array([x]) for x in (zero, kept, whole)]
    found = hull(ends, np.array([kept]), 0.0)
    assert found.holds(np.array([answer])).tolist() == [right]
    assert found.nan.tolist() == [bool(np.isnan(zero) != np.isnan(kept))]


def test_each_element_lies_between_its_own_ends() -> None:
    """One is open; rounding makes it wider, and opens no other."""
    ends = [np.array([[1.0], [5.0]]), np.array([[2.0], [5.0]]), np.array([[1.5], [5.0]])]
    for rounding, far in ((0.0, 3.0), (0.5, 3.5)):
        found = hull(ends, np.array([[2.0], [5.0]]), rounding)
        assert found.open.tolist() == [[True], [False]]
        assert found.holds(np.array([[far], [5.0]])).tolist() == [[True], [False]]
        assert found.holds(np.array([[far + 0.01], [5.0]])).tolist() == [[False], [False]]
    (_, marked), *others = found.forgive(np.array([[1.5], [5.0]]), np.array([[2.0], [5.0]]), ordinary=True)
    assert marked.tolist() == [[True], [False]] and not others, "at ordinary inputs what float64 says alone"
    (_, marked), *_ = found.forgive(np.array([[1.6], [5.0]]), np.array([[2.0], [5.0]]), ordinary=True)
    assert not marked.any()


@pytest.mark.parametrize(("policy", "kind"), [(noisy, "normal"), (lambda: compiled(sampled_policy()), "categorical")])
def test_a_policy_is_cut_at_its_samplers(policy: Any, kind: str, tmp_path: Path) -> None:
    tested = policy_under_test(policy(), {}, tmp_path, sizes={})
    cut = cut_policy(tested, tmp_path / "cut")
    assert cut is not None
    (sampler,) = cut.samplers
    assert (sampler.kind, sampler.given) == (kind, False)
    assert (sampler.odds is not None) == (kind == "categorical")
    assert "action" in cut.actions[sampler.name] and "deterministic_action" not in cut.actions[sampler.name]
    assert {s.name for s in cut.tested.signature.inputs} == {"state", sampler.name}
    assert cut.tested.reference.exists() and NEVER < -20


def test_a_policy_without_samplers_is_not_cut(tmp_path: Path) -> None:
    assert cut_policy(policy_under_test(compiled(continuous_policy()), {}, tmp_path, sizes={}), tmp_path) is None


def test_what_the_source_lacks_is_derived_from_its_logits() -> None:
    policy = compiled(sampled_policy())
    logits = np.array([[1, 3, 2], [9, -9, 0]], np.float32)

    class Model:
        def run_all(self, inputs: Any, fetch: Any, requests: Any = ()) -> list[dict[str, Array]]:
            return [dict.fromkeys(fetch, logits) for _ in inputs]

    original = Original(Model(), policy.signature, policy.source)  # type: ignore[arg-type]
    assert {"deterministic_action", "action_log_probs"} <= original.output_names
    answers = original.run({"state": np.zeros((2, 3), np.float32)})
    assert answers["deterministic_action"].tolist() == [[1], [0]]
    np.testing.assert_allclose(np.exp(answers["action_log_probs"]).sum(axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(np.diff(answers["action_log_probs"]), np.diff(logits), rtol=1e-6)
    assert "action" not in answers


def test_a_rule_of_another_output_changes_nothing(tmp_path: Path) -> None:
    shifted = spoiling("action", lambda f, a: a + np.float32(1e-4))
    assert judge(compiled(continuous_policy()), tmp_path, shifted, checks=(numbers,)).passed is False
