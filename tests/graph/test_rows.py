"""A graph for one agent, made into one for many: each row is what the graph gives for it alone."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.compiler.passes.vmap import for_every_row
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.signatures.errors import UnsupportedOpError
from tests.graph.samples import SAMPLES, Sample

ROWS = 3
#: Op → what is said, where an agent cannot have an operand of its own.
REFUSED = dict.fromkeys(("Fill", "Range", "SparseToDense", "Where", "_FusedConv2D", "_FusedMatMul"), "no form")


def others(array: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The elements of an operand in another order: what an op allows, it still is."""
    return rng.permutation(array.reshape(-1)).reshape(array.shape) if array.ndim else array


def each(sample: Sample, owned: list[str]) -> None:
    rng = np.random.default_rng(0)
    whole = sample.with_shapes(lambda shape, array: TensorShape(array.shape))
    pins = [Node(f"result{i}", "Identity", (name,)) for i, name in enumerate(sample.fetches)]
    graph = Graph((*whole.nodes, *pins))
    alone = [{name: others(a, rng) if name in owned else a for name, a in sample.feeds.items()} for _ in range(ROWS)]
    many = for_every_row(graph, [p.name for p in pins], dict.fromkeys(owned))
    together = {name: np.stack([f[name] for f in alone]) if name in owned else a for name, a in sample.feeds.items()}
    got = run_graph(many, together, [p.name for p in pins])
    for i, feeds in enumerate(alone):
        wanted = run_graph(whole, feeds, sample.fetches)
        for pin, name in zip(pins, sample.fetches, strict=True):
            value = got[pin.name] if got[pin.name].shape == wanted[name].shape else got[pin.name][i]
            np.testing.assert_allclose(value, wanted[name], 1e-6, 1e-6, err_msg=f"{sample.title}, row {i}")


@pytest.mark.parametrize("op", sorted({s.op for s in SAMPLES if not s.drawn and s.op != "Placeholder"}))
def test_each_row_is_what_it_is_alone(op: str) -> None:
    """With every operand an agent's own, and with each of them alone."""
    count = 0
    for sample in (s for s in SAMPLES if s.op == op and s.feeds and not s.drawn):
        node = sample.graph["op"]
        fed = [n for n in sample.feeds if n in sample.graph.ancestors(node.inputs)]
        for owned in {tuple(fed), *((n,) for n in fed)}:
            try:
                each(sample, list(owned))
                count += 1
            except UnsupportedOpError as error:
                assert any(
                    text in f"{error.what} {error.why}"
                    for text in ("an operand that says", "must be", REFUSED.get(op, "no such words"))
                ), (sample.title, owned, str(error))
    assert count or op in REFUSED or not any(s.feeds for s in SAMPLES if s.op == op)


def test_an_axis_of_one_becomes_that_of_the_agents_where_it_is() -> None:
    """Of a state [layers, 1, n] the second; what is read is the state for one agent."""
    nodes = [
        Node("h", "Placeholder", attrs={"dtype": np.dtype("f4"), "shape": TensorShape((2, 1, 3))}),
        Node("x", "Placeholder", attrs={"dtype": np.dtype("f4"), "shape": TensorShape((1, 3))}),
        Node("sum", "AddV2", ("h", "x")),
        Node("out", "Identity", ("sum",)),
        Node("y", "Identity", ("x",)),
    ]
    many = for_every_row(Graph(tuple(nodes)), ["out", "y"], {"h": 1, "x": 0}, {"out": 1})
    assert [many[n].attrs["shape"].dims for n in ("h", "x")] == [(2, None, 3), (None, 3)]
    h, x = np.arange(24, dtype=np.float32).reshape(2, 4, 3), np.ones((4, 3), np.float32)
    got = run_graph(many, {"h": h, "x": x}, ["out", "y"])
    np.testing.assert_array_equal(got["out"], h + x)
    np.testing.assert_array_equal(got["y"], x)
