"""ONNX ops that make arrays and give them other shapes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.types import FLOAT32, INT64, Dim, product

#: Constants that a few bytes of the model make may not be larger.
MAX_RANGE_ELEMENTS = 1 << 22


# ------------------------------------------------------------------ constants


def _constant(op: Op, net: Importer) -> str:
    """The value stands in one of several attributes."""
    for name, dtype in (
        ("value", None),
        ("value_float", FLOAT32),
        ("value_floats", FLOAT32),
        ("value_int", INT64),
        ("value_ints", INT64),
    ):
        if name in op.attrs:
            value = np.asarray(op.attrs[name], dtype)
            if value.dtype.kind not in "biuf":  # an attribute that says to be a graph, or a text
                break
            return net.const(value, "value")
    raise op.op_error("it holds no numbers", "a policy has no strings and sparse tensors")


def _constant_of_shape(op: Op, net: Importer) -> str:
    value = np.asarray(op.attrs.get("value", np.zeros(1, FLOAT32))).reshape(-1)[0]
    return net.add("Fill", [net.shape_operand(op.need(0)), net.const(np.asarray(value), "value")])


def _eye_like(op: Op, net: Importer) -> str:
    rows, columns = net.length(op.need(0), 0), net.length(op.need(0), 1)
    net.room(rows * columns)
    dtype = op.dtype("dtype", 1) if "dtype" in op.attrs else net.dtype(op.need(0))
    return net.const(np.eye(rows, columns, op.integer("k", 0)).astype(dtype), "eye")


def _range(op: Op, net: Importer) -> str:
    operands = [op.need(i) for i in range(3)]
    values = [net.constant_of(o) for o in operands]
    if all(v is not None and v.size == 1 for v in values):
        start, limit, delta = (float(v.reshape(())) for v in values if v is not None)
        if delta == 0 or (limit - start) / delta > MAX_RANGE_ELEMENTS:
            raise op.op_error(f"it counts from {start:g} to {limit:g} by {delta:g}", "the model is damaged")
    return net.add("Range", operands)


# ------------------------------------------------------------------ shapes


def _shape(op: Op, net: Importer) -> str:
    """From opset 15 on only the axes from ``start`` to ``end``."""
    value = net.add("Shape", [op.need(0)], out_type=INT64)
    start, end = op.integer_or_none("start"), op.integer_or_none("end")
    return value if start is None and end is None else net.slice(value, 0, start, end)


def _size(op: Op, net: Importer) -> str:
    return net.add("Size", [op.need(0)], out_type=INT64)


def _reshape(op: Op, net: Importer) -> str:
    """0 copies the length of the same axis (unless ``allowzero``); the shape was an attribute before opset 5."""
    x, operand = op.need(0), op.need(1)
    target, shape = net.type_of(operand).value, net.type_of(x).shape
    if target is None or shape is None:
        return net.add("Reshape", [x, net.shape_operand(operand)])
    wanted: list[Dim] = [d if isinstance(d, str) else int(d) for d in target.reshape(-1).tolist()]
    if op.integer("allowzero", 0) and 0 in wanted:
        raise op.op_error("it makes a tensor without elements")
    if any(d == 0 and i >= len(shape) for i, d in enumerate(wanted)):
        raise op.op_error(f"the target {wanted} copies the length of an axis that is not there", "the model is damaged")
    dims = [shape[i] if d == 0 else d for i, d in enumerate(wanted)]
    numbers = [d for d in dims if isinstance(d, int)]
    if net.fixed is not None and len(numbers) == len(dims):
        freed = net.fixed.target(numbers, shape)
        if freed is not None:
            return net.reshape(x, freed)
    if net.constant(operand) is None and dims == wanted:
        return net.add("Reshape", [x, net.shape_operand(operand)])
    return net.reshape(x, _resolve_open_dim(dims, shape))


def _resolve_open_dim(dims: Sequence[Dim], shape: Sequence[Dim]) -> list[Dim]:
    """-1 as a number where the other lengths tell it, so that the batch may be the open axis."""
    closed = list(dims)
    names = sorted(d for d in shape if isinstance(d, str))
    if -1 in closed and names and names == sorted(d for d in closed if isinstance(d, str)):
        known = math.prod(d for d in closed if isinstance(d, int) and d != -1)
        total = math.prod(d for d in shape if isinstance(d, int))
        if known and total % known == 0:
            closed[closed.index(-1)] = total // known
    return closed


def _flatten(op: Op, net: Importer) -> str:
    """To a matrix: the axes before ``axis`` are the rows."""
    x = op.need(0)
    dims = net.shape(x)
    axis = op.integer("axis", 1)
    axis = net.axis_of(axis, len(dims)) if axis < len(dims) else net.axis_of(axis, len(dims) + 1)
    sizes = [product(dims[:axis], net.symbols), product(dims[axis:], net.symbols)]
    if isinstance(sizes[1], int):
        return net.reshape(x, (sizes[0] if axis == 1 else -1, sizes[1]))
    if isinstance(sizes[0], int):
        return net.reshape(x, (sizes[0], -1))
    raise op.op_error("neither its rows nor its columns have a known number")


def _given_axes(op: Op, net: Importer) -> tuple[int, ...] | None:
    """Axes: an attribute before opset 13, an input from there on."""
    operand = op.get(1)
    if op.opset < 13 or operand is None:
        return op.integers("axes")
    return tuple(int(a) for a in net.needed_constant(operand, "the list of axes").reshape(-1))


def _squeeze(op: Op, net: Importer) -> str:
    x, axes = op.need(0), _given_axes(op, net)
    if axes is None:
        axes = tuple(i for i, d in enumerate(net.shape(x)) if d == 1)
    return net.squeeze(x, sorted({net.axis(x, a) for a in axes}))


def _unsqueeze(op: Op, net: Importer) -> str:
    """Axes count in the result."""
    x, axes = op.need(0), _given_axes(op, net)
    if axes is None:
        raise op.op_error("it has no axes", "the model is damaged")
    rank = net.rank(x) + len(axes)
    places = {net.axis_of(a, rank) for a in axes}
    if len(places) < len(axes):
        raise op.op_error(f"its axes are {list(axes)}", "each must be another one")
    for axis in sorted(places):
        x = net.expand_dims(x, axis)
    return x


def _transpose(op: Op, net: Importer) -> str:
    x = op.need(0)
    order = op.integers("perm")
    if order is None:
        order = tuple(reversed(range(net.rank(x))))
    return net.add("Transpose", [x, net.ints(order, "perm")])


def _expand(op: Op, net: Importer) -> str:
    """Broadcast to a shape, which itself may have ones where x has more."""
    x, operand = op.need(0), op.need(1)
    value = net.type_of(operand).value
    if value is None or net.type_of(x).shape is None:
        raise op.op_error("its shape is computed from the values of an input", "it must follow from shapes alone")
    dims = [d if isinstance(d, str) else int(d) for d in value.reshape(-1).tolist()]
    return net.broadcast(x, net.common_shape([net.shape(x), tuple(dims)]))


def _tile(op: Op, net: Importer) -> str:
    return net.add("Tile", [op.need(0), net.shape_operand(op.need(1))])


OPS: Mapping[str, Translate] = {
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
