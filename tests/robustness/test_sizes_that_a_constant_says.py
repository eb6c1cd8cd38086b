"""A few bytes in a graph may say how much memory an op takes: it is refused before it is taken.

``Fill``, ``Range``, ``Tile`` and their like make as many elements as a constant says; so do declared shapes of
placeholders, and the numbers of pieces of ``Split`` and ``Unpack``. The policy beside them is right.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.run import run_graph
from export_model.signatures.errors import ExportModelError, GraphError
from tests.commands import export_model, files_in, is_refused
from tests.handmade import NodeDef, constant, graph_bytes, node, placeholder

#: What a graph of some hundred bytes may make the compiler allocate.
MODEST = 64 << 20
BIG = 1 << 20
X = "vector_observation"
#: Where no more than 32 bits are to be had.
WIDE = 2**31 - 1


def ints(name: str, *values: int) -> NodeDef:
    return constant(name, values, np.int64)


def policy(made: Sequence[NodeDef]) -> list[NodeDef]:
    """``action`` = the observation plus the mean of what ``big`` makes."""
    return [placeholder(X), *made, *_mean(), node("action", "Add", X, "mean")]


def _mean() -> list[NodeDef]:
    flat = constant("flat", np.array([-1], np.int32))
    axis = constant("axis", np.array([0], np.int32))
    return [flat, axis, node("line", "Reshape", "big", "flat"), node("mean", "Mean", "line", "axis", keep_dims=False)]


def fill(*dims: int) -> list[NodeDef]:
    return [ints("dims", *dims), constant("value", 0.5), node("big", "Fill", "dims", "value")]


def spread(*dims: int) -> list[NodeDef]:
    return [ints("dims", *dims), constant("value", 0.5), node("big", "BroadcastTo", "value", "dims")]


def tile(times: int) -> list[NodeDef]:
    return [ints("times", times), constant("value", [0.5]), node("big", "Tile", "value", "times")]


def steps(limit: float, delta: float) -> list[NodeDef]:
    return [
        *(constant(n, np.float32(v)) for n, v in (("from", 0.0), ("to", limit), ("by", delta))),
        node("big", "Range", "from", "to", "by"),
    ]


def one_hot(depth: int) -> list[NodeDef]:
    return [
        constant("class", [0], np.int64),
        constant("depth", np.array(depth, np.int32)),
        *(constant("on", 1.0), constant("off", 0.0)),
        node("big", "OneHot", "class", "depth", "on", "off", axis=-1),
    ]


def pad(before: int, after: int) -> list[NodeDef]:
    return [
        constant("value", [0.5]),
        constant("pads", [[before, after]], np.int64),
        node("big", "Pad", "value", "pads"),
    ]


def padded_observation(after: int) -> list[NodeDef]:
    pads = constant("pads", [[0, 0], [0, after]], np.int64)
    return [pads, node("big", "Pad", X, "pads")]


def repeated_observation(times: int) -> list[NodeDef]:
    return [ints("times", 1, times), node("big", "Tile", X, "times")]


def outer_product(side: int) -> list[NodeDef]:
    """Two lines whose sum is a square."""
    return [
        *(ints("high", side, 1), ints("wide", 1, side), constant("value", 0.5)),
        *(node("column", "Fill", "high", "value"), node("row", "Fill", "wide", "value")),
        node("big", "Add", "column", "row"),
    ]


def gathered(count: int) -> list[NodeDef]:
    """A row of a matrix, again and again."""
    return [
        *(constant("rows", np.zeros((1, 1 << 12), np.float32)), ints("dims", count)),
        constant("zero", np.array(0, np.int32)),
        *(node("which", "Fill", "dims", "zero"), constant("first", np.array(0, np.int32))),
        node("big", "GatherV2", "rows", "which", "first"),
    ]


def unpacked(count: int) -> list[NodeDef]:
    return [constant("value", [0.5]), node("big", "Unpack", "value", num=count, axis=0)]


def split(count: int) -> list[NodeDef]:
    zero = constant("zero", np.array(0, np.int32))
    return [zero, constant("value", [0.5]), node("big", "Split", "zero", "value", num_split=count)]


CASES = {
    "Fill": fill(BIG, BIG),
    "Fill whose product wraps round": fill(1 << 32, 1 << 32),
    "Fill beyond 64 bits": fill(*[1 << 40] * 4),
    "BroadcastTo": spread(BIG, BIG),
    "Tile": tile(1 << 40),
    "Tile of the observation": repeated_observation(1 << 40),
    "Range": steps(1e12, 1.0),
    "Range of small steps": steps(1.0, 1e-30),
    "Range without end": steps(1.0, 0.0),
    "Range to infinity": steps(float("inf"), 1.0),
    "Range from nowhere": steps(float("nan"), 1.0),
    "OneHot": one_hot(WIDE),
    "Pad": pad(1 << 40, 0),
    "Pad of the observation": padded_observation(1 << 40),
    "Pad that cuts and adds": pad(-(1 << 40), 1 << 41),
    "an outer product": outer_product(1 << 16),
    "GatherV2": gathered(1 << 18),
    "Unpack": unpacked(1 << 60),
    "Split": split(1 << 60),
    "Split into less than nothing": split(-1),
    "Unpack into nothing": unpacked(0),
}


@pytest.mark.parametrize("case", CASES)
def test_it_is_refused_before_it_is_allocated(case: str, tmp_path: Path) -> None:
    data = graph_bytes(policy(CASES[case]))
    assert len(data) < 1 << 16
    graph = read_graph(data)
    tracemalloc.start()
    try:
        with pytest.raises((GraphError, ExportModelError)) as caught:
            compile_graph(graph, "policy")
        assert tracemalloc.get_traced_memory()[1] < MODEST
    finally:
        tracemalloc.stop()
    assert "MemoryError" not in str(caught.value)
    file = tmp_path / "policy.bytes"
    file.write_bytes(data)
    is_refused(export_model(file, "-o", tmp_path / "out", "--verify", "none"), file, "node '")
    assert files_in(tmp_path) == {"policy.bytes"}


@pytest.mark.parametrize("made", [fill(4, 3), spread(4, 3), tile(5), steps(2.0, 0.25), one_hot(6), pad(2, 1)])
def test_the_same_ops_with_modest_sizes_are_read(made: list[NodeDef]) -> None:
    """Without this the test above could pass on graphs that are wrong for another reason."""
    (read,) = compile_graph(read_graph(graph_bytes(policy(made))), "policy")
    rows = np.ones((2, 3), np.float32)
    found = run_graph(read.graph, {"state": rows}, ["action"])["action"]
    means = {"Fill": 0.5, "BroadcastTo": 0.5, "Tile": 0.5, "Range": 0.875, "OneHot": 1 / 6, "Pad": 0.125}
    np.testing.assert_allclose(found, 1 + means[made[-1].op], rtol=1e-6)


def test_a_range_has_the_elements_that_tensorflow_gives_it() -> None:
    """ceil((limit − start) / delta), for steps down and empty ones too (TensorFlow's range_op.cc)."""
    for start, limit, delta, count in ((0, 5, 2, 3), (5, 0, -2, 3), (0, 0, 1, 0), (3, 1, 1, 0), (0, 6, 2, 3)):
        made = [
            *(constant(n, np.array(v, np.int32)) for n, v in (("from", start), ("to", limit), ("by", delta))),
            node("line", "Range", "from", "to", "by"),
            node("count", "Size", "line", out_type=np.int32),
            node("real", "Cast", "count", SrcT=np.int32, DstT=np.float32),
        ]
        graph = read_graph(graph_bytes([placeholder(X), *made, node("action", "Add", X, "real")]))
        (read,) = compile_graph(graph, "policy")
        assert run_graph(read.graph, {"state": np.zeros((1, 3), np.float32)}, ["action"])["action"][0, 0] == count


def test_a_placeholder_of_any_size_is_refused() -> None:
    nodes = [placeholder(X, (None, 1 << 40)), node("action", "Tanh", X)]
    with pytest.raises(GraphError, match="makes a tensor of"):
        compile_graph(read_graph(graph_bytes(nodes)), "policy")


def test_a_value_for_a_placeholder_of_any_size_is_refused() -> None:
    nodes = [placeholder(X), placeholder("scale", (1 << 40,)), node("action", "Mul", X, "scale")]
    with pytest.raises(GraphError, match="'scale' takes"):
        compile_graph(read_graph(graph_bytes(nodes)), "policy", CompileOptions(values={"scale": 2.0}))
