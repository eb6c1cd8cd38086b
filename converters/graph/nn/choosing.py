"""Elements chosen by indices that are computed, the largest ones, running sums: all by comparing, on the last axis.

A table of which element is meant (one axis more) is compared and summed up, which every target computes alike; none of
them has an op for these that all the others have. Definitions: onnx/docs/Operators.md.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from export_model.converters.graph.types import FLOAT32, INT32, INT64
from export_model.signatures.errors import UnsupportedOpError

if TYPE_CHECKING:  # the op table, which the builder asks, writes TopKV2 with these
    from export_model.converters.graph.builder import Builder

#: Elements of a table, per row. A policy's lists have some hundreds, and a table has that squared.
MAX_TABLE = 1 << 20

Combined = Literal["none", "add", "mul", "max", "min"]


def top_k(b: Builder, x: str, k: int, *, largest: bool = True) -> tuple[str, str]:
    """(the k largest elements of the last axis, the largest first, their int64 indices); of equal ones the first."""
    length, rank = b.length(x, -1), b.rank(x)
    if not 1 <= k <= length:
        raise UnsupportedOpError(f"it takes {k} of {length} elements", why="the model is damaged")
    if k == 1:
        best = b.reduce("Max" if largest else "Min", x, [rank - 1], keep=True)
        place = b.add("ArgMax" if largest else "ArgMin", [x, b.ints(rank - 1, "axis")], output_type=INT64)
        return best, b.expand_dims(place, rank - 1)
    _check_table_size(length, length)
    b.room(length * length)
    mine, other = b.expand_dims(x, rank), b.expand_dims(x, rank - 1)
    better = b.add("Greater" if largest else "Less", [other, mine])
    earlier = b.const(np.tril(np.ones((length, length), bool), -1), "earlier")
    tie = b.add("LogicalAnd", [b.add("Equal", [other, mine]), earlier])
    place = b.reduce("Sum", b.cast(b.add("LogicalOr", [better, tie]), FLOAT32), [rank], keep=False)
    places = b.const(np.arange(k, dtype=FLOAT32)[:, None], "places")
    chosen = b.add("Equal", [b.expand_dims(place, rank - 1), places])  # […, k, length]
    index = b.argmax(b.cast(chosen, FLOAT32), rank)
    return _sum_chosen(b, chosen, other, rank), index


def cumulate(b: Builder, x: str, *, exclusive: bool = False, reverse: bool = False, product: bool = False) -> str:
    """The sums (or products) of the last axis up to each element, or from it on."""
    length, rank = b.length(x, -1), b.rank(x)
    _check_table_size(length, length)
    b.room(length * length)
    whole = np.ones((length, length), bool)
    mask = np.triu(whole, int(exclusive)) if reverse else np.tril(whole, -int(exclusive))
    nothing = b.number(x, 1 if product else 0, "nothing")
    kept = b.where(b.const(mask, "kept"), b.expand_dims(x, rank - 1), nothing)
    return b.reduce("Prod" if product else "Sum", kept, [rank], keep=False)


def gather_elements(b: Builder, x: str, indices: str) -> str:
    """``y[…, j] = x[…, indices[…, j]]``; the other axes are equal, negative indices count from the end."""
    chosen = _table(b, indices, b.length(x, -1))
    return _sum_chosen(b, chosen, b.expand_dims(x, b.rank(x) - 1), b.rank(x))


def scatter_elements(b: Builder, x: str, indices: str, updates: str, combined: Combined = "none") -> str:
    """``y[…, indices[…, j]] = updates[…, j]`` in a copy of x, or combined with what is there; other axes are equal."""
    rank = b.rank(x)
    hit = _table(b, indices, b.length(x, -1))  # […, j, place]
    given = b.expand_dims(updates, rank)
    if combined in ("add", "none"):
        total = b.reduce("Sum", b.where(hit, given, b.number(x, 0, "nothing")), [rank - 1], keep=False)
        if combined == "add":
            return b.add("Add", [x, total])
        return b.where(b.add("Any", [hit, b.ints([rank - 1], "axes")], keep_dims=False), total, x)
    if combined == "mul":
        factor = b.reduce("Prod", b.where(hit, given, b.number(x, 1, "nothing")), [rank - 1], keep=False)
        return b.add("Mul", [x, factor])
    kind = "Max" if combined == "max" else "Min"
    op = f"{kind}imum"
    own = b.expand_dims(x, rank - 1)
    return b.add(op, [x, b.reduce(kind, b.where(hit, given, own), [rank - 1], keep=False)])


def last(b: Builder, x: str, axis: int) -> str:
    """The tensor with an axis moved to the end."""
    return b.transpose(x, [*(i for i in range(b.rank(x)) if i != axis), axis])


def moved_back(b: Builder, x: str, axis: int) -> str:
    """The tensor with its last axis moved to ``axis``."""
    order = list(range(b.rank(x) - 1))
    return b.transpose(x, [*order[:axis], len(order), *order[axis:]])


def _table(b: Builder, indices: str, length: int) -> str:
    """Booleans […, j, place]: whether the j-th index means the place."""
    count = b.shape(indices)[-1]
    _check_table_size(count if isinstance(count, int) else 1, length)
    index = b.add("FloorMod", [b.cast(indices, INT32), b.ints(length, "length")])
    return b.add("Equal", [b.expand_dims(index, b.rank(indices)), b.const(np.arange(length, dtype=INT32), "places")])


def _sum_chosen(b: Builder, chosen: str, candidates: str, axis: int) -> str:
    """The one candidate along an axis where ``chosen`` is true."""
    return b.reduce("Sum", b.where(chosen, candidates, b.number(candidates, 0, "nothing")), [axis], keep=False)


def _check_table_size(*lengths: int) -> None:
    if np.prod(lengths) > MAX_TABLE:
        raise UnsupportedOpError(
            f"it compares {' with '.join(map(str, lengths))} elements",
            why=f"it is computed by comparing each with each, and no more than {MAX_TABLE} pairs are",
        )
