"""Laws of shapes, on many random ones: broadcasting, reshaping and arithmetic, with symbols and with numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import BATCH, INT32, Dim, Symbols, broadcast
from export_model.signatures.errors import GraphError
from tests import conftest
from tests.graph.harness import fitting
from tests.graph.making import const, defaults, placeholder

#: The same examples in every run: a failure is about the change at hand.
examples = conftest.examples(150, derandomize=True)


# ------------------------------------------------------------------ broadcasting

shapes = st.lists(st.integers(1, 3), max_size=4).map(tuple)
dims = st.one_of(st.integers(1, 3), st.sampled_from([BATCH, "other"]))
symbolic = st.lists(dims, max_size=3).map(tuple)


@examples
@given(shapes, shapes)
def test_broadcast_is_numpys(a: tuple[int, ...], b: tuple[int, ...]) -> None:
    try:
        expected = np.broadcast_shapes(a, b)
    except ValueError:
        with pytest.raises(ValueError, match="broadcast"):
            broadcast(a, b, Symbols())
    else:
        assert broadcast(a, b, Symbols()) == expected


@examples
@given(symbolic, symbolic, st.integers(1, 3), st.booleans())
def test_broadcast_of_symbols_is_numpys_of_their_lengths(
    a: tuple[Dim, ...], b: tuple[Dim, ...], batch: int, same: bool
) -> None:
    """A free length that meets the batch is taken to be the batch or 1."""
    lengths = {BATCH: batch, "other": batch if same else 1}

    def put(shape: Sequence[Dim]) -> tuple[int, ...]:
        return tuple(lengths[d] if isinstance(d, str) else d for d in shape)

    try:
        expected = np.broadcast_shapes(put(a), put(b))
    except ValueError:
        assume(False)
    result = broadcast(a, b, Symbols())
    assert result is not None
    assert len(result) == len(expected)
    for said, length in zip(result, expected, strict=True):
        assert lengths.get(said, length) == length if isinstance(said, str) else said == length


# ------------------------------------------------------------------ shapes


@st.composite
def regroupings(draw: st.DrawFn) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """A shape, and another one of as many elements."""
    factors = draw(st.lists(st.sampled_from([1, 2, 2, 3, 5]), min_size=1, max_size=5))

    def grouped(order: list[int]) -> tuple[int, ...]:
        cuts = sorted(draw(st.sets(st.integers(1, max(len(order) - 1, 1)), max_size=3)))
        parts = np.split(np.array(order), [c for c in cuts if c < len(order)])
        return tuple(int(np.prod(p)) for p in parts)

    return grouped(factors), grouped(draw(st.permutations(factors)))


@examples
@given(regroupings(), st.data())
def test_reshape_finds_the_open_length(case: tuple[tuple[int, ...], tuple[int, ...]], data: st.DataObject) -> None:
    shape, target = case
    free = data.draw(st.booleans())
    open_axis = data.draw(st.one_of(st.none(), st.integers(0, len(target) - 1)))
    wanted = [-1 if i == open_axis else n for i, n in enumerate(target)]
    array = np.arange(math.prod(shape), dtype=np.float32).reshape(shape)
    nodes = [placeholder("x", (None, *shape[1:]) if free else shape), const("to", wanted)]
    graph = Graph((*nodes, Node("op", "Reshape", ("x", "to"))))
    assert fitting(graph, "op", {"x": array}, len(array)) == []
    assert run_graph(graph, {"x": array}, ["op"])["op"].shape == target
    if not free:
        assert infer_types(graph)["op"].shape == target


@examples
@given(regroupings(), st.integers(2, 7))
def test_reshape_refuses_what_does_not_fit(case: tuple[tuple[int, ...], tuple[int, ...]], factor: int) -> None:
    shape, target = case
    nodes = placeholder("x", shape), const("to", (*target, factor)), Node("op", "Reshape", ("x", "to"))
    with pytest.raises(GraphError, match="'op'"):
        infer_types(Graph(nodes))


@st.composite
def arithmetic(draw: st.DrawFn) -> tuple[Graph, str, tuple[int, ...]]:
    """(graph, tensor, shape of the fed image) that computes with the shape of a batch of images, as flattening does."""
    inner = tuple(draw(st.lists(st.integers(1, 4), min_size=1, max_size=3)))
    rank = len(inner) + 1
    nodes = [placeholder("x", (None, *inner)), Node("shape", "Shape", ("x",), {"out_type": INT32})]
    vectors, scalars = {"shape": rank}, list[str]()  # vectors with their lengths

    def add(op: str, inputs: Sequence[str], **attrs: Any) -> str:
        name = f"n{len(nodes)}"
        nodes.append(Node(name, op, tuple(inputs), {**defaults(op), **attrs}))
        return name

    def number(value: Any) -> str:
        name = f"n{len(nodes)}"
        nodes.append(const(name, value))
        return name

    for _ in range(draw(st.integers(1, 7))):
        vector = draw(st.sampled_from(list(vectors)))
        length = vectors[vector]
        step = draw(st.sampled_from(["take", "cut", "gather", "product", "times", "pack", "join", "wrap", "cast"]))
        first = draw(st.integers(0, length - 1))
        last = draw(st.integers(first + 1, length))
        if step == "take":
            cell = [number([v]) for v in (first, first + 1, 1)]
            scalars.append(add("StridedSlice", [vector, *cell], shrink_axis_mask=1))
        elif step == "cut":
            op = draw(st.sampled_from(["Slice", "StridedSlice"]))
            ends = [number([first]), number([last - first])] if op == "Slice" else [number([first]), number([last])]
            vectors[add(op, [vector, *ends, *([number([1])] if op == "StridedSlice" else [])])] = last - first
        elif step == "gather":
            order = draw(st.lists(st.integers(0, length - 1), min_size=1, max_size=3))
            vectors[add("GatherV2", [vector, number(order), number(0)])] = len(order)
        elif step == "product":
            keep = draw(st.booleans())
            made = add("Prod", [vector, number([0])], keep_dims=keep)
            if keep:
                vectors[made] = 1
            else:
                scalars.append(made)
        elif step == "times":
            vectors[add("Mul", [vector, number(draw(st.integers(1, 3)))])] = length
        elif step == "join":
            other = draw(st.sampled_from(list(vectors)))
            vectors[add("ConcatV2", [vector, other, number(0)])] = length + vectors[other]
        elif step == "cast":
            vectors[add("Cast", [add("Cast", [vector], DstT=np.dtype(np.int64))], DstT=INT32)] = length
        elif scalars and step == "pack":
            parts = draw(st.lists(st.sampled_from(scalars), min_size=1, max_size=3))
            vectors[add("Pack", [*parts, number(draw(st.integers(1, 5)))])] = len(parts) + 1
        elif scalars:
            vectors[add("ExpandDims", [draw(st.sampled_from(scalars)), number(0)])] = 1
    name = draw(st.sampled_from([*vectors, *scalars]))
    return Graph(tuple(nodes)), name, inner


@examples
@given(arithmetic(), st.integers(1, 5))
def test_shape_arithmetic_with_symbols_is_that_of_numbers(case: tuple[Graph, str, tuple[int, ...]], batch: int) -> None:
    graph, name, inner = case
    feeds = {"x": np.zeros((batch, *inner), np.float32)}
    assert fitting(graph, name, feeds, batch) == []
    known = infer_types(graph)[name].value
    assert known is not None
    if batch > 1 and known.dtype != object:
        other = {"x": np.zeros((batch + 1, *inner), np.float32)}
        np.testing.assert_array_equal(run_graph(graph, other, [name])[name], known)
