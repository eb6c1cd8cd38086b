"""Which tensor of one policy is which of another's, by signatures alone: names, roles, shapes, order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pytest
from msgspec.structs import replace

from export_model.converters.formats.format import Port
from export_model.converters.policy.policy import Policy
from export_model.exporter.compare.fit import misfit
from export_model.exporter.compare.pairing import (
    alike,
    axes_to,
    draws,
    pair_policies,
    source_name,
    source_names,
)
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec
from tests.handmade import continuous_policy, sampled_policy
from tests.verify.judged import compiled
from tests.verify.test_drawn import two_branches
from tests.verify.test_judge import branches, noisy

B = None


def spec(name: str, role: Role, *shape: int | None, source: Any = None, dtype: str = "float32") -> TensorSpec:
    return TensorSpec(name, role, dtype, (B, *shape), source)


def vector(name: str, size: int | None, source: Any = None) -> TensorSpec:
    return spec(name, Role.VECTOR, size, source=source)


def policy(
    inputs: Sequence[TensorSpec], outputs: Sequence[TensorSpec] = (), made: Policy | None = None, space: str = ""
) -> Policy:
    base = made or compiled(continuous_policy())
    outputs = [*outputs] or [*base.signature.outputs]
    space = space or base.signature.action_space
    signature = replace(base.signature, inputs=tuple(inputs), outputs=tuple(outputs), action_space=space)
    return replace(base, signature=signature)


def paired(
    ours: Sequence[TensorSpec], theirs: Sequence[TensorSpec], names: Mapping[str, str] | None = None
) -> Mapping[str, str]:
    return pair_policies(policy(ours), policy(theirs), names).inputs


# ------------------------------------------------------------------ inputs


def test_names_go_before_shapes_and_shapes_before_order() -> None:
    ours = [vector("a", 3, "one"), vector("b", 3, "two"), vector("c", 4)]
    theirs = [vector("x", 4, "else"), vector("y", 3, "two:0"), vector("z", 3, "serving_default_other")]
    assert paired(ours, theirs) == {"a": "z", "b": "y", "c": "x"}


def test_a_name_of_another_shape_or_role_is_another_tensor() -> None:
    ours = [vector("a", 3, "one"), vector("b", 4, "two")]
    theirs = [vector("x", 4, "one"), vector("y", 3, "two")]
    assert paired(ours, theirs) == {"a": "y", "b": "x"}
    mask = spec("m", Role.MASKS, 3, source="one")
    assert paired([vector("a", 3, "one")], [mask]) == {}
    assert paired([vector("a", 3, "one"), mask], [mask, vector("y", 3, "two")]) == {"a": "y", "m": "m"}


def test_tensors_without_a_source_share_no_name() -> None:
    made = pair_policies(policy([vector("a", 3), vector("b", 3)]), policy([vector("x", 3), vector("y", 3)]))
    assert made.inputs == {"a": "x", "b": "y"} and made.by_order == ("vector_observation",)
    named = pair_policies(
        policy([vector("a", 3, "s"), vector("b", 3, "t")]), policy([vector("x", 3, "t"), vector("y", 3, "s")])
    )
    assert named.inputs == {"a": "y", "b": "x"} and named.by_order == ()


def test_order_is_said_where_it_alone_decides() -> None:
    """Of three that fit, two are paired by order; the last has one left."""
    made = pair_policies(
        policy([vector("a", 3), vector("b", 3), spec("n", Role.NOISE, 2)]),
        policy([vector("x", 3), vector("y", 3), spec("m", Role.NOISE, 2)]),
    )
    assert made.by_order == ("vector_observation",)
    sole = pair_policies(policy([vector("a", 3), vector("b", 4)]), policy([vector("y", 4), vector("x", 3)]))
    assert sole.inputs == {"a": "x", "b": "y"} and sole.by_order == ()
    named = pair_policies(policy([vector("a", 3, "s")]), policy([vector("x", 3, "s"), vector("y", 3), vector("z", 3)]))
    assert named.inputs == {"a": "x"} and named.by_order == ()


@pytest.mark.parametrize("key", ["a", "one"])
@pytest.mark.parametrize("value", ["x", "theirs"])
def test_what_a_user_says_goes_first(key: str, value: str) -> None:
    """By either file's names, whatever the role and the shape."""
    ours, theirs = [vector("a", 3, "one"), vector("b", 3)], [vector("y", 3), spec("x", Role.MASKS, 7, source="theirs")]
    assert paired(ours, theirs, {key: value}) == {"a": "x", "b": "y"}
    assert paired(ours, theirs, {"nowhere": value}) == {"a": "y"}
    assert paired(ours, theirs, {key: "nowhere"}) == {"a": "y"}


def test_what_one_side_alone_has_is_said() -> None:
    made = pair_policies(
        policy([vector("a", 3), spec("n", Role.NOISE, 2)]), policy([vector("x", 3), spec("m", Role.MASKS, 2)])
    )
    assert (made.lacking, made.surplus, made.joined) == (("n",), ("m",), ((), ()))


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("parts", "joined"),
    [
        ([vector("x", 1), vector("y", 2)], True),
        ([vector("x", 1), vector("y", 3)], False),
        ([vector("x", 1), vector("y", None)], False),
        ([vector("x", 3), vector("y", None)], False),
        ([vector("x", 1), spec("y", Role.MASKS, 2)], False),
        ([spec("x", Role.VECTOR, 1, 1), vector("y", 2)], False),
        ([vector("x", 1), vector("y", 1), vector("z", 1)], True),
    ],
)
def test_one_vector_is_several_that_are_as_wide(parts: list[TensorSpec], joined: bool, turned: bool) -> None:
    sides = [[vector("a", 3)], parts]
    made = pair_policies(*(policy(side) for side in (sides[::-1] if turned else sides)))
    names = (("a",), tuple(p.name for p in parts)) if joined else ((), ())
    assert made.joined == (names[::-1] if turned else names)
    if joined:
        assert made.lacking == made.surplus == ()
    two = pair_policies(policy([vector("a", 1), vector("b", 4)]), policy([vector("x", 2), vector("y", 3)]))
    assert two.joined == ((), ()), "several on both sides"


# ------------------------------------------------------------------ shapes


@pytest.mark.parametrize(
    ("shape", "other", "order"),
    [
        ((B, 3), (B, 3), (0, 1)),
        ((B, 3), (5, 3), (0, 1)),
        ((7, 3), (5, 3), (0, 1)),
        ((B, 3), (B, B), (0, 1)),
        ((B, 3), (B, 4), None),
        ((B, 3), (B, 3, 1), None),
        ((B, 8, 9, 3), (B, 3, 8, 9), (0, 3, 1, 2)),
        ((B, 3, 8, 9), (B, 8, 9, 3), (0, 2, 3, 1)),
        ((B, 8, 9, 3), (B, 8, 9, 3), (0, 1, 2, 3)),
        ((B, 8, 9, 3), (B, 9, 8, 3), None),
        ((B, 9, 3), (B, 3, 9), None),
        ((), (), ()),
    ],
)
def test_axes_are_in_an_order_that_gives_the_shape(shape: Any, other: Any, order: Any) -> None:
    assert axes_to(shape, other) == order


@pytest.mark.parametrize(
    ("shape", "other", "same"),
    [
        ((3,), (1, 3), True),
        ((1, 3), (3, 1), True),
        ((1,), (), True),
        ((3,), (4,), False),
        ((3, 4), (4, 3), False),
        ((2, 3), (6,), False),
        ((8, 9, 3), (3, 8, 9), True),
    ],
)
def test_tensors_are_alike_that_hold_the_same_numbers(shape: Any, other: Any, same: bool) -> None:
    assert alike(spec("a", Role.OTHER, *shape), spec("b", Role.OTHER, *other)) is same


def test_the_source_calls_a_tensor_without_its_index() -> None:
    assert source_names(vector("a", 3, "serving_default_x:0")) == {"x"} and source_names(vector("a", 3)) == frozenset()
    assert source_names(vector("a", 3, ("x:0", "y:1"))) == {"x", "y:1"}
    assert source_name(vector("a", 3, "x:0")) == "x"
    assert source_name(vector("a", 3, ("x",))) is None and source_name(vector("a", 3)) is None


# ------------------------------------------------------------------ actions


def _action(name: str, role: Role, *shape: int | None, source: Any = None) -> TensorSpec:
    return spec(name, role, *shape, source=source, dtype="int64" if role is Role.SAMPLED else "float32")


PLAIN, DRAWN, CLASSES = compiled(continuous_policy()), noisy(), compiled(sampled_policy())


def test_what_hangs_on_noise_is_drawn() -> None:
    assert [draws(p) for p in (PLAIN, DRAWN, CLASSES)] == [False, True, True]
    (head,) = CLASSES.signature.heads
    assert draws(CLASSES, head) and head.plain is not None
    assert not draws(DRAWN, replace(DRAWN.signature.heads[0], spec=DRAWN.signature.output("deterministic_action")))


def test_drawn_actions_are_drawn_ones_and_plain_ones_plain() -> None:
    for each in (PLAIN, DRAWN, CLASSES):
        made = pair_policies(each, each)
        assert made.outputs == {s.name: s.name for s in each.signature.outputs}
        assert made.apart == () and made.incomparable == {Role.SAMPLED} and made.reshaped == ()


#: The action alone, as another tool writes it.
BARE = policy(PLAIN.signature.inputs, PLAIN.signature.outputs[:1], PLAIN)
NOISY_ALONE = policy(DRAWN.signature.inputs, DRAWN.signature.outputs[:1], DRAWN)
SCORES = branches(0.5)
SCORES_ALONE = policy(SCORES.signature.inputs, SCORES.signature.outputs[:1], SCORES)


@pytest.mark.parametrize(
    ("sides", "outputs"),
    [
        ((DRAWN, PLAIN), {"deterministic_action": "deterministic_action"}),
        ((DRAWN, BARE), {"deterministic_action": "action"}),
        ((PLAIN, DRAWN), {"action": "deterministic_action", "deterministic_action": "deterministic_action"}),
        ((BARE, DRAWN), {"action": "deterministic_action"}),
        ((NOISY_ALONE, PLAIN), {}),
    ],
)
def test_where_one_side_draws_what_is_without_chance_is_compared(
    sides: tuple[Policy, Policy], outputs: dict[str, str]
) -> None:
    made = pair_policies(*sides)
    assert made.outputs == outputs
    drawing, other = ("the reference", "the candidate") if draws(sides[0]) else ("the candidate", "the reference")
    assert [f"{drawing} draws action and {other} does not" in note for note in made.apart] == [True]
    assert made.incomparable == {Role.SAMPLED, Role.LOG_PROB, Role.CONTINUOUS}


@pytest.mark.parametrize(
    ("sides", "outputs"),
    [
        ((BARE, PLAIN), {"action": "action"}),
        ((PLAIN, BARE), {"action": "action", "deterministic_action": "action"}),
        ((SCORES, SCORES_ALONE), {"action": "action"}),
        ((SCORES_ALONE, SCORES), {"action": "action"}),
    ],
)
def test_an_action_without_chance_is_its_own_companion(sides: tuple[Policy, Policy], outputs: dict[str, str]) -> None:
    assert pair_policies(*sides).outputs == outputs


def test_what_follows_from_a_draw_is_compared_only_where_both_draw() -> None:
    log_prob = spec("log_prob", Role.LOG_PROB, 1)
    drawing = policy(DRAWN.signature.inputs, [*DRAWN.signature.outputs, log_prob], DRAWN)
    plain = policy(PLAIN.signature.inputs, [*PLAIN.signature.outputs, log_prob], PLAIN)
    assert "log_prob" in pair_policies(drawing, drawing).outputs
    assert "log_prob" not in pair_policies(drawing, plain).outputs


def test_classes_are_no_numbers() -> None:
    assert not {"action", "deterministic_action"} & pair_policies(PLAIN, CLASSES).outputs.keys()
    assert not {"action", "deterministic_action"} & pair_policies(CLASSES, PLAIN).outputs.keys()
    two = two_branches()
    for pair in ((PLAIN, two), (two, PLAIN)):
        assert "deterministic_action" not in pair_policies(*pair).outputs, "of one shape, and of one role"


def test_actions_of_other_roles_are_compared_without_chance_alone() -> None:
    bare = replace(PLAIN.signature.outputs[0], role=Role.DETERMINISTIC)
    chosen = policy(PLAIN.signature.inputs, [bare], PLAIN)
    assert pair_policies(chosen, BARE).outputs == {"action": "action"}
    scores = policy(SCORES.signature.inputs, [replace(SCORES.signature.outputs[0], role=Role.PROBS)], SCORES)
    assert pair_policies(SCORES_ALONE, scores).outputs == {}


def test_other_outputs_are_paired_by_role() -> None:
    value, other = spec("value_estimate", Role.VALUE, 1), spec("q", Role.VALUE, 1, 1)
    ours = policy(PLAIN.signature.inputs, [*PLAIN.signature.outputs, value], PLAIN)
    theirs = policy(PLAIN.signature.inputs, [*PLAIN.signature.outputs, other], PLAIN)
    made = pair_policies(ours, theirs)
    assert made.outputs["value_estimate"] == "q" and len(made.reshaped) == 1 and "q is [B, 1, 1]" in made.reshaped[0]
    assert pair_policies(theirs, ours, {"q": "action"}).outputs["q"] == "value_estimate", "actions are no others"
    memory = spec("m", Role.MEMORY_OUT, 1)
    kept = policy(ours.signature.inputs, [*PLAIN.signature.outputs, memory], PLAIN)
    assert pair_policies(ours, kept, {"value_estimate": "m"}).outputs["value_estimate"] == "m", "what a user says"
    assert (
        "value_estimate"
        not in pair_policies(ours, policy(ours.signature.inputs, [ours.signature.outputs[0], memory])).outputs
    )


# ------------------------------------------------------------------ what an input takes


@pytest.mark.parametrize(
    ("port", "word"),
    [
        (Port("x", "float32", (B, 3)), ""),
        (Port("x", None, (B, 3)), ""),
        (Port("x", "float32", None), ""),
        (Port("x", "float32", (B, B)), ""),
        (Port("x", "float64", (B, 3)), "is float64"),
        (Port("x", "int64", (B, 3)), "is int64"),
        (Port("x", "float32", (B, 4)), "has the shape [?, 4]"),
        (Port("x", "float32", (B, 3, 1)), "has the shape"),
        (Port("x", "float32", (1, 3)), "takes 1 rows only"),
        (Port("x", "float64", (1, 4)), "is float64"),
    ],
)
def test_an_input_takes_what_the_reference_takes(port: Port, word: str) -> None:
    found = misfit(vector("a", 3), port)
    assert bool(found) is bool(word) and word in found


def test_integers_are_as_wide_as_they_like() -> None:
    steps = TensorSpec("n", Role.OTHER, "int64", ())
    assert misfit(steps, Port("n", "int32", ())) == "" and misfit(steps, Port("n", "bool", ())) == ""
    assert "float32" in misfit(steps, Port("n", "float32", ()))
    assert misfit(TensorSpec("n", Role.PARAMETER, "float32", (4, 2)), Port("n", "float32", (4, 2))) == ""
    assert misfit(TensorSpec("n", Role.PARAMETER, "float32", (4, 2)), Port("n", "float32", (4, None))) == ""
