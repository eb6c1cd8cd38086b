"""References, order and lookup in a graph."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.graph.nodes import Graph, NameScope, Node, node_of, normal_ref, ref, split_ref, topological
from export_model.signatures.errors import GraphError
from tests.signatures.nodes import constant, graph, op, placeholder


@pytest.mark.parametrize(
    ("reference", "parts"),
    [
        ("a", ("a", 0)),
        ("a:0", ("a", 0)),
        ("a:2", ("a", 2)),
        ("a/b:1", ("a/b", 1)),
        ("a:b:1", ("a:b", 1)),
        ("a:", ("a:", 0)),
        ("a:x", ("a:x", 0)),
        ("a:-1", ("a:-1", 0)),
        ("a:²", ("a:²", 0)),
        ("a:٣", ("a:٣", 0)),
        ("a:99999999999", ("a:99999999999", 0)),
        ("", ("", 0)),
    ],
)
def test_a_reference_is_a_node_and_the_number_of_its_output(reference: str, parts: tuple[str, int]) -> None:
    assert split_ref(reference) == parts
    assert node_of(reference) == parts[0]


@given(st.text(st.characters(exclude_characters=":"), min_size=1), st.integers(0, 999))
def test_references_are_made_and_taken_apart(name: str, index: int) -> None:
    assert split_ref(ref(name, index)) == (name, index)
    assert normal_ref(f"{name}:{index}") == ref(name, index)
    assert normal_ref(ref(name, index)) == ref(name, index)


@given(st.text())
def test_any_text_can_be_asked_for_its_node(text: str) -> None:
    name, index = split_ref(text)
    assert text in (name, f"{name}:{index}") or int(text.rpartition(":")[2]) == index


CHAIN = (
    placeholder("x"),
    constant("one", 1.0),
    op("a", "Add", "x", "one"),
    op("b", "Mul", "a", "a"),
    op("c", "Neg", "x"),
)


def test_nodes_are_found_by_name() -> None:
    g = graph(*CHAIN)
    assert "a" in g
    assert "d" not in g
    assert g["a"].op == "Add"
    assert g.get("d") is None
    assert g.producer("b:0").name == "b"
    with pytest.raises(KeyError):
        g["d"]


def test_two_nodes_may_not_have_one_name() -> None:
    with pytest.raises(GraphError, match="two nodes are called 'x'"):
        graph(placeholder("x"), constant("x", 1))
    with pytest.raises(GraphError, match="two nodes are called 'x'"):
        topological([placeholder("x"), constant("x", 1)])


def test_a_constant_is_seen_through_identities() -> None:
    g = graph(constant("k", 3), op("i", "Identity", "k"), op("j", "Identity", "i:0"), op("n", "Neg", "k"))
    assert g.constant("j") is g["k"].value
    assert g.constant("n") is None
    assert graph(op("i", "Identity")).constant("i") is None


def test_readers_are_listed_once_and_in_order() -> None:
    readers = graph(*CHAIN).consumers()
    assert {name: [n.name for n in found] for name, found in readers.items()} == {
        "x": ["a", "c"],
        "one": ["a"],
        "a": ["b"],
        "b": [],
        "c": [],
    }


def test_what_is_upstream_is_kept() -> None:
    g = graph(*CHAIN)
    assert g.ancestors(["b"]) == {"x", "one", "a", "b"}
    assert g.ancestors(["b"], stop=frozenset(("a",))) == {"a", "b"}
    assert [n.name for n in g.prune(["c"]).nodes] == ["x", "c"]


def test_inputs_come_before_their_readers() -> None:
    assert [n.name for n in topological(CHAIN[::-1])] == ["x", "c", "one", "a", "b"]
    assert topological(CHAIN) == CHAIN


@given(st.permutations(range(8)))
def test_any_order_is_brought_into_one_that_runs(order: list[int]) -> None:
    nodes = [placeholder("n0"), *(op(f"n{i}", "Add", f"n{i - 1}", f"n{i // 2}") for i in range(1, 8))]
    seen: set[str] = set()
    for each in topological([nodes[i] for i in order]):
        assert {node_of(r) for r in each.inputs} <= seen
        seen.add(each.name)
    assert len(seen) == 8


def test_the_back_edge_of_a_loop_is_no_cycle() -> None:
    loop = [
        placeholder("x"),
        op("enter", "Enter", "x"),
        op("merge", "Merge", "enter", "next"),
        op("next", "NextIteration", "merge"),
    ]
    assert [n.name for n in topological(loop)] == ["x", "enter", "merge", "next"]
    with pytest.raises(GraphError, match="cycle"):
        topological([*loop[:2], op("merge", "Add", "enter", "next"), loop[3]])


def test_a_dangling_input_is_named() -> None:
    with pytest.raises(GraphError, match=r"'a' \(Add\) reads 'y:1'"):
        topological([placeholder("x"), op("a", "Add", "x", "y:1")])


def test_a_deep_graph_needs_no_deep_stack() -> None:
    nodes = [placeholder("n0"), *(op(f"n{i}", "Neg", f"n{i - 1}") for i in range(1, 5000))]
    assert len(topological(nodes[::-1])) == 5000
    assert len(Graph(tuple(nodes)).ancestors(["n4999"])) == 5000


def test_a_node_is_fed_from_elsewhere_without_being_changed() -> None:
    before = op("a", "Add", "x", "y", T=1)
    after = before.with_inputs(["z"])
    assert (before.inputs, after.inputs, after.attrs) == (("x", "y"), ("z",), {"T": 1})
    assert isinstance(after, Node)


def test_names_are_handed_out_once() -> None:
    names = NameScope(["a", "a_1"])
    assert [names.fresh("a"), names.fresh("a"), names.fresh("b"), names.fresh("b")] == ["a_2", "a_3", "b", "b_1"]


def test_constants_keep_their_arrays() -> None:
    value = np.arange(3)
    assert constant("k", value).value is value
