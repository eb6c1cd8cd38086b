"""Inputs and outputs under the signature's names."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

from export_model.converters.compiler.passes.naming import name_tensors
from export_model.converters.graph.nodes import Graph, Node
from tests.graph.making import const, graph, node, placeholder
from tests.graph.running import value
from tests.graph.samples import floats

pytestmark = pytest.mark.xdist_group("graph-passes")


def named(made: Graph, feeds: Mapping[str, str], fetches: Mapping[str, str], *reserved: str) -> Graph:
    """The renamed graph, after its outputs have been held against what they were."""
    after = name_tensors(made, feeds, fetches, reserved)
    arrays = {n.name: floats(3, 4, seed=len(n.name)) for n in made.nodes if n.op == "Placeholder"}
    moved = {new: arrays[old] for new, old in feeds.items()}
    for name, reference in fetches.items():
        np.testing.assert_array_equal(value(after, moved, name), value(made, arrays, reference), strict=True)
    assert {n.name for n in after.nodes if n.op == "Placeholder"} == feeds.keys()
    return after


def test_the_node_that_makes_an_output_takes_its_name() -> None:
    made = graph(placeholder("obs", (None, 4)), node("inner/Tanh", "Tanh", "obs"), node("y", "Neg", "inner/Tanh"))
    after = named(made, {"state": "obs"}, {"action": "y", "value_estimate": "inner/Tanh"})
    assert [(n.name, n.op, n.inputs, n.origin) for n in after.nodes] == [
        ("state", "Placeholder", (), "obs:0"),
        ("value_estimate", "Tanh", ("state",), "inner/Tanh:0"),
        ("action", "Neg", ("value_estimate",), "y:0"),
    ]


def test_inner_nodes_give_way() -> None:
    made = graph(
        placeholder("x", (None, 4)),
        node("action", "Neg", "x"),
        node("state", "Exp", "action"),
        node("action/inner", "Tanh", "state"),
        node("contract", "Abs", "action/inner"),
        node("y", "Neg", "contract"),
    )
    after = named(made, {"state": "x"}, {"action": "y"}, "contract")
    assert [n.name for n in after.nodes] == [
        "state", "action/inner_1", "state/inner", "action/inner", "contract/inner", "action",
    ]  # fmt: skip
    assert after["action/inner_1"].origin == "action:0"


def test_inputs_may_swap_names() -> None:
    made = graph(placeholder("a", (None, 4)), placeholder("b", (None, 4)), node("y", "Sub", "a", "b"))
    after = named(made, {"a": "b", "b": "a"}, {"y": "y"})
    assert after["y"].inputs == ("b", "a")


def test_one_tensor_may_be_two_outputs() -> None:
    made = graph(placeholder("x", (None, 4)), node("y", "Neg", "x"))
    after = named(made, {"x": "x"}, {"action": "y", "deterministic_action": "y"})
    assert [(n.name, n.op, n.inputs, n.origin) for n in after.nodes[1:]] == [
        ("action", "Neg", ("x",), "y:0"),
        ("deterministic_action", "Identity", ("action",), "y:0"),
    ]


def test_an_output_may_be_an_input_or_a_constant() -> None:
    made = graph(placeholder("x", (None, 4)), const("c", floats(3, 4)))
    after = named(made, {"state": "x"}, {"action": "x", "value_estimate": "c"})
    assert [(n.name, n.op, n.inputs) for n in after.nodes] == [
        ("state", "Placeholder", ()),
        ("c", "Const", ()),
        ("action", "Identity", ("state",)),
        ("value_estimate", "Identity", ("c",)),
    ]


def test_outputs_of_a_node_with_several_get_nodes_of_their_own() -> None:
    made = graph(
        const("axis", 1),
        placeholder("x", (None, 4)),
        node("action", "Split", "axis", "x", num_split=2),
        node("z", "Neg", "action"),
    )
    after = named(made, {"x": "x"}, {"action": "action:1", "other": "action", "z": "z"})
    assert after["action"] == Node("action", "Identity", ("action/inner:1",))
    # what is output 0 alone is named itself, unless another output of the node is one too
    assert after["other"].op == "Identity"
    assert after["z"].inputs == ("action/inner",)
