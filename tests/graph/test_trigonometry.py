"""Arc functions of functions that end at ±1, which runtimes take some units in the last place beyond."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn import trigonometry
from export_model.converters.graph.nodes import Graph, NameScope, Node, TensorShape
from export_model.converters.graph.ops.approximations import RANGES
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import FLOAT32
from tests.graph.harness import Runtimes, policy_of

ARCS = {"asin": trigonometry.asin, "acos": trigonometry.acos, "atanh": trigonometry.atanh}
BOUNDED = [op for op, (_, high) in RANGES.items() if high < np.inf]
#: onnxruntime's tanh is 1.0000002 at 8.47554 on some processors.
NEAR_ONE = np.linspace(8, 9.1, 200_000, dtype=np.float32).reshape(-1, 4)

each_arc = pytest.mark.parametrize("arc", ARCS.values(), ids=list(ARCS))


def graph_of(arc: Callable[[Builder, str], str], op: str | None) -> Graph:
    b = Builder(NameScope(()))
    b.append(Node("x", "Placeholder", (), {"dtype": FLOAT32, "shape": TensorShape((None, 4))}))
    b.add("Identity", [arc(b, "x" if op is None else b.add(op, ["x"]))], "y")
    return b.graph()


@each_arc
@pytest.mark.parametrize("runtime", ["onnxruntime", "tensorflow"])
def test_what_a_runtime_takes_beyond_one_is_a_number(
    runtime: str, arc: Callable[[Builder, str], str], runtimes: Runtimes
) -> None:
    graph, x = graph_of(arc, "Tanh"), np.concatenate([NEAR_ONE, -NEAR_ONE])
    if runtime == "onnxruntime":
        (found,) = runtimes.onnx(policy_of(graph, ["y"]), {"x": x}, 15)
    else:
        (found,) = runtimes.tensorflow(graph, {"x": x}, ["y"])
    assert not np.isnan(found).any()


@each_arc
@pytest.mark.parametrize("op", BOUNDED)
def test_an_operand_is_cut_where_its_function_ends(op: str, arc: Callable[[Builder, str], str]) -> None:
    graph = graph_of(arc, op)
    assert any(n.op == "Minimum" and graph[n.inputs[0]].op == op for n in graph.nodes)


@each_arc
def test_beyond_one_they_are_no_numbers(arc: Callable[[Builder, str], str]) -> None:
    """As in every library: what is cut is the error of a function, not its caller's."""
    x = np.array([[1.0000002, -1.0000002, 2, -3]], np.float32)
    for op in (None, "Exp"):
        found = run_graph(graph_of(arc, op), {"x": x if op is None else np.abs(x)}, ["y"])["y"]
        assert np.isnan(found).all()
