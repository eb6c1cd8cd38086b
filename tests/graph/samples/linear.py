"""Samples of ops: linear."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.types import INT32
from tests.graph.making import defaults
from tests.graph.samples.base import (
    INF,
    Sample,
    bools,
    const,
    f32,
    fixed,
    floats,
    ints,
    sample,
)


def _products() -> Iterator[Sample]:
    yield sample("MatMul", "constant weights", floats(3, 5), const(floats(5, 4, seed=1)))
    yield sample("MatMul", "transpose_b", floats(3, 5), const(floats(4, 5, seed=1)), transpose_b=True)
    yield sample("MatMul", "transpose_a", fixed(floats(5, 3)), const(floats(5, 4, seed=1)), transpose_a=True)
    yield sample(
        "MatMul", "both, fed", fixed(floats(5, 3)), fixed(floats(4, 5, seed=1)), transpose_a=True, transpose_b=True
    )
    yield sample("BatchMatMul", "rank 3", floats(2, 3, 5), floats(2, 5, 4, seed=1))
    yield sample("BatchMatMul", "adj_x", floats(2, 5, 3), floats(2, 5, 4, seed=1), adj_x=True)
    yield sample("BatchMatMul", "adj_y, rank 4", floats(2, 2, 3, 5), floats(2, 2, 4, 5, seed=1), adj_y=True)
    weights, bias = const(floats(5, 4, seed=1)), const(floats(4, seed=2))
    for names in (("BiasAdd",), ("BiasAdd", "Relu"), ("BiasAdd", "Relu6"), ("BiasAdd", "Elu"), ("BiasAdd", "Sigmoid")):
        title = " + ".join(names)
        yield sample("_FusedMatMul", title, floats(3, 5), weights, bias, fused_ops=names)
    turned = const(floats(4, 5, seed=1))
    yield sample(
        "_FusedMatMul",
        "transpose_b",
        floats(3, 5),
        turned,
        bias,
        fused_ops=("BiasAdd", "Relu"),
        transpose_b=True,
        differs={"tfjs-wasm": "a transposed product loses its bias (passes/fuse.py makes none)"},
    )
    yield sample("BiasAdd", "matrix", floats(3, 4), const(floats(4, seed=1)))
    yield sample("BiasAdd", "image", floats(2, 3, 3, 4), const(floats(4, seed=1)))
    yield sample("BiasAdd", "sequence", floats(2, 3, 4), const(floats(4, seed=1)))


def _reductions() -> Iterator[Sample]:
    x = floats(3, 4, 2)
    for op in ("Sum", "Mean", "Prod", "Max", "Min"):
        yield sample(op, "vector of an axis", x, const(np.array([1], np.int32)))
        yield sample(op, "scalar axis, kept", x, const(1), keep_dims=True)
        yield sample(op, "negative axes", x, const(-1, -2))
        yield sample(op, "over the batch", x, const(np.array([0], np.int32)), keep_dims=True)
        yield sample(op, "all axes", x, const(0, 1, 2))
        yield sample(op, "no axis", x, const(np.zeros(0, np.int32)))
    for op in ("Sum", "Prod", "Max", "Min"):
        yield sample(op, "int32", ints(3, 4), const(1))
    for op in ("Max", "Min"):
        yield sample(op, "infinite", np.where(bools(3, 4), floats(3, 4), f32(-INF)).astype(np.float32), const(1))
    for op in ("All", "Any"):
        x = np.array([[True, True], [True, False], [False, False]])
        yield sample(op, "rows", x, const(np.array([1], np.int32)))
        yield sample(op, "rows, kept", x, const(-1), keep_dims=True)
        yield sample(op, "everything", x, const(0, 1))


def _choices() -> Iterator[Sample]:
    for op in ("ArgMax", "ArgMin"):
        yield sample(op, "last axis", floats(4, 5), const(1))
        yield sample(op, "negative axis, int32", floats(2, 3, 4), const(-2), output_type=INT32)
        yield sample(op, "batch axis", floats(4, 5), const(0))
        yield sample(op, "ties", np.array([[1, 3, 3, 1], [0, 0, 0, 0]], np.float32), const(1))
        yield sample(op, "int32 scores", ints(4, 5), const(1))
    for op in ("Softmax", "LogSoftmax"):
        yield sample(op, "matrix", floats(3, 4, low=-5, high=5))
        yield sample(op, "rank 3", floats(2, 3, 4))
        yield sample(op, "large", f32(1e4, 0, -1e4, 80, 80, 80).reshape(2, 3))
        yield sample(op, "one column", floats(3, 1))
        yield sample(op, "masked", f32(0, -INF, 1, -INF, -INF, 2).reshape(2, 3))


def unfused(sample: Sample) -> Graph:
    """The graph of a fused op in the ops that it is made of."""
    *before, node = sample.nodes
    product = node.op.removeprefix("_Fused")
    known = {a.name for a in TABLE[product].attrs}
    attrs = {name: value for name, value in node.attrs.items() if name in known}
    chain = [Node("product", product, node.inputs[:2], attrs)]
    for name in node.attrs["fused_ops"]:
        inputs = (chain[-1].name, node.inputs[2]) if name == "BiasAdd" else (chain[-1].name,)
        chain.append(Node(f"step_{len(chain)}", name, inputs, defaults(name)))
    return Graph((*before, *chain[:-1], replace(chain[-1], name="op")))


def samples() -> Iterator[Sample]:
    yield from _products()
    yield from _reductions()
    yield from _choices()
