"""ONNX ops that make arrays and give them other shapes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from converters.graph.types import FLOAT32, INT64, Dim, product
from converters.onnx.importer.importer import Raiser
from converters.onnx.importer.node import Op, Raise

#: Constants that a few bytes of the model make may not be larger.
MAX_ELEMENTS = 1 << 22


# ------------------------------------------------------------------ constants


def _constant(op: Op, r: Raiser) -> str:
    """The value stands in one of several attributes."""
    for name, dtype in (
        ("value", None),
        ("value_float", FLOAT32),
        ("value_floats", FLOAT32),
        ("value_int", INT64),
        ("value_ints", INT64),
    ):
        if name in op.attrs:
            return r.const(np.asarray(op.attrs[name], dtype), "value")
    raise op.refused("it holds no numbers", "strings and sparse tensors are no part of a policy")


def _constant_of_shape(op: Op, r: Raiser) -> str:
    value = np.asarray(op.attrs.get("value", np.zeros(1, FLOAT32))).reshape(-1)[0]
    return r.add("Fill", [r.shape_operand(op.need(0)), r.const(np.asarray(value), "value")])


def _eye_like(op: Op, r: Raiser) -> str:
    rows, columns = r.length(op, op.need(0), 0), r.length(op, op.need(0), 1)
    if rows * columns > MAX_ELEMENTS:
        raise op.refused(f"it makes {rows}×{columns} elements")
    dtype = op.dtype("dtype", 1) if "dtype" in op.attrs else r.dtype(op.need(0))
    return r.const(np.eye(rows, columns, op.integer("k", 0)).astype(dtype), "eye")


def _range(op: Op, r: Raiser) -> str:
    operands = [op.need(i) for i in range(3)]
    values = [r.known(o) for o in operands]
    if all(v is not None and v.size == 1 for v in values):
        start, limit, delta = (float(v.reshape(())) for v in values if v is not None)
        if delta == 0 or (limit - start) / delta > MAX_ELEMENTS:
            raise op.refused(f"it counts from {start:g} to {limit:g} by {delta:g}", "the model is damaged")
    return r.add("Range", operands)


# ------------------------------------------------------------------ shapes


def _shape(op: Op, r: Raiser) -> str:
    """From opset 15 on only the axes from ``start`` to ``end``."""
    value = r.add("Shape", [op.need(0)], out_type=INT64)
    start, end = op.integer_or_none("start"), op.integer_or_none("end")
    return value if start is None and end is None else r.slice(value, 0, start, end)


def _size(op: Op, r: Raiser) -> str:
    return r.add("Size", [op.need(0)], out_type=INT64)


def _reshape(op: Op, r: Raiser) -> str:
    """0 copies the length of the same axis (unless ``allowzero``); the shape was an attribute before opset 5."""
    x, operand = op.need(0), op.need(1)
    target, shape = r.type_of(operand).value, r.type_of(x).shape
    if target is None or shape is None:
        return r.add("Reshape", [x, r.shape_operand(operand)])
    wanted: list[Dim] = [d if isinstance(d, str) else int(d) for d in target.reshape(-1).tolist()]
    if op.integer("allowzero", 0) and 0 in wanted:
        raise op.refused("it makes a tensor without elements")
    if any(d == 0 and i >= len(shape) for i, d in enumerate(wanted)):
        raise op.refused(f"the target {wanted} copies the length of an axis that is not there", "the model is damaged")
    dims = [shape[i] if d == 0 else d for i, d in enumerate(wanted)]
    numbers = [d for d in dims if isinstance(d, int)]
    if r.fixed is not None and len(numbers) == len(dims):
        freed = r.fixed.target(numbers, shape)
        if freed is not None:
            return r.reshape(x, freed)
    if r.constant(operand) is None and dims == wanted:
        return r.add("Reshape", [x, r.shape_operand(operand)])
    return r.reshape(x, _closed(dims, shape))


def _closed(dims: Sequence[Dim], shape: Sequence[Dim]) -> list[Dim]:
    """-1 as a number where the other lengths tell it, so that the batch may be the open axis."""
    closed = list(dims)
    names = sorted(d for d in shape if isinstance(d, str))
    if -1 in closed and names and names == sorted(d for d in closed if isinstance(d, str)):
        known = math.prod(d for d in closed if isinstance(d, int) and d != -1)
        total = math.prod(d for d in shape if isinstance(d, int))
        if known and total % known == 0:
            closed[closed.index(-1)] = total // known
    return closed


def _flatten(op: Op, r: Raiser) -> str:
    """To a matrix: the axes before ``axis`` are the rows."""
    x = op.need(0)
    dims = r.shape(op, x)
    axis = op.integer("axis", 1)
    axis = axis + len(dims) if axis < 0 else axis
    sizes = [product(dims[:axis], r.symbols), product(dims[axis:], r.symbols)]
    if isinstance(sizes[1], int):
        return r.reshape(x, (sizes[0] if axis == 1 else -1, sizes[1]))
    if isinstance(sizes[0], int):
        return r.reshape(x, (sizes[0], -1))
    raise op.refused("neither its rows nor its columns have a known number")


def _given_axes(op: Op, r: Raiser) -> tuple[int, ...] | None:
    """Axes: an attribute before opset 13, an input from there on."""
    operand = op.get(1)
    if op.opset < 13 or operand is None:
        return op.integers("axes")
    return tuple(int(a) for a in r.needed_constant(op, operand, "the list of axes").reshape(-1))


def _squeeze(op: Op, r: Raiser) -> str:
    x, axes = op.need(0), _given_axes(op, r)
    if axes is None:
        axes = tuple(i for i, d in enumerate(r.shape(op, x)) if d == 1)
    return r.squeeze(x, sorted({r.axis(op, x, a) for a in axes}))


def _unsqueeze(op: Op, r: Raiser) -> str:
    """Axes count in the result."""
    x, axes = op.need(0), _given_axes(op, r)
    if axes is None:
        raise op.refused("it has no axes", "the model is damaged")
    rank = r.rank(op, x) + len(axes)
    for axis in sorted({a % rank for a in axes}):
        x = r.expand_dims(x, axis)
    return x


def _transpose(op: Op, r: Raiser) -> str:
    x = op.need(0)
    order = op.integers("perm")
    if order is None:
        order = tuple(reversed(range(r.rank(op, x))))
    return r.add("Transpose", [x, r.ints(order, "perm")])


def _expand(op: Op, r: Raiser) -> str:
    """Broadcast to a shape, which itself may have ones where x has more."""
    x, operand = op.need(0), op.need(1)
    value = r.type_of(operand).value
    if value is None or r.type_of(x).shape is None:
        raise op.refused("its shape is computed from the values of an input", "it must follow from shapes alone")
    dims = [d if isinstance(d, str) else int(d) for d in value.reshape(-1).tolist()]
    return r.broadcast(x, r.joined(op, [r.shape(op, x), tuple(dims)]))


def _tile(op: Op, r: Raiser) -> str:
    return r.add("Tile", [op.need(0), r.shape_operand(op.need(1))])


OPS: Mapping[str, Raise] = {
    "Constant": _constant,
    "ConstantOfShape": _constant_of_shape,
    "EyeLike": _eye_like,
    "Range": _range,
    "Shape": _shape,
    "Size": _size,
    "Reshape": _reshape,
    "Flatten": _flatten,
    "Squeeze": _squeeze,
    "Unsqueeze": _unsqueeze,
    "Transpose": _transpose,
    "Expand": _expand,
    "Tile": _tile,
}
