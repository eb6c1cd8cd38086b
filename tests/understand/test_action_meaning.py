"""What an action means: numbers, draws, indices, probabilities or their logarithms, by what computes it."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.policy.action import action_meaning
from export_model.signatures.errors import SignatureError
from export_model.signatures.roles import Role
from tests.signatures.nodes import FLOAT, constant, graph, op, placeholder

INT64 = np.dtype(np.int64)


def meaning(last: list[Node], dtype: np.dtype = FLOAT, masks: bool = False) -> tuple[Role, tuple[str, ...]]:
    g = graph(
        placeholder("x"), constant("axis", 1), constant("zero", 0), op("l0", "Neg", "x"), op("l1", "Abs", "x"), *last
    )
    found = action_meaning(g, last[-1].name, dtype, masks)
    return found.role, found.branches


def test_a_float_that_is_nothing_else_is_continuous() -> None:
    assert meaning([op("action", "Tanh", "x")]) == (Role.CONTINUOUS, ())


def test_a_draw_is_sampled_and_its_logits_are_the_branches() -> None:
    one = [op("m", "Multinomial", "l0", "axis"), op("action", "Identity", "m")]
    assert meaning(one, INT64) == (Role.SAMPLED, ("l0",))
    two = [
        op("m0", "Multinomial", "l0", "axis"),
        op("m1", "Multinomial", "l1", "axis"),
        op("action", "ConcatV2", "m0", "m1", "axis"),
    ]
    assert meaning(two, INT64) == (Role.SAMPLED, ("l0", "l1"))


def test_a_branch_of_one_action_beside_draws_is_a_draw() -> None:
    """A draw of a single class is written as an ArgMax, which makes none of the branches deterministic."""
    mixed = [
        op("m0", "Multinomial", "l0", "axis"),
        op("m1", "ArgMax", "l1", "axis"),
        op("action", "ConcatV2", "m0", "m1", "axis"),
    ]
    assert meaning(mixed, INT64) == (Role.SAMPLED, ("l0", "l1"))


def test_an_argmax_is_deterministic() -> None:
    assert meaning([op("action", "ArgMax", "l0", "axis")], INT64) == (Role.DETERMINISTIC, ("l0",))
    assert meaning([op("action", "Cast", "l0")], INT64) == (Role.DETERMINISTIC, ())


@pytest.mark.parametrize("kind", ["Log", "LogSoftmax"])
def test_logarithms_are_log_probabilities(kind: str) -> None:
    parts = [op("p0", kind, "l0"), op("p1", kind, "l1"), op("action", "ConcatV2", "p0", "p1", "axis")]
    assert meaning(parts) == (Role.LOG_PROBS, ("p0", "p1"))


def test_a_softmax_is_probabilities() -> None:
    assert meaning([op("action", "Softmax", "l0")]) == (Role.PROBS, ("action",))


def test_a_masked_policy_gives_log_probabilities_however_they_are_computed() -> None:
    assert meaning([op("action", "Sub", "l0", "l1")], masks=True) == (Role.LOG_PROBS, ("action",))


def test_joins_along_another_axis_are_no_branches() -> None:
    rows = [op("p0", "Log", "l0"), op("p1", "Log", "l1"), op("action", "ConcatV2", "p0", "p1", "zero")]
    assert meaning(rows) == (Role.CONTINUOUS, ())
    packed = [
        op("m0", "ArgMax", "l0", "axis"),
        op("m1", "ArgMax", "l1", "axis"),
        op("action", "Pack", "m0", "m1", axis=1),
    ]
    assert meaning(packed, INT64) == (Role.DETERMINISTIC, ("l0", "l1"))
    packed[-1] = op("action", "Pack", "m0", "m1", axis=0)
    assert meaning(packed, INT64) == (Role.DETERMINISTIC, ())


def test_a_join_that_doubles_is_given_up() -> None:
    joins = [op("j0", "ConcatV2", "l0", "l0", "axis")]
    joins += [op(f"j{i}", "ConcatV2", f"j{i - 1}", f"j{i - 1}", "axis") for i in range(1, 40)]
    assert meaning(joins) == (Role.CONTINUOUS, ())


def test_a_long_chain_of_views_needs_no_deep_stack() -> None:
    views = [op("v0", "Reshape", "l0"), *(op(f"v{i}", "Identity", f"v{i - 1}") for i in range(1, 5000))]
    assert meaning(views) == (Role.CONTINUOUS, ())


def test_a_history_with_time_first_says_so() -> None:
    made = Graph((placeholder("x", (4, None, 3), FLOAT), Node("action", "Tanh", ("x",))))
    with pytest.raises(SignatureError, match=r"the agents' axis of the input 'x' is its second"):
        compile_graph(made, "turned")
