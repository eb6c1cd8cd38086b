"""Products, convolutions, pools, reductions, softmax, draws."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.loops.base import (
    Drawn,
    Element,
    Elementwise,
    Expression,
    Index,
    Kind,
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
from export_model.converters.graph.ops.loops.elementwise import apply_activations
from export_model.converters.graph.types import BOOL, INT32


def _mul(a: Expression, b: Expression) -> Expression:
    return apply("mul", a, b)


def matmul(node: Node, builder: LoopBuilder, *, known: Mapping[str, Elementwise]) -> Tensor:
    """A product, a bias where there is one, and the activations that the op carries."""
    a, b = (builder.value(r) for r in node.inputs[:2])
    bias = builder.value(node.inputs[2]) if len(node.inputs) > 2 else None
    turned = [any(node.attrs.get(k) for k in keys) for keys in (("transpose_a", "adj_x"), ("transpose_b", "adj_y"))]
    inner = a.shape[-2] if turned[0] else a.shape[-1]

    def one(at: Index) -> Expression:
        def product(k: Index) -> Expression:
            left = (k[0], at[-2]) if turned[0] else (at[-2], k[0])
            right = (at[-1], k[0]) if turned[1] else (k[0], at[-1])
            return _mul(element(a, (*at[:-2], *left)), element(b, (*at[:-2], *right)))

        total: Expression = builder.reduce("sum", [inner], product, a.dtype)
        total = total if bias is None else apply("add", total, element(bias, at))
        return apply_activations(node, total, known)

    return builder.compute(shape_of(node, builder), one, a.dtype)


def window_padding(size: int, window: int, stride: int, padding: str) -> tuple[int, int, int]:
    """(result length, padding before, padding after) of a sliding window: TensorFlow's SAME and VALID.

    ``window`` counts its dilation in. SAME puts the odd element of padding at the end.
    """
    if padding == "VALID":
        return max(-(-(size - window + 1) // stride), 0), 0, 0
    result = -(-size // stride)
    total = max((result - 1) * stride + window - size, 0)
    return result, total // 2, total - total // 2


def _windows(
    node: Node, image: Tensor, window: Sequence[int]
) -> Callable[[Index, Index], tuple[Any, Expression | None]]:
    """Where an element of a window lies in an image, and whether it is inside (None: it always is)."""
    strides, dilations = node.attrs["strides"][1:3], node.attrs.get("dilations", (1, 1, 1, 1))[1:3]

    def place(at: Index, k: Index) -> tuple[list[Expression], Expression | None]:
        found: list[Expression] = []
        inside: Expression | None = None
        for i in range(2):
            size, stride, dilation = image.shape[1 + i], int(strides[i]), int(dilations[i])
            _, before, after = window_padding(size, (window[i] - 1) * dilation + 1, stride, node.attrs["padding"])
            index = apply("add", _mul(at[1 + i], number(stride)), _mul(k[i], number(dilation)))
            index = apply("sub", index, number(before))
            tests = [holds("less_equal", number(0), index)] if before else []
            tests += [holds("less", index, number(size))] if after else []
            for test in tests:
                inside = test if inside is None else holds("and", inside, test)
            found.append(index)
        return found, inside

    return place


def convolution(node: Node, builder: LoopBuilder, *, known: Mapping[str, Elementwise]) -> Tensor:
    """The sum over a window and the channels, a bias and the activations that the op carries."""
    image, kernel = (builder.value(r) for r in node.inputs[:2])
    bias = builder.value(node.inputs[2]) if len(node.inputs) > 2 else None
    place = _windows(node, image, kernel.shape[:2])

    def one(at: Index) -> Expression:
        def product(k: Index) -> Expression:
            where, inside = place(at, k)
            x: Expression = Element(image, (at[0], *where, k[2]))
            x = x if inside is None else select_expression(inside, x, Number(0, image.dtype))
            return _mul(x, Element(kernel, (*k, at[3])))

        total: Expression = builder.reduce("sum", kernel.shape[:3], product, image.dtype)
        total = total if bias is None else apply("add", total, element(bias, at))
        return apply_activations(node, total, known)

    return builder.compute(shape_of(node, builder), one, image.dtype)


def depthwise(node: Node, builder: LoopBuilder) -> Tensor:
    """Each channel by kernels of its own."""
    image, kernel = (builder.value(r) for r in node.inputs)
    place, many = _windows(node, image, kernel.shape[:2]), kernel.shape[3]

    def one(at: Index) -> Expression:
        channel = at[3] if many == 1 else apply("div", at[3], number(many))
        which = number(0) if many == 1 else apply("mod", at[3], number(many))

        def product(k: Index) -> Expression:
            where, inside = place(at, k)
            x: Expression = Element(image, (at[0], *where, channel))
            x = x if inside is None else select_expression(inside, x, Number(0, image.dtype))
            return _mul(x, Element(kernel, (k[0], k[1], channel, which)))

        return builder.reduce("sum", kernel.shape[:2], product, image.dtype)

    return builder.compute(shape_of(node, builder), one, image.dtype)


def pool(kind: Kind) -> Loops:
    """The largest of a window, or the mean of what of it is inside the image."""

    def loops(node: Node, builder: LoopBuilder) -> Tensor:
        image, window = builder.value(node.inputs[0]), [int(n) for n in node.attrs["ksize"][1:3]]
        place = _windows(node, image, window)

        def one(at: Index) -> Expression:
            def part(k: Index, counted: bool = False) -> Expression:
                where, inside = place(at, k)
                x: Expression = Element(image, (at[0], *where, at[3]))
                x = Number(1, image.dtype) if counted else x
                outside = Number(-np.inf if kind == "max" else 0, image.dtype)
                return x if inside is None else select_expression(inside, x, outside)

            result = builder.reduce(kind, window, part, image.dtype)
            if kind == "max":
                return result
            count: Expression = Number(window[0] * window[1], image.dtype)
            if place(at, [number(0), number(0)])[1] is not None:  # a part of some windows lies outside
                count = builder.reduce("sum", window, lambda k: part(k, True), image.dtype)
            return apply("div", result, count)

        return builder.compute(shape_of(node, builder), one, image.dtype)

    return loops


def reduction(kind: Kind, mean: bool = False) -> Loops:
    """What is kept of some axes."""

    def loops(node: Node, builder: LoopBuilder) -> Tensor:
        x, axes = builder.value(node.inputs[0]), builder.type_of(node.inputs[1]).constant
        if axes is None:
            raise loop_error(node, "the axes that it reduces over are computed while the graph runs")
        chosen_axes = sorted({int(a) % len(x.shape) for a in np.atleast_1d(axes)} if x.shape else set())
        keep = bool(node.attrs["keep_dims"])
        lengths = [x.shape[a] for a in chosen_axes]
        if 0 in lengths:
            raise loop_error(node, "it reduces an axis that is empty")

        def one(at: Index) -> Expression:
            def part(k: Index) -> Expression:
                rest = iter([i for n, i in enumerate(at) if not (keep and n in chosen_axes)])
                over = iter(k)
                return Element(x, tuple(next(over) if n in chosen_axes else next(rest) for n in range(len(x.shape))))

            if not chosen_axes:
                return part(())
            found = builder.reduce(kind, lengths, part, x.dtype)
            return apply("div", found, Number(int(np.prod(lengths)), x.dtype)) if mean else found

        return builder.compute(shape_of(node, builder), one, x.dtype)

    return loops


def arg(kind: Kind) -> Loops:
    """Where the first of the largest, or smallest, is along an axis."""

    def loops(node: Node, builder: LoopBuilder) -> Tensor:
        x, axis = builder.value(node.inputs[0]), builder.type_of(node.inputs[1]).constant
        if axis is None:
            raise loop_error(node, "its axis is computed while the graph runs")
        along, dtype = int(axis) % len(x.shape), builder.type_of(node.name).dtype

        def one(at: Index) -> Expression:
            found = builder.reduce(
                kind, [x.shape[along]], lambda k: Element(x, (*at[:along], k[0], *at[along:])), INT32
            )
            return found if dtype == INT32 else apply("cast", found, dtype=dtype)

        return builder.compute(shape_of(node, builder), one, dtype)

    return loops


def softmax(log: bool) -> Loops:
    """Over the last axis, less the largest."""

    def loops(node: Node, builder: LoopBuilder) -> Tensor:
        x = builder.value(node.inputs[0])
        length, rows = x.shape[-1], x.shape[:-1]
        top = builder.compute(
            rows, lambda at: builder.reduce("max", [length], lambda k: Element(x, (*at, k[0])), x.dtype), x.dtype
        )

        def less_top(at: Index) -> Expression:
            return apply("sub", Element(x, tuple(at)), Element(top, tuple(at[:-1])))

        shifted = builder.compute(x.shape, lambda at: less_top(at) if log else apply("exp", less_top(at)), x.dtype)

        def summand(k: Expression, at: Index) -> Expression:
            one = Element(shifted, (*at, k))
            return apply("exp", one) if log else one

        total = builder.compute(
            rows, lambda at: builder.reduce("sum", [length], lambda k: summand(k[0], at), x.dtype), x.dtype
        )

        def one(at: Index) -> Expression:
            under: Expression = Element(total, tuple(at[:-1]))
            return apply("sub" if log else "div", Element(shifted, tuple(at)), apply("log", under) if log else under)

        return builder.compute(x.shape, one, x.dtype)

    return loops


def uniform(node: Node, builder: LoopBuilder) -> Tensor:
    """Draws above 0 and below 1."""
    return builder.compute(shape_of(node, builder), lambda at: Drawn(), builder.type_of(node.name).dtype)


def box_muller(radius: Expression, turn: Expression) -> Expression:
    """A draw from N(0, 1), of two that are uniform."""
    length = apply("sqrt", _mul(Number(-2, radius.dtype), apply("log", radius)))
    return _mul(length, apply("cos", _mul(Number(2 * np.pi, turn.dtype), turn)))


def gumbel(logit: Expression, drawn: Expression) -> Expression:
    """A logit less log(-log u): the largest of a row is drawn by the probabilities of the row."""
    return apply("sub", logit, apply("log", apply("neg", apply("log", drawn))))


def normal(node: Node, builder: LoopBuilder) -> Tensor:
    """Draws by Box and Muller's transform."""
    shape, dtype = shape_of(node, builder), builder.type_of(node.name).dtype
    radius, turn = (builder.compute(shape, lambda at: Drawn(), dtype) for _ in range(2))

    def one(at: Index) -> Expression:
        return box_muller(Element(radius, tuple(at)), Element(turn, tuple(at)))

    return builder.compute(shape, one, dtype)


#: sqrt(2) erfinv(x) / x by powers of -log(1 - x^2) - 2.5, where that is below 2.5 (Giles, "Approximating the erfinv
#: function", 2012), the highest power first; and erf(sqrt(2)), the largest x that is met.
_INVERSE = (2.81022636e-08, 3.43273939e-07, -3.5233877e-06, -4.39150654e-06, 0.00021858087, -0.00125372503,
            -0.00417768164, 0.246640727, 1.50140941)  # fmt: skip
_WITHIN_TWO = 0.9544997361036416


def truncated_normal(node: Node, builder: LoopBuilder) -> Tensor:
    """Draws within two standard deviations, by the inverse of the distribution."""
    shape, dtype = shape_of(node, builder), builder.type_of(node.name).dtype
    draws = builder.compute(shape, lambda at: Drawn(), dtype)

    def one(at: Index) -> Expression:
        def like(value: float) -> Number:
            return Number(value, dtype)

        centred = apply("sub", _mul(like(2), Element(draws, tuple(at))), like(1))
        x = _mul(like(_WITHIN_TWO), centred)
        w = apply("sub", apply("neg", apply("log", apply("sub", like(1), _mul(x, x)))), like(2.5))
        total: Expression = like(_INVERSE[0])
        for factor in _INVERSE[1:]:
            total = apply("add", _mul(total, w), like(factor))
        return _mul(like(2**0.5), _mul(total, x))

    return builder.compute(shape, one, dtype)


def multinomial(node: Node, builder: LoopBuilder) -> Tensor:
    """Draws by the Gumbel trick: where logits less log(-log u) are largest."""
    x, shape, dtype = builder.value(node.inputs[0]), shape_of(node, builder), builder.type_of(node.name).dtype
    draws = builder.compute((*shape, x.shape[1]), lambda at: Drawn(), x.dtype)

    def one(at: Index) -> Expression:
        def noisy(k: Index) -> Expression:
            return gumbel(Element(x, (at[0], k[0])), Element(draws, (*at, k[0])))

        found = builder.reduce("first largest", [x.shape[1]], noisy, INT32)
        return found if dtype == INT32 else apply("cast", found, dtype=dtype)

    return builder.compute(shape, one, dtype)


def truth(kind: Kind) -> Loops:
    """Whether all, or any, of some axes hold."""

    def loops(node: Node, builder: LoopBuilder) -> Tensor:
        found: Tensor = reduction(kind)(node, builder)
        assert found.dtype == BOOL
        return found

    return loops
