"""Small graphs of one op each, for every op of the table, with what is fed to them.

An operand of a sample is an array that is fed (its leading axis is the batch), ``fixed`` (fed, no axis is free),
``any_size`` (fed, all axes but the last are free), ``const`` (known before the graph runs), ``via`` (the result of
another op) or the name of an operand before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from export_model.converters.graph.nodes import Graph, Node, TensorShape, ref
from export_model.converters.graph.types import INT32
from tests.graph.making import defaults

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Sample:
    """One node of ``op``, called ``"op"``, and what is upstream of it."""

    op: str
    title: str
    nodes: tuple[Node, ...]
    feeds: Mapping[str, Array]
    outputs: int = 1
    #: runtime → why it gives something else there, or refuses; the tests hold that it does
    differs: Mapping[str, str] = field(default_factory=dict)
    #: elements are drawn at random: only dtype, shape and distribution can agree
    drawn: bool = False
    #: what TensorFlow runs, where it cannot run the graph itself
    oracle: Graph | None = None

    @property
    def graph(self) -> Graph:
        return Graph(self.nodes)

    @property
    def fetches(self) -> list[str]:
        return [ref("op", i) for i in range(self.outputs)]

    def with_shapes(self, known: Callable[[TensorShape, Array], TensorShape]) -> Graph:
        """The graph with placeholders of other shapes, made of the ones they have and what is fed to them."""
        return Graph(
            tuple(
                replace(n, attrs={**n.attrs, "shape": known(n.attrs["shape"], self.feeds[n.name])})
                if n.op == "Placeholder"
                else n
                for n in self.nodes
            )
        )


# ------------------------------------------------------------------ what runtimes do differently


TFJS = ("tfjs-cpu", "tfjs-wasm")
#: TensorFlow.js 4.22; none of these ops is left in a policy's graph when it is written.
NO_SUCH_OP = dict.fromkeys(TFJS, "TensorFlow.js has no such op")
NAN_LOST = "a NaN comes out as a number"
UNKNOWN_BATCH = {"onnxruntime": "the length of the batch is not known when the model is written"}
#: LiteRT's own kernels keep the sums and products of floats between -3.4e38 and 3.4e38, XNNPACK does not.
KEPT_FINITE = {"litert-plain": "an infinite number comes out as the largest one"}
NO_LOWERING = {"onnxruntime": "it has no lowering"}


# ------------------------------------------------------------------ operands


@dataclass(frozen=True)
class Operand:
    array: Array
    kind: str


@dataclass(frozen=True)
class Via:
    op: str
    operands: tuple[Any, ...]
    attrs: Mapping[str, Any]
    output: int = 0


def fixed(array: Array) -> Operand:
    return Operand(array, "fixed")


def any_size(array: Array) -> Operand:
    """Fed, with only the length of the last axis known."""
    return Operand(array, "any size")


def const(*values: Any, dtype: Any = np.int32) -> Operand:
    """A constant: an array as it is, else integers as an int32 scalar or vector."""
    if len(values) == 1:
        value = values[0]
        return Operand(value if isinstance(value, np.ndarray) else np.array(value, dtype), "const")
    return Operand(np.array(values, dtype), "const")


def via(op: str, *operands: Any, output: int = 0, **attrs: Any) -> Via:
    return Via(op, operands, attrs, output)


def shape_of(operand: Any) -> Via:
    return via("Shape", operand, out_type=INT32)


class SampleBuilder:
    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.feeds: dict[str, Array] = {}

    def operand(self, operand: Any) -> str:
        if isinstance(operand, str):
            return operand
        if isinstance(operand, Via):
            inputs = tuple(self.operand(o) for o in operand.operands)
            name = f"n{len(self.nodes)}"
            self.nodes.append(Node(name, operand.op, inputs, {**defaults(operand.op), **operand.attrs}))
            return ref(name, operand.output)
        if isinstance(operand, np.ndarray):
            operand = Operand(operand, "fed")
        if operand.kind == "const":
            name = f"c{len(self.nodes)}"
            self.nodes.append(Node(name, "Const", value=operand.array))
            return name
        name = f"x{len(self.feeds)}"
        dims: list[int | None] = list(operand.array.shape)
        if operand.kind != "fixed":
            dims[:1] = [None] * len(dims[:1])
        if operand.kind == "any size":
            dims[:-1] = [None] * len(dims[:-1])
        attrs = {"dtype": operand.array.dtype, "shape": TensorShape(tuple(dims))}
        self.nodes.append(Node(name, "Placeholder", attrs=attrs))
        self.feeds[name] = operand.array
        return name


def sample(
    op: str,
    title: str,
    *operands: Any,
    outputs: int = 1,
    differs: Mapping[str, str] | None = None,
    drawn: bool = False,
    **attrs: Any,
) -> Sample:
    builder = SampleBuilder()
    inputs = tuple(builder.operand(o) for o in operands)
    builder.nodes.append(Node("op", op, inputs, {**defaults(op), **attrs}))
    return Sample(op, title, tuple(builder.nodes), builder.feeds, outputs, differs or {}, drawn)


# ------------------------------------------------------------------ data


def floats(*shape: int, seed: int = 0, low: float = -2.0, high: float = 2.0) -> Array:
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def ints(*shape: int, seed: int = 0, low: int = -9, high: int = 9, dtype: Any = np.int32) -> Array:
    return np.random.default_rng(seed).integers(low, high, shape, endpoint=True).astype(dtype)


def bools(*shape: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random(shape) < 0.5


def f32(*values: float) -> Array:
    return np.array(values, np.float32)


INF, NAN = math.inf, math.nan
HALVES = f32(-2.5, -1.5, -0.5, -0.0, 0.0, 0.5, 1.5, 2.5, 3.49, -3.51).reshape(5, 2)
EXTREMES = f32(-INF, -3e38, -1e4, -90.0, -1e-20, 0.0, 1e-20, 90.0, 1e4, 3e38, INF, NAN).reshape(4, 3)
