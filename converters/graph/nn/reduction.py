"""What makes one number of many, and softmax with its kin. Formulas: onnx/docs/Operators.md.

A reduction takes (builder, x, axes, keep): the axes go, or stay with length 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from export_model.converters.graph.builder import Builder

Reduction = Callable[[Builder, str, Sequence[int], bool], str]


def of_kind(kind: str) -> Reduction:
    """Sum, Mean, Max, Min or Prod; x itself where there is no axis."""
    return lambda b, x, axes, keep: b.reduce(kind, x, axes, keep=keep) if axes else x


def l1(b: Builder, x: str, axes: Sequence[int], keep: bool) -> str:
    """Σ|x|."""
    return b.reduce("Sum", b.add("Abs", [x]), axes, keep=keep)


def l2(b: Builder, x: str, axes: Sequence[int], keep: bool) -> str:
    """√Σx²."""
    return b.add("Sqrt", [sum_square(b, x, axes, keep)])


def sum_square(b: Builder, x: str, axes: Sequence[int], keep: bool) -> str:
    """Σx²."""
    return b.reduce("Sum", b.add("Square", [x]), axes, keep=keep)


def log_sum(b: Builder, x: str, axes: Sequence[int], keep: bool) -> str:
    """Ln Σx."""
    return b.add("Log", [b.reduce("Sum", x, axes, keep=keep)])


def log_sum_exp(b: Builder, x: str, axes: Sequence[int], keep: bool) -> str:
    """Ln Σeˣ, the largest element taken out first: a finite number, since ∞ − ∞ is none."""
    top, largest = b.reduce("Max", x, axes, keep=True), np.finfo(b.dtype(x)).max
    top = b.add("Maximum", [b.add("Minimum", [top, b.number(top, largest)]), b.number(top, -largest)])
    total = b.reduce("Sum", b.add("Exp", [b.add("Sub", [x, top])]), axes, keep=True)
    value = b.add("Add", [b.add("Log", [total]), top])
    return value if keep else b.squeeze(value, axes)


# ------------------------------------------------------------------ over the last axis


def over_last_axis(b: Builder, op: str, x: str) -> str:
    """Softmax or LogSoftmax over the last axis, written on two axes: TF 1.x takes no others."""
    dims = b.shape(x)
    if len(dims) == 2:
        return b.add(op, [x])
    return b.reshape(b.add(op, [b.reshape(x, (-1, b.length(x, -1)))]), dims)


def hardmax(b: Builder, x: str) -> str:
    """1 at the first largest element of the last axis, else 0."""
    axis = b.rank(x) - 1
    best = b.argmax(x, axis)
    depth = b.ints(b.length(x, axis), "depth")
    return b.add("OneHot", [best, depth, b.number(x, 1, "on"), b.number(x, 0, "off")], axis=-1)
