"""What a lowering to LiteRT may use, and the helpers that several share.

LiteRT's operators are called as its schema calls them (``FULLY_CONNECTED``), what they are told beside their operands
as the fields of their options. Every result is given its dtype and shape: those of the node, where nothing is said.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from msgspec import Struct

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.types import INT32, INT64, Dim, TensorType
from export_model.signatures.errors import UnsupportedOpError

#: The number of a tensor in the file; that of an operand which is not there.
Value = int
NONE: Value = -1


class LitertBuilder(Protocol):
    """The operators and tensors in the making; ``value`` gives the one that stands for a tensor of the graph."""

    #: what is known of the node's own result
    result: TensorType

    def value(self, reference: str) -> Value:
        """The tensor in the file that stands for one of the graph."""

    def type_of(self, reference: str) -> TensorType:
        """What is known of a tensor of the graph."""

    def emit(self, op: str, inputs: Sequence[Value], of: TensorType | None = None, **options: Any) -> Value:
        """Append an operator; returns its result, which is of the type ``of`` (the node's where there is none)."""

    def emit_several(
        self, op: str, inputs: Sequence[Value], of: Sequence[TensorType], **options: Any
    ) -> tuple[Value, ...]:
        """Append an operator with a result of each type."""

    def const(self, array: np.ndarray, holds: str = "", axes: Sequence[int] = (), *, own: bool = False) -> Value:
        """A constant; equal ones share their bytes, and a tensor unless it is to be its ``own``.

        It may be what ``holds`` names in the graph, with its ``axes`` in another order (numpy's ``transpose``).
        """

    def activated(self, reference: str, function: str) -> Value | None:
        """A tensor of the graph that nothing else reads, its operator told to apply ``function``; None if none can."""


#: A node in LiteRT's operators: the value of its result, or of each.
Litert = Callable[[Node, LitertBuilder], Any]


class Operator(Struct, frozen=True):
    """A node as the operator ``op`` of all inputs.

    One that is ``applied`` is a part of the operator before it, where that has one to apply it.
    """

    op: str
    options: Mapping[str, Any] = {}
    applied: bool = False

    def __call__(self, node: Node, builder: LitertBuilder) -> Value:
        """The value of a node's result."""
        found = builder.activated(node.inputs[0], self.op) if self.applied else None
        if found is not None:
            return found
        return builder.emit(self.op, [builder.value(r) for r in node.inputs], **self.options)


def builtin(op: str, **options: Any) -> Operator:
    """The operator ``op`` of all inputs."""
    return Operator(op, options)


def same(node: Node, builder: LitertBuilder) -> Value:
    """The operand itself."""
    return builder.value(node.inputs[0])


def number(builder: LitertBuilder, reference: str, value: float) -> Value:
    """A scalar constant of the dtype of a tensor of the graph."""
    return builder.const(np.array(value, builder.type_of(reference).dtype))


def steps(*operators: tuple[str, float | None]) -> Litert:
    """Operators one after the other, the first of the node's input; a number is the second operand."""

    def lower(node: Node, builder: LitertBuilder) -> Value:
        value = builder.value(node.inputs[0])
        for op, operand in operators:
            value = builder.emit(op, [value] if operand is None else [value, number(builder, node.inputs[0], operand)])
        return value

    return lower


def as_int32(builder: LitertBuilder, reference: str) -> Value:
    """A shape or an axis as LiteRT takes it: a vector, or a scalar, of int32."""
    kind = builder.type_of(reference)
    if kind.constant is not None:
        return builder.const(kind.constant.astype(np.int32))
    value = builder.value(reference)
    if kind.dtype != INT64:
        return value
    return builder.emit("CAST", [value], TensorType(INT32, kind.shape), in_data_type=INT64, out_data_type=INT32)


def ints(builder: LitertBuilder, *numbers: int) -> Value:
    """A vector of int32."""
    return builder.const(np.array(numbers, np.int32))


def emit_reshape(builder: LitertBuilder, value: Value, kind: TensorType) -> Value | None:
    """A RESHAPE to a type of which no more than one axis is free; None where more are."""
    shape = kind.shape
    if shape is None or 0 in shape or sum(isinstance(d, str) for d in shape) > 1:
        return None
    if not shape:
        return builder.emit("SQUEEZE", [value], kind)
    return builder.emit("RESHAPE", [value, ints(builder, *(d if isinstance(d, int) else -1 for d in shape))], kind)


def without(builder: LitertBuilder, value: Value, dtype: np.dtype, shape: Sequence[Dim], axes: Sequence[int]) -> Value:
    """A value of ``shape`` without ``axes`` of length 1."""
    if not axes:
        return value
    kind = TensorType(dtype, tuple(d for i, d in enumerate(shape) if i not in axes))
    found = emit_reshape(builder, value, kind)
    return builder.emit("SQUEEZE", [value], kind, squeeze_dims=list(axes)) if found is None else found


def with_axis(builder: LitertBuilder, value: Value, kind: TensorType, axis: int) -> Value:
    """A value with an axis of length 1 put in at ``axis``; ``kind`` is what comes of it."""
    found = emit_reshape(builder, value, kind)
    return (
        builder.emit("EXPAND_DIMS", [value, builder.const(np.array(axis, np.int32))], kind) if found is None else found
    )


def litert_error(node: Node, why: str) -> UnsupportedOpError:
    """The error of a node that LiteRT has no operator for as it is."""
    return UnsupportedOpError(
        f"node {node.name!r} ({node.op}) is not written to .tflite",
        issues=[(node.name, node.op)],
        why=why,
        fix="write the other formats: --to bytes,saved_model,tfjs,onnx",
    )
