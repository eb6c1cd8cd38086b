"""The outputs beside an action: without chance, and log-probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.passes.outputs import LOG_PROBS, add_companions
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import INT64
from export_model.converters.policy.action import ActionMeaning
from export_model.converters.policy.brains import Head
from export_model.signatures.roles import Role
from tests.graph.harness import Array
from tests.graph.making import const, graph, node, ops, placeholder
from tests.graph.running import gaussian, mean, value
from tests.graph.samples import floats, ints

pytestmark = pytest.mark.xdist_group("graph-passes")


ACTION = Head("action", "action")


def companions(made: Graph, role: Role, branches: Sequence[str] = (), **more: str) -> tuple[Graph, dict[str, str]]:
    meaning = ActionMeaning(role, tuple(branches))
    return add_companions(made, {"action": "action", **more}, ACTION, meaning, {"epsilon": (None, 2)})


def test_continuous_with_noise_gets_its_mean() -> None:
    made, fetches = companions(gaussian(in_graph=True), Role.CONTINUOUS)
    assert fetches.keys() == {"action", "deterministic_action"}
    x = floats(4, 3)
    np.testing.assert_allclose(value(made, {"x": x}, fetches["deterministic_action"]), mean(x), rtol=1e-6)


def test_continuous_without_noise_is_its_own_companion() -> None:
    made = graph(placeholder("x", (None, 2)), node("action", "Tanh", "x"))
    after, fetches = companions(made, Role.CONTINUOUS)
    assert after is made
    assert fetches == {"action": "action", "deterministic_action": "action"}


SIZES = (3, 2)


def branches(kind: str) -> tuple[Graph, list[str]]:
    """A policy of two branches: its "action", and the tensor of each branch."""
    logits = [placeholder("x", (None, 5)), const("axis", 1), const("sizes", list(SIZES))]
    logits.append(node("logits", "SplitV", "x", "sizes", "axis", num_split=2))
    parts = ["logits", "logits:1"]
    if kind == "sampled":
        inner = [node(f"draw_{i}", "Multinomial", p, "one", output_dtype=INT64) for i, p in enumerate(parts)]
        inner = [const("one", 1), *inner]
        made, found = ["draw_0", "draw_1"], parts
    else:
        op = {"log_probs": "LogSoftmax", "probs": "Softmax"}[kind]
        inner = [node(f"branch_{i}", op, p) for i, p in enumerate(parts)]
        made = found = ["branch_0", "branch_1"]
    return graph(*logits, *inner, node("action", "ConcatV2", *made, "axis")), found


def log_softmax(x: Array) -> Array:
    return x - np.log(np.exp(x.astype(np.float64)).sum(axis=1, keepdims=True))


@pytest.mark.parametrize("kind", ["sampled", "log_probs", "probs"])
def test_discrete_actions_get_the_best_of_each_branch(kind: str) -> None:
    before, found = branches(kind)
    made, fetches = companions(before, Role[kind.upper()], found)
    x = floats(6, 5)
    best = value(made, {"x": x}, fetches["deterministic_action"])
    expected = np.stack([x[:, :3].argmax(1), x[:, 3:].argmax(1)], axis=1)
    np.testing.assert_array_equal(best, expected, strict=True)
    assert infer_types(made)[fetches["deterministic_action"]].dtype == INT64
    if kind == "sampled":
        expected = np.concatenate([log_softmax(x[:, :3]), log_softmax(x[:, 3:])], axis=1)
        np.testing.assert_allclose(value(made, {"x": x}, fetches[LOG_PROBS]), expected, atol=1e-6)
    else:
        assert LOG_PROBS not in fetches


def test_one_branch_is_not_joined() -> None:
    before = graph(
        placeholder("x", (None, 3)), const("one", 1), node("action", "Multinomial", "x", "one", output_dtype=INT64)
    )
    made, fetches = companions(before, Role.SAMPLED, ["x"])
    assert "ConcatV2" not in ops(made)
    x = floats(4, 3)
    np.testing.assert_allclose(value(made, {"x": x}, fetches[LOG_PROBS]), log_softmax(x), atol=1e-6)
    np.testing.assert_array_equal(
        value(made, {"x": x}, fetches["deterministic_action"]), x.argmax(1)[:, None], strict=True
    )


@pytest.mark.parametrize(
    ("shape", "dtype"), [((3,), np.int32), ((3,), np.int64), ((3, 2), np.int32), ((3, 2), np.int64)]
)
def test_an_integer_action_is_its_own_companion_in_columns(shape: tuple[int, ...], dtype: Any) -> None:
    before = graph(placeholder("x", (None, *shape[1:]), dtype), node("action", "Abs", "x"))
    made, fetches = companions(before, Role.DETERMINISTIC)
    x = ints(*shape, dtype=dtype)
    expected = np.abs(x).astype(np.int64).reshape(3, -1)
    np.testing.assert_array_equal(value(made, {"x": x}, fetches["deterministic_action"]), expected, strict=True)


def test_companions_that_the_source_has_stay() -> None:
    before, found = branches("sampled")
    own = {"deterministic_action": "logits", LOG_PROBS: "logits:1"}
    made, fetches = companions(before, Role.SAMPLED, found, **own)
    assert fetches == {"action": "action", **own}
    assert [n.name for n in made.nodes] == [n.name for n in before.nodes]
    before = gaussian(in_graph=True)
    made, fetches = companions(before, Role.CONTINUOUS, deterministic_action="mu")
    assert made is before
    assert fetches["deterministic_action"] == "mu"


def test_a_hybrid_s_second_action_has_names_of_its_own() -> None:
    before, found = branches("sampled")
    head = Head("discrete_actions", "discrete_actions")
    meaning = ActionMeaning(Role.SAMPLED, tuple(found))
    made, fetches = add_companions(before, {"discrete_actions": "action"}, head, meaning, {})
    assert fetches.keys() == {"discrete_actions", "deterministic_discrete_actions", LOG_PROBS}
    x = floats(6, 5)
    best = value(made, {"x": x}, fetches["deterministic_discrete_actions"])
    np.testing.assert_array_equal(best[:, 1], x[:, 3:].argmax(1))
