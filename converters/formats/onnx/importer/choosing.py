"""ONNX ops that choose elements by indices that may be computed, put them elsewhere, or sum them up in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.nn import choosing as nn
from export_model.converters.graph.types import BOOL, INT32, Dim
from export_model.signatures.errors import UnsupportedOpError

_COMBINED = ("none", "add", "mul", "max", "min")


def _top_k(op: Op, net: Importer) -> list[str | None]:
    """The k largest or smallest, in order whether that is asked for or not. k is an attribute before opset 10."""
    x, count = op.need(0), op.get(1)
    k = op.integer("k", 0) if count is None else int(net.needed_constant(count, "k").reshape(-1)[0])
    axis = net.axis(x, op.integer("axis", -1))
    best, place = nn.top_k(net, nn.last(net, x, axis), k, largest=bool(op.integer("largest", 1)))
    return [nn.moved_back(net, best, axis), nn.moved_back(net, place, axis)]


def _cumulate(op: Op, net: Importer) -> str:
    x = op.need(0)
    axis = net.axis(x, int(net.needed_constant(op.need(1), "the axis").reshape(-1)[0]))
    exclusive, reverse = bool(op.integer("exclusive", 0)), bool(op.integer("reverse", 0))
    turned = nn.last(net, x, axis)
    value = nn.cumulate(net, turned, exclusive=exclusive, reverse=reverse, product=op.kind == "CumProd")
    return nn.moved_back(net, value, axis)


# ------------------------------------------------------------------ elements of a tensor of the same rank


def _gather_elements(op: Op, net: Importer) -> str:
    """y[…, j, …] = x[…, index[…, j, …], …] along an axis; of the other axes the indices may leave out the end."""
    x, indices = op.need(0), op.need(1)
    axis = net.axis(x, op.integer("axis", 0))
    if net.dtype(x) == BOOL:
        raise op.op_error("it gathers booleans")
    dims, wanted = net.shape(x), net.shape(indices)
    for i, (have, want) in enumerate(zip(dims, wanted, strict=True)):
        if i != axis and have != want:
            if not isinstance(want, int) or (isinstance(have, int) and want > have):
                raise op.op_error("its indices leave out rows")
            x = net.slice(x, i, None, want)
    value = nn.gather_elements(net, nn.last(net, x, axis), nn.last(net, indices, axis))
    return nn.moved_back(net, value, axis)


def _scatter_elements(op: Op, net: Importer) -> str:
    """``Scatter`` until opset 10."""
    x, indices, updates = (op.need(i) for i in range(3))
    axis = net.axis(x, op.integer("axis", 0))
    lengths = zip(net.shape(x), net.shape(indices), strict=True)
    if any(a != b for i, (a, b) in enumerate(lengths) if i != axis):
        raise op.op_error("its indices leave out rows")
    table, places, given = (nn.last(net, r, axis) for r in (x, indices, updates))
    _check_apart(op, net, places)
    return nn.moved_back(net, nn.scatter_elements(net, table, places, given, _reduction_of(op)), axis)


def _reduction_of(op: Op) -> nn.Combined:
    found = op.text("reduction", "none")
    if found not in _COMBINED:
        raise op.op_error(f"its reduction is {found!r}", "the model is damaged")
    return cast(nn.Combined, found)


def _check_apart(op: Op, net: Importer, indices: str) -> None:
    """Refuse constant indices that name a place twice where the last one, by the order of a loop, would win."""
    value = net.constant(indices)
    if value is None or op.text("reduction", "none") != "none":
        return
    rows = value.reshape(-1, value.shape[-1])
    if any(len(set(row.tolist())) != len(row) for row in rows):
        raise op.op_error("it writes twice to one place", "which of both values stays is not defined")


# ------------------------------------------------------------------ elements by all their indices


def _gather_nd(op: Op, net: Importer) -> str:
    """x[indices[…, 0], indices[…, 1], …], the first ``batch_dims`` axes going together."""
    x, indices = op.need(0), op.need(1)
    batch = op.integer("batch_dims", 0)
    dims, places = net.shape(x), net.shape(indices)
    count = net.length(indices, -1)
    inner, rest = dims[batch : batch + count], dims[batch + count :]
    if batch:
        lengths = [net.length(x, batch + i) for i in range(count)]
        flat = _flat(net, indices, lengths)
        if net.dtype(x) == BOOL or rest:
            raise op.op_error("it gathers parts of each row by that row's indices")
        table = net.reshape(x, (*dims[:batch], int(np.prod(lengths))))
        chosen = net.reshape(flat, (*places[:batch], int(np.prod([_number(op, d) for d in places[batch:-1]] or [1]))))
        return net.reshape(nn.gather_elements(net, table, chosen), (*places[:-1],))
    flat = _flat(net, indices, inner)
    table = net.reshape(x, (-1, *rest)) if count > 1 else x
    return net.add("GatherV2", [table, flat, net.ints(0, "axis")])


def _number(op: Op, dim: Dim) -> int:
    if not isinstance(dim, int):
        raise op.op_error("a length of its indices is not known")
    return dim


def _flat(net: Importer, indices: str, lengths: Sequence[Dim]) -> str:
    """Indices […, n] as the number of the element, counted row by row; negative ones count from the end.

    The first length may be free (the agents): only that axis is then counted from the front.
    """
    value = net.constant(indices)
    numbers = [n for n in lengths if isinstance(n, int)]
    if value is not None and len(numbers) == len(lengths):
        plain = np.where(value < 0, value + numbers, value)
        return net.const(np.ravel_multi_index(tuple(np.moveaxis(plain, -1, 0)), numbers).astype(INT32), "indices")
    rank, flat = net.rank(indices), None
    for i, length in enumerate(lengths):
        index = net.squeeze(net.slice(net.cast(indices, INT32), rank - 1, i, i + 1), [rank - 1])
        if isinstance(length, int):
            index = net.add("FloorMod", [index, net.ints(length, "length")])
        elif i:
            raise UnsupportedOpError("the length of an axis that it gathers from is not known")
        flat = (
            index if flat is None else net.add("Add", [net.add("Mul", [flat, net.ints(lengths[i], "length")]), index])
        )
    assert flat is not None
    return flat


def _scatter_nd(op: Op, net: Importer) -> str:
    """A copy of x with ``updates`` at the places that ``indices`` [.., n] name by their first n indices."""
    x, indices, updates = (op.need(i) for i in range(3))
    dims, count = net.shape(x), net.length(indices, -1)
    lengths = [_number(op, d) for d in dims[:count]]
    rest = [_number(op, d) for d in dims[count:]]
    places = int(np.prod([_number(op, d) for d in net.shape(indices)[:-1]] or [1]))
    flat = net.reshape(_flat(net, indices, lengths), (1, places))
    _check_apart(op, net, flat)
    columns = int(np.prod(rest or [1]))
    table = net.transpose(net.reshape(x, (int(np.prod(lengths)), columns)), (1, 0))
    given = net.transpose(net.reshape(updates, (places, columns)), (1, 0))
    value = nn.scatter_elements(net, table, flat, given, _reduction_of(op))
    return net.reshape(net.transpose(value, (1, 0)), dims)


def _compress(op: Op, net: Importer) -> str:
    """The elements of an axis (of all of x, row by row, where none is named) where a constant condition is true."""
    x, axis = op.need(0), op.integer_or_none("axis")
    condition = net.needed_constant(op.need(1), "the condition").reshape(-1)
    if axis is None:
        x, axis = net.reshape(x, (-1,)), 0
    indices = net.ints(np.flatnonzero(condition), "indices")
    return net.add("GatherV2", [x, indices, net.ints(net.axis(x, axis), "axis")])


OPS: Mapping[str, Translate] = {
    "TopK": _top_k,
    "CumSum": _cumulate,
    "CumProd": _cumulate,
    "GatherElements": _gather_elements,
    "GatherND": _gather_nd,
    "Scatter": _scatter_elements,
    "ScatterElements": _scatter_elements,
    "ScatterND": _scatter_nd,
    "Compress": _compress,
}
