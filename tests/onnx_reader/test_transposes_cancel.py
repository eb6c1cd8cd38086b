"""The pass that takes transposes out: how many are left, and that nothing else changes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.passes.transposes import cancel_transposes
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from tests.onnx_reader.models import Array, floats

NHWC, NCHW = [0, 2, 3, 1], [0, 3, 1, 2]
X = floats(2, 3, 4, 5)


class Draft:
    """A graph in the making; ``x`` is its input [B, 3, 4, 5]."""

    def __init__(self) -> None:
        shape = {"dtype": np.dtype(np.float32), "shape": TensorShape((None, 3, 4, 5))}
        self.start = Graph((Node("x", "Placeholder", attrs=shape, origin="x"),))
        self.editor = Editor(self.start)
        self.editor.keep(self.start.nodes[0])

    def add(self, op: str, *inputs: str, name: str = "", **attrs: Any) -> str:
        return self.editor.add(op, inputs, name or op, name or None, **attrs)

    def turn(self, x: str, order: Sequence[int], name: str = "turn") -> str:
        return self.add("Transpose", x, self.const(np.array(order, np.int32)), name=name)

    def const(self, value: Any) -> str:
        return self.editor.const(np.asarray(value), "const")


def there_and_back(d: Draft) -> list[str]:
    return [d.add("Relu", d.turn(d.turn("x", NHWC), NCHW))]


def across_activations(d: Draft) -> list[str]:
    y = d.add("Tanh", d.add("Mul", d.turn("x", NHWC), d.const(np.float32(2))))
    return [d.add("Abs", d.turn(y, NCHW))]


def across_a_channel_constant(d: Draft) -> list[str]:
    y = d.add("Add", d.turn("x", NHWC), d.const(floats(3, seed=1)))
    y = d.add("Sub", d.const(floats(1, 4, 1, 1, seed=2)), y)
    return [d.turn(y, NCHW)]


def a_sum_of_two(d: Draft) -> list[str]:
    a, b = d.add("Relu", d.turn("x", NHWC)), d.add("Neg", d.turn("x", NHWC))
    return [d.turn(d.add("Maximum", a, b), NCHW)]


def joined(d: Draft) -> list[str]:
    return [d.turn(d.turn("x", [0, 2, 1, 3]), [0, 1, 3, 2])]


def read_in_both_orders(d: Draft) -> list[str]:
    turned = d.turn("x", NHWC, name="middle")
    total = d.add("Sum", turned, d.const(np.array([3], np.int32)), keep_dims=False)
    return [d.turn(d.add("Exp", turned), NCHW), total]


def an_inner_one_that_is_fetched(d: Draft) -> list[str]:
    middle = d.turn("x", NHWC, name="middle")
    return [d.turn(d.add("Relu", middle), NCHW), middle]


def shapes_of_other_ranks(d: Draft) -> list[str]:
    y = d.add("Mul", d.turn("x", NHWC), d.const(floats(1, 1, 1, 1, seed=3)))
    return [d.turn(d.add("Add", y, d.const(np.ones((1, 1), np.float32))), NCHW)]


def in_different_orders(d: Draft) -> list[str]:
    a, b = d.turn("x", [0, 2, 1, 3]), d.turn(d.turn("x", NHWC), [0, 1, 3, 2])
    return [d.turn(d.add("Add", a, b), [0, 2, 1, 3])]


def a_single_one(d: Draft) -> list[str]:
    return [d.add("Relu", d.turn("x", NHWC))]


def select_chooses_rows(d: Draft) -> list[str]:
    a = d.turn("x", NHWC)
    chosen = d.add("Select", d.add("Greater", a, d.const(np.float32(0))), a, d.add("Neg", a))
    return [d.turn(chosen, NCHW)]


#: what is built → how many transposes are left
GRAPHS: Mapping[str, tuple[Callable[[Draft], list[str]], int]] = {
    f.__name__: (f, count)
    for f, count in (
        (there_and_back, 0),
        (across_activations, 0),
        (across_a_channel_constant, 0),
        (a_sum_of_two, 0),
        (joined, 1),
        (read_in_both_orders, 1),
        (an_inner_one_that_is_fetched, 1),
        (shapes_of_other_ranks, 0),
        (in_different_orders, 0),
        (a_single_one, 1),
        (select_chooses_rows, 2),
    )
}


@pytest.mark.parametrize("name", GRAPHS)
def test_fewer_transposes_and_the_same_numbers(name: str) -> None:
    build, left = GRAPHS[name]
    draft = Draft()
    fetches = {f"y{i}": reference for i, reference in enumerate(build(draft))}
    graph = draft.editor.graph()
    result, moved = cancel_transposes(graph, fetches)
    assert sum(n.op == "Transpose" for n in result.nodes) == left
    before, after = values(graph, fetches), values(result, moved)
    for key in fetches:
        np.testing.assert_array_equal(after[key], before[key])


def values(graph: Graph, fetches: Mapping[str, str]) -> dict[str, Array]:
    results = run_graph(graph, {"x": X}, list(fetches.values()))
    return {key: results[reference] for key, reference in fetches.items()}


def test_names_and_origins_stay_with_what_they_name() -> None:
    draft = Draft()
    first, middle = an_inner_one_that_is_fetched(draft)
    result, moved = cancel_transposes(draft.editor.graph(), {"y": first, "m": middle})
    assert result[moved["m"]].origin == "middle"
    assert result[moved["m"]].op == "Transpose"
    origins = {n.origin for n in result.nodes if n.origin is not None}
    assert origins <= {"x", "middle", "turn", "Relu"}


def test_a_graph_with_nothing_to_gain_is_left_alone() -> None:
    draft = Draft()
    (output,) = select_chooses_rows(draft)
    graph = draft.editor.graph()
    assert cancel_transposes(graph, {"y": output})[0] is graph
