"""Slices, joins, gathers, turns, repeats: which element comes from where."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node, ref
from export_model.converters.graph.ops.loops.base import (
    Element,
    Expression,
    Index,
    LoopBuilder,
    Loops,
    Number,
    Tensor,
    apply,
    element,
    holds,
    loop_error,
    number,
    select_expression,
    shape_of,
)
from export_model.converters.graph.types import INT32


def constant_operand(node: Node, builder: LoopBuilder, position: int) -> np.ndarray:
    """The value of an operand that says how. Raises UnsupportedOpError where it is computed while the graph runs."""
    value = builder.type_of(node.inputs[position]).constant
    if value is None:
        raise loop_error(node, "an operand that says which elements are taken is computed while the graph runs")
    return value


def transpose(node: Node, builder: LoopBuilder) -> Tensor:
    """Axes in another order."""
    x, order = builder.value(node.inputs[0]), [int(i) for i in constant_operand(node, builder, 1)]
    back = [order.index(i) for i in range(len(order))]
    return builder.compute(shape_of(node, builder), lambda at: Element(x, tuple(at[i] for i in back)), x.dtype)


def cut(builder: LoopBuilder, x: Tensor, shape: Sequence[int], begin: Sequence[int], step: Sequence[int]) -> Tensor:
    """Elements at even distances along each axis."""

    def one(at: Index) -> Expression:
        return Element(
            x,
            tuple(apply("add", apply("mul", i, number(s)), number(b)) for i, b, s in zip(at, begin, step, strict=True)),
        )

    return builder.compute(shape, one, x.dtype)


def slice_(node: Node, builder: LoopBuilder) -> Tensor:
    """A piece of every axis."""
    x, begin = builder.value(node.inputs[0]), [int(i) for i in constant_operand(node, builder, 1)]
    return cut(builder, x, shape_of(node, builder), begin, [1] * len(begin))


def strided_slice(node: Node, builder: LoopBuilder, steps: Sequence[tuple[Any, ...]]) -> Tensor:
    """A strided slice, by what its masks were resolved to."""
    x = builder.value(node.inputs[0])
    taken = [s for s in steps if s[0] != "new"]
    ranges = [
        range(int(s[1]) % n, int(s[1]) % n + 1) if s[0] == "take" else range(*slice(*s[1:]).indices(n))
        for s, n in zip(taken, x.shape, strict=True)
    ]
    kept = cut(builder, x, [len(r) for r in ranges], [r.start for r in ranges], [r.step for r in ranges])
    return Tensor(kept.place, kept.dtype, shape_of(node, builder))


def _pieces(node: Node, builder: LoopBuilder, x: Tensor, axis: int, count: int) -> tuple[Tensor, ...]:
    pieces, start = [], 0
    for i in range(count):
        shape = list(shape_of(node, builder, ref(node.name, i)))
        begin = [0] * len(x.shape)
        begin[axis] = start
        pieces.append(cut(builder, x, shape, begin, [1] * len(begin)))
        start += shape[axis]
    return tuple(pieces)


def split(node: Node, builder: LoopBuilder) -> tuple[Tensor, ...]:
    """Pieces of one axis."""
    axis_at, data_at = (0, 1) if node.op == "Split" else (2, 0)
    x = builder.value(node.inputs[data_at])
    axis = int(constant_operand(node, builder, axis_at)) % len(x.shape)
    return _pieces(node, builder, x, axis, int(node.attrs["num_split"]))


def unpack(node: Node, builder: LoopBuilder) -> tuple[Tensor, ...]:
    """One piece for each index of an axis, without it."""
    x = builder.value(node.inputs[0])
    axis = int(node.attrs["axis"]) % len(x.shape)

    def piece(number_: int) -> Tensor:
        return builder.compute(
            shape_of(node, builder, ref(node.name, number_)),
            lambda at: Element(x, (*at[:axis], number(number_), *at[axis:])),
            x.dtype,
        )

    return tuple(piece(i) for i in range(int(node.attrs["num"])))


def _join(builder: LoopBuilder, parts: Sequence[Tensor], axis: int, shape: Sequence[int]) -> Tensor:
    """Parts one after the other along an axis."""

    def one(at: Index) -> Expression:
        ends = np.cumsum([p.shape[axis] for p in parts]).tolist()

        def of(i: int) -> Expression:
            index = apply("sub", at[axis], number(ends[i] - parts[i].shape[axis]))
            found = Element(parts[i], (*at[:axis], index, *at[axis + 1 :]))
            return (
                found
                if i == len(parts) - 1
                else select_expression(holds("less", at[axis], number(ends[i])), found, of(i + 1))
            )

        return of(0)

    return builder.compute(shape, one, parts[0].dtype)


def concat(node: Node, builder: LoopBuilder) -> Tensor:
    """Parts one after the other."""
    shape = shape_of(node, builder)
    parts = [builder.value(r) for r in node.inputs[:-1]]
    axis = int(constant_operand(node, builder, len(node.inputs) - 1)) % len(shape)
    return _join(builder, [p for p in parts if p.shape[axis]] or parts[:1], axis, shape)


def pack(node: Node, builder: LoopBuilder) -> Tensor:
    """Parts along an axis of their own."""
    shape = shape_of(node, builder)
    axis = int(node.attrs["axis"]) % len(shape)
    one = (*shape[:axis], 1, *shape[axis + 1 :])
    return _join(builder, [Tensor(v.place, v.dtype, one) for v in map(builder.value, node.inputs)], axis, shape)


def gather(node: Node, builder: LoopBuilder) -> Tensor:
    """Rows by their number; one outside is an error, as in TensorFlow."""
    x, rows = (builder.value(r) for r in node.inputs[:2])
    axis = int(constant_operand(node, builder, 2)) % len(x.shape) if len(node.inputs) > 2 else 0
    many = len(rows.shape)

    def one(at: Index) -> Expression:
        row: Expression = Element(rows, tuple(at[axis : axis + many]))
        return Element(x, (*at[:axis], _index(row, x.shape[axis]), *at[axis + many :]))

    return builder.compute(shape_of(node, builder), one, x.dtype)


def _index(x: Expression, count: int) -> Expression:
    """An index that is computed while the graph runs, of ``count``."""
    inside = apply("within", x, Number(count, x.dtype))
    return inside if x.dtype == INT32 else apply("cast", inside, dtype=INT32)


def range_(node: Node, builder: LoopBuilder) -> Tensor:
    """Numbers at even distances; how many must be known before the graph runs."""
    start, step = (builder.value(node.inputs[i]) for i in (0, 2))

    def one(at: Index) -> Expression:
        number_ = at[0] if start.dtype == INT32 else apply("cast", at[0], dtype=start.dtype)
        return apply("add", element(start, ()), apply("mul", number_, element(step, ())))

    return builder.compute(shape_of(node, builder), one, start.dtype)


def places_found(node: Node, builder: LoopBuilder) -> Tensor:
    """Raise UnsupportedOpError: a program's lengths are known when it is written."""
    raise loop_error(node, "how many places it finds is known only while it runs")


def sparse_to_dense(node: Node, builder: LoopBuilder) -> Tensor:
    """A default, and values at places, the last where two have the same; an error where places are not as promised."""
    places, values, default = (builder.value(node.inputs[i]) for i in (0, 2, 3))
    shape, ordered = shape_of(node, builder), bool(node.attrs["validate_indices"])
    count = places.shape[0] if places.shape else 1
    strides = [int(np.prod(shape[a + 1 :], dtype=np.int64)) for a in range(len(shape))]

    def flat(indices: Index) -> Expression:
        found: Expression = number(0)
        for index, stride in zip(indices, strides, strict=True):
            found = apply("add", found, apply("mul", index, number(stride)))
        return found

    def place(k: Expression) -> Expression:
        rows: tuple[Expression, ...] = (k,) if places.shape else ()
        at = [(*rows, number(a)) for a in range(len(shape))] if len(places.shape) == 2 else [rows]
        return flat([_index(Element(places, i), n) for i, n in zip(at, shape, strict=True)])

    def checked_place(k: Expression) -> Expression:
        if not ordered or count == 1:
            return place(k)
        first, before = holds("less", k, number(1)), apply("sub", k, number(1))
        rising = select_expression(first, number(1), apply("cast", holds("less", place(before), place(k)), dtype=INT32))
        right = select_expression(holds("less", number(0), rising), place(k), number(-1))
        return apply("within", right, number(int(np.prod(shape, dtype=np.int64))))

    def one(at: Index) -> Expression:
        def hit(k: Index) -> Expression:
            return select_expression(
                holds("equal", checked_place(k[0]), flat(at)), apply("add", k[0], number(1)), number(0)
            )

        if not count:
            return element(default, ())
        last = builder.reduce("max", [count], hit, INT32)
        which = apply("sub", last, number(1)) if count > 1 else number(0)
        value = Element(values, (which,) * len(values.shape))
        return select_expression(holds("less", number(0), last), value, element(default, ()))

    return builder.compute(shape, one, values.dtype)


def one_hot(node: Node, builder: LoopBuilder) -> Tensor:
    """On where the class is the index, else off."""
    x, on, off = (builder.value(node.inputs[i]) for i in (0, 2, 3))
    shape = shape_of(node, builder)
    axis = int(node.attrs["axis"]) % len(shape)

    def one(at: Index) -> Expression:
        place = at[axis] if x.dtype == INT32 else apply("cast", at[axis], dtype=x.dtype)
        hit = holds("equal", Element(x, (*at[:axis], *at[axis + 1 :])), place)
        return select_expression(hit, element(on, ()), element(off, ()))

    return builder.compute(shape, one, on.dtype)


def tile(node: Node, builder: LoopBuilder) -> Tensor:
    """Each axis again and again."""
    x = builder.value(node.inputs[0])

    def one(at: Index) -> Expression:
        pairs = zip(at, x.shape, strict=True)
        return Element(x, tuple(number(0) if n == 1 else apply("mod", i, number(n)) for i, n in pairs))

    return builder.compute(shape_of(node, builder), one, x.dtype)


def broadcast_operand(position: int) -> Loops:
    """An operand, broadcast to the shape of the result."""

    def loops(node: Node, builder: LoopBuilder) -> Tensor:
        x = builder.value(node.inputs[position])
        return builder.compute(shape_of(node, builder), lambda at: element(x, at), x.dtype)

    return loops


def pad(node: Node, builder: LoopBuilder) -> Tensor:
    """Elements around, zeros or a number."""
    x, amounts = builder.value(node.inputs[0]), constant_operand(node, builder, 1).tolist()
    fill = builder.value(node.inputs[2]) if len(node.inputs) > 2 else None

    def one(at: Index) -> Expression:
        index = [apply("sub", i, number(before)) for i, (before, _) in zip(at, amounts, strict=True)]
        result: Expression = Element(x, tuple(index))
        outside = Number(0, x.dtype) if fill is None else element(fill, ())
        for i, n, (before, after) in zip(index, x.shape, amounts, strict=True):
            if after:
                result = select_expression(holds("less", i, number(n)), result, outside)
            if before:
                result = select_expression(holds("less_equal", number(0), i), result, outside)
        return result

    return builder.compute(shape_of(node, builder), one, x.dtype)
