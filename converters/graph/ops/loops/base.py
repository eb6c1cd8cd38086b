"""The loop language: an op says of each element of its result how it is computed, and no language is mentioned.

Shapes are static, for one agent (a batch is a loop around all of it). An *expression* is made of numbers, loop
counters, elements of tensors, functions of ``FUNCTIONS`` and sums or extremes over further counters. The facet
``loops`` of an op's entry asks its builder to compute tensors so; an emitter turns what comes of it into text.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol

import numpy as np
from msgspec import Struct

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.types import BOOL, FLOAT32, INT32, INT64, TensorType
from export_model.signatures.errors import UnsupportedOpError

#: Every function that an expression may apply; an emitter has a row for each.
FUNCTIONS = frozenset(
    (
        *("add", "sub", "mul", "div", "neg", "abs", "floor", "ceil", "rint", "min", "max", "pow", "mod", "intdiv"),
        *("exp", "expm1", "log", "log1p", "sqrt", "sin", "cos", "tan", "tanh", "erf"),
        *("less", "less_equal", "equal", "and", "or", "not", "select", "cast"),
        "whole",  # an int32 of a float32 within its range, towards zero
        *("bits", "of_bits"),  # an int32 of the bits of a float32, and back
        "within",  # an index, and how many there are: the program answers nothing where it lies outside
    )
)
#: What is kept of the elements that a reduction meets: ``first largest`` and ``first smallest`` keep where it was.
Kind = Literal["sum", "product", "max", "min", "first largest", "first smallest"]
#: dtypes that a program computes in.
DTYPES = (FLOAT32, INT32, INT64, BOOL)


class Tensor(Struct, frozen=True, eq=False):
    """A tensor of the program, row by row: ``place`` is what holds its elements, which views share."""

    place: Any
    dtype: np.dtype
    shape: tuple[int, ...]


class Number(Struct, frozen=True, eq=False):
    """A number as it is."""

    value: float
    dtype: np.dtype


class Counter(Struct, frozen=True, eq=False):
    """What a loop counts."""

    name: str
    length: int
    dtype: np.dtype = INT32


class Element(Struct, frozen=True, eq=False):
    """An element of a tensor, by an index for each axis."""

    tensor: Tensor
    at: tuple[Expression, ...]

    @property
    def dtype(self) -> np.dtype:
        """The tensor's."""
        return self.tensor.dtype


class Applied(Struct, frozen=True, eq=False):
    """A function of ``FUNCTIONS`` of operands."""

    function: str
    operands: tuple[Expression, ...]
    dtype: np.dtype


class Reduced(Struct, frozen=True, eq=False):
    """What is kept of ``body`` while ``counters`` count."""

    kind: Kind
    counters: tuple[Counter, ...]
    body: Expression
    dtype: np.dtype


class Drawn(Struct, frozen=True, eq=False):
    """The next number of the caller's stream: uniform, above 0 and below 1."""

    dtype: np.dtype = FLOAT32


class Given(Struct, frozen=True, eq=False):
    """A parameter of a function that a program brings along."""

    name: str
    dtype: np.dtype = FLOAT32


Expression = Number | Counter | Element | Applied | Reduced | Drawn | Given
Index = Sequence[Expression]


class LoopBuilder(Protocol):
    """The program in the making; ``value`` gives what stands for a tensor of the graph."""

    def value(self, reference: str) -> Tensor:
        """The tensor of the program that stands for one of the graph."""

    def type_of(self, reference: str) -> TensorType:
        """What is known of a tensor of the graph, for one agent."""

    def compute(
        self, shape: Sequence[int], element: Callable[[tuple[Expression, ...]], Expression], dtype: np.dtype
    ) -> Tensor:
        """A new tensor, each element as ``element`` says of its index."""

    def reduce(
        self, kind: Kind, lengths: Sequence[int], body: Callable[[tuple[Expression, ...]], Expression], dtype: np.dtype
    ) -> Expression:
        """What is kept of ``body`` over counters of ``lengths``."""


#: A node as loops: the tensor of its result, or of each.
Loops = Callable[[Node, LoopBuilder], Any]


def number(value: float, dtype: np.dtype = INT32) -> Number:
    """A number of a dtype."""
    return Number(value, dtype)


def apply(function: str, *operands: Expression, dtype: np.dtype | None = None) -> Expression:
    """A function of operands; sums and products of indices are computed where they are known."""
    assert function in FUNCTIONS, function
    kind = operands[0].dtype if dtype is None else dtype
    if kind == INT32 and len(operands) == 2:
        a, b = operands
        if function in ("add", "sub") and isinstance(b, Number) and b.value == 0:
            return a
        if function == "add" and isinstance(a, Number) and a.value == 0:
            return b
        if function == "mul" and isinstance(b, Number) and b.value == 1:
            return a
        if isinstance(a, Number) and isinstance(b, Number) and function in ("add", "sub", "mul"):
            x, y = int(a.value), int(b.value)
            return number({"add": x + y, "sub": x - y, "mul": x * y}[function])
    return Applied(function, operands, kind)


def holds(function: str, a: Expression, b: Expression) -> Expression:
    """A comparison, or one of truths."""
    return apply(function, a, b, dtype=BOOL)


def select_expression(condition: Expression, a: Expression, b: Expression) -> Expression:
    """``a`` where the condition holds, else ``b``; the other is not computed."""
    return apply("select", condition, a, b, dtype=a.dtype)


def element(tensor: Tensor, at: Index) -> Element:
    """An element of a tensor that is broadcast to the rank and lengths that ``at`` counts in."""
    last = at[len(at) - len(tensor.shape) :]
    return Element(tensor, tuple(number(0) if n == 1 else i for n, i in zip(tensor.shape, last, strict=True)))


def shape_of(node: Node, builder: LoopBuilder, output: str = "") -> tuple[int, ...]:
    """The lengths of a node's result. Raises UnsupportedOpError where one is not known."""
    shape = builder.type_of(output or node.name).shape
    if shape is None or not all(isinstance(n, int) for n in shape):
        raise loop_error(node, "its shape is not known before it runs")
    return tuple(int(n) for n in shape)


class Elementwise(Struct, frozen=True):
    """Loops of which each element is ``function`` of the operands' elements."""

    function: Callable[..., Expression]

    def __call__(self, node: Node, builder: LoopBuilder) -> Tensor:
        """The tensor of a node."""
        values = [builder.value(r) for r in node.inputs]
        kind = builder.type_of(node.name)
        return builder.compute(
            shape_of(node, builder), lambda at: self.function(*(element(v, at) for v in values)), kind.dtype
        )


def simple(name: str) -> Elementwise:
    """A function of the language of all operands' elements."""
    return Elementwise(lambda *x: apply(name, *x))


def view(node: Node, builder: LoopBuilder) -> Tensor:
    """The first operand's elements, under the shape of the result."""
    value = builder.value(node.inputs[0])
    return Tensor(value.place, value.dtype, shape_of(node, builder))


def loop_error(node: Node, why: str) -> UnsupportedOpError:
    """The error of a node that has no loops as it is."""
    return UnsupportedOpError(
        f"node {node.name!r} ({node.op}) is not written as source code",
        issues=[(node.name, node.op)],
        why=why,
        fix="write the other formats: --to bytes,saved_model,tfjs,onnx",
    )
