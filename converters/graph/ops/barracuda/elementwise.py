"""Ops that compute number by number: arithmetic, activations, comparisons.

What a real Barracuda gets wrong is written in what all of them run (1.0 to 3.0): the first operand of a subtraction,
division or minimum always has the result's lengths (the folds over several operands, and over a first operand that is
repeated, are wrong in early versions). An activation that is younger than 1.0 does not get here: an old worker copies
what it does not know, so the op's entry decomposes it (``decompositions``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from export_model.converters.graph.ops.barracuda.base import Nn
from export_model.converters.graph.ops.barracuda.builder import NnBuilder
from export_model.converters.graph.ops.barracuda.values import Axes, Value, usual_axes
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, C, H, LayerType, W
from export_model.converters.graph.types import Dim

_MIRRORED: Mapping[LayerType, LayerType] = {
    LayerType.GREATER: LayerType.LESS,
    LayerType.GREATER_EQUAL: LayerType.LESS_EQUAL,
    LayerType.LESS: LayerType.GREATER,
    LayerType.LESS_EQUAL: LayerType.GREATER_EQUAL,
    LayerType.EQUAL: LayerType.EQUAL,
}


# ------------------------------------------------------------------ one operand


def activation(kind: Activation) -> Nn:
    """An op that every Barracuda has as an activation."""
    return Nn(lambda b, args: apply_activation(b, args[0], kind), kind=kind)


def apply_activation(b: NnBuilder, value: Value, kind: Activation, label: str = "") -> Value:
    """An Activation layer behind a tensor."""
    return _map_numbers(b, value, lambda x: b.activation(kind, x, label=label))


def _map_numbers(b: NnBuilder, value: Value, make: Callable[[str], str]) -> Value:
    """A tensor computed number by number from another; its axes stay where they are."""
    return b.layer_value(make(b.stored_name(value)), value.shape, value.axes)


def square(b: NnBuilder, args: Sequence[Value]) -> Value:
    """X times itself."""
    return _map_numbers(b, args[0], lambda x: b.two(LayerType.MUL, x, x))


def selu(alpha: float, scale: float) -> Nn:
    """The activation, which is told its two numbers."""
    return Nn(
        lambda b, args: _map_numbers(b, args[0], lambda x: b.activation(Activation.SELU, x, alpha=alpha, beta=scale))
    )


def leaky_relu(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Barracuda takes the larger of x and alpha·x, which is another function beyond 1."""
    alpha = float(b.node.attrs["alpha"])

    def write(x: str) -> str:
        if 0 <= alpha <= 1:
            return b.activation(Activation.LEAKY_RELU, x, alpha=alpha)
        return b.two(LayerType.ADD, b.at_least(x, 0), b.scale(b.at_most(x, 0), alpha))

    return _map_numbers(b, args[0], write)


def swish(b: NnBuilder, args: Sequence[Value]) -> Value:
    """X·sigmoid(x) as the one activation that it is in every genuine file; ``args`` is x."""
    return apply_activation(b, args[0], Activation.SWISH)


# ------------------------------------------------------------------ two operands


class _Pair:
    """Two operands as they broadcast: a name for each that is stored, the lengths and axes of the result."""

    def __init__(self, b: NnBuilder, args: Sequence[Value], shape: tuple[Dim, ...]) -> None:
        self.b, self.shape = b, shape
        axes = _common_axes(args, shape)
        if axes is None:
            usual = usual_axes(shape)
            if usual is None:
                raise b.nn_error(f"a result of shape {list(shape)}", "the batch comes first, and three axes more")
            args = [v if v.array is not None else b.with_axes(v, _own(usual, v)) for v in args]
            axes = usual
        self.axes: Axes = axes
        self.dims = Value(shape, axes).dims
        self.arrays = [None if v.array is None else b.place_constant(v.array, axes) for v in args]
        self.names = [b.stored_name(v) if a is None else b.constant(a) for v, a in zip(args, self.arrays, strict=True)]
        self.names = [self._wide(name, a is not None) for name, a in zip(self.names, self.arrays, strict=True)]

    def _wide(self, name: str, constant: bool) -> str:
        """A column of the batch is written out as wide as the result."""
        _, h, w, c = self.b.dims_of(name)
        if not constant and (h, w, c) == (1, 1, 1) and self.dims[H] == self.dims[W] == 1 < self.dims[C]:
            return self.b.spread(name, self.dims[C])
        return name

    def full(self, position: int) -> bool:
        """Whether an operand has all the lengths of the result."""
        return self.b.dims_of(self.names[position]) == self.dims

    @property
    def swaps(self) -> bool:
        """Whether the second operand goes first: it alone has all the lengths, or is computed where both have them."""
        return not self.full(0) or (self.arrays[0] is not None and self.full(1))

    def pair_value(self, name: str) -> Value:
        return self.b.layer_value(name, self.shape, self.axes)


def _own(axes: Axes, value: Value) -> Axes:
    """The part of a result's axes that an operand has, aligned at the end; what has length 1 lies nowhere."""
    mine = axes[len(axes) - len(value.shape) :]
    return tuple(a if d != 1 else None for a, d in zip(mine, value.shape, strict=True))


def _common_axes(args: Sequence[Value], shape: tuple[Dim, ...]) -> Axes | None:
    """Where the axes of the result lie, so that no operand has to be moved; None where one must be."""
    axes: list[int | None] = [None] * len(shape)
    for value in args:
        if value.array is not None:
            continue
        lead = len(shape) - len(value.shape)
        for i, (place, length) in enumerate(zip(value.axes, value.shape, strict=True), start=lead):
            if length == 1:
                continue
            if axes[i] not in (None, place):
                return None
            axes[i] = place
    taken = [a for a in axes if a is not None]
    if len(set(taken)) != len(taken):
        return None
    for i in reversed(range(len(shape))):
        if axes[i] is None and shape[i] != 1:
            # Only a constant is long here: it takes a place that is free, the last one if that is.
            left = [a for a in (C, W, H) if a not in axes]
            if isinstance(shape[i], str) or not left:
                return None
            axes[i] = left[0]
    return tuple(axes)


def _pair(b: NnBuilder, args: Sequence[Value]) -> _Pair:
    return _Pair(b, args, b.shape_of(b.node.name))


def pair(kind: LayerType) -> Nn:
    """A layer of two operands that may change places."""

    def lower(b: NnBuilder, args: Sequence[Value]) -> Value:
        pair = _pair(b, args)
        return pair.pair_value(_two(b, pair, kind, *(pair.names[::-1] if pair.swaps else pair.names)))

    return Nn(lower)


def _two(b: NnBuilder, pair: _Pair, kind: LayerType, first: str, second: str, label: str = "") -> str:
    return b.layer(kind, [first, second], pair.dims, label=label)


def subtract(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A − b; −b + a where a is a constant or is repeated."""
    return _by_inverse(b, args, LayerType.SUB, LayerType.ADD, lambda x: b.scale(x, -1, "negative"))


def divide(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A / b; the reciprocal of b times a where a is a constant or is repeated."""
    if b.type_of(b.node.inputs[0]).dtype.kind != "f":
        raise b.nn_error("it divides integers", "a .nn knows floats alone")
    reciprocal = partial(b.activation, Activation.RECIPROCAL, label="reciprocal")
    return _by_inverse(b, args, LayerType.DIV, LayerType.MUL, reciprocal)


def _by_inverse(
    b: NnBuilder, args: Sequence[Value], kind: LayerType, other: LayerType, turned: Callable[[str], str]
) -> Value:
    """``kind`` of two operands, or ``other`` of the first and the second ``turned``, which may change places."""
    pair = _pair(b, args)
    first, second = pair.names
    if pair.full(0) and pair.arrays[0] is None:
        return pair.pair_value(b.two(kind, first, second))
    second = turned(second)
    ordered = (second, first) if pair.full(1) else (first, second)
    return pair.pair_value(_two(b, pair, other, *ordered))


def power(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A to the power of b."""
    exponent = args[1].array
    if exponent is not None and exponent.size == 1 and args[0].shape == b.shape_of(b.node.name):
        number = float(exponent.reshape(()))
        if number == 0.5:
            return apply_activation(b, args[0], Activation.SQRT)
        if number == 2:
            return square(b, args[:1])
    pair = _pair(b, args)
    if pair.full(0) and pair.arrays[0] is None:
        return pair.pair_value(b.two(LayerType.POW, *pair.names))
    raise b.nn_error("its base is a constant or is repeated", "early versions of Barracuda compute another power")


def floor_divide(b: NnBuilder, args: Sequence[Value]) -> Value:
    """The whole part of a / b."""
    pair = _pair(b, args)
    if not pair.full(0) or pair.arrays[0] is not None:
        raise b.nn_error("its first operand is a constant or is repeated", "early versions of Barracuda swap them")
    first, second = pair.names
    return pair.pair_value(b.activation(Activation.FLOOR, b.two(LayerType.DIV, first, second, "quotient")))


def squared_difference(b: NnBuilder, args: Sequence[Value]) -> Value:
    """(a − b)²."""
    return square(b, [subtract(b, args)])


def compare(kind: LayerType, *, negated: bool = False) -> Nn:
    """1 where it holds, else 0; ``negated``: the other way round."""

    def lower(b: NnBuilder, args: Sequence[Value]) -> Value:
        pair = _pair(b, args)
        name = _two(b, pair, _MIRRORED[kind], *pair.names[::-1]) if pair.swaps else _two(b, pair, kind, *pair.names)
        return pair.pair_value(b.shift(b.scale(name, -1), 1) if negated else name)

    return Nn(lower, kind=None if negated else kind)


def _combine(b: NnBuilder, kind: LayerType, first: Value, second: Value, shape: tuple[Dim, ...]) -> Value:
    """Two values combined inside of an op: constants at once, others by layers."""
    if first.array is not None and second.array is not None:
        functions = {LayerType.MUL: np.multiply, LayerType.ADD: np.add}
        array = functions[kind](first.array, second.array)
        return Value(shape if array.ndim == len(shape) else tuple(array.shape), array=array)
    shape = _broadcast(first, second, shape)
    pair = _Pair(b, [first, second], shape)
    names = pair.names if pair.full(0) and pair.arrays[0] is None else pair.names[::-1]
    return pair.pair_value(_two(b, pair, kind, names[0], names[1], "chosen"))


def _broadcast(first: Value, second: Value, shape: tuple[Dim, ...]) -> tuple[Dim, ...]:
    """The shape of a part of a result: as long as its operands are."""
    rank = max(len(first.shape), len(second.shape))
    own = []
    for i in range(1, rank + 1):
        lengths = [v.shape[-i] for v in (first, second) if len(v.shape) >= i]
        long = [d for d in lengths if d != 1]
        own.append(long[0] if long else 1)
    return tuple(reversed(own))


def clip(b: NnBuilder, args: Sequence[Value]) -> Value:
    """Min, then max, as the trainers write it."""
    x, low, high = args
    shape = b.shape_of(b.node.name)
    result = x
    for kind, bound in ((LayerType.MIN, high), (LayerType.MAX, low)):
        pair = _Pair(b, [result, bound], shape)
        result = pair.pair_value(_two(b, pair, kind, *(pair.names if pair.full(0) else pair.names[::-1])))
    return result


def add_n(b: NnBuilder, args: Sequence[Value]) -> Value:
    """A sum of several, two at a time."""
    total = args[0]
    for value in args[1:]:
        total = _combine(b, LayerType.ADD, total, value, b.shape_of(b.node.name))
    return total
