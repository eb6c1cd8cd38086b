"""Ops along axes: sums, norms, softmax, the best of a row."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from export_model.converters.formats.torchscript.machine import Machine
from export_model.converters.formats.torchscript.values import ScriptTensor
from export_model.converters.graph.nn.reduction import over_last_axis
from export_model.converters.graph.types import FLOAT32, INT64
from export_model.signatures.errors import UnsupportedOpError


def _axes(m: Machine, x: str, dim: Any) -> list[int]:
    """The axes that are meant; None and an empty list are all."""
    wanted = [dim] if isinstance(dim, int) else list(dim or range(m.b.rank(x)))
    return [m.b.axis(x, axis) for axis in wanted]


def _reduce(op: str) -> Callable[..., ScriptTensor]:
    def translate(m: Machine, x: Any, dim: Any = None, keepdim: Any = False, dtype: Any = None) -> ScriptTensor:
        value = m.b.cast(m.ref(x), FLOAT32)
        return ScriptTensor(m.b.reduce(op, value, _axes(m, value, dim), keep=bool(keepdim)))

    return translate


def _norm(m: Machine, x: Any, p: Any = 2, dim: Any = None, keepdim: Any = False, dtype: Any = None) -> ScriptTensor:
    value = m.b.cast(m.ref(x), FLOAT32)
    axes = _axes(m, value, dim)
    if p == 1:
        return ScriptTensor(m.b.reduce("Sum", m.b.add("Abs", [value]), axes, keep=bool(keepdim)))
    if p not in (2, "fro", None):
        raise UnsupportedOpError("a norm of another order", why="1 and 2 are known")
    squares = m.b.reduce("Sum", m.b.add("Square", [value]), axes, keep=bool(keepdim))
    return ScriptTensor(m.b.add("Sqrt", [squares]))


def _variance(*, root: bool) -> Callable[..., ScriptTensor]:
    def translate(m: Machine, x: Any, dim: Any = None, unbiased: Any = True, keepdim: Any = False) -> ScriptTensor:
        value = m.b.cast(m.ref(x), FLOAT32)
        if isinstance(dim, bool):  # var(x, unbiased)
            dim, unbiased = None, dim
        axes = _axes(m, value, dim)
        centred = m.b.add("Sub", [value, m.b.reduce("Mean", value, axes, keep=True)])
        total = m.b.reduce("Sum", m.b.add("Square", [centred]), axes, keep=bool(keepdim))
        count = 1
        for axis in axes:
            count *= m.b.length(value, axis)
        made = m.b.add("RealDiv", [total, m.b.number(value, max(count - bool(unbiased), 1))])
        return ScriptTensor(m.b.add("Sqrt", [made]) if root else made)

    return translate


def _softmax(op: str) -> Callable[..., ScriptTensor]:
    def translate(m: Machine, x: Any, dim: Any, dtype: Any = None) -> ScriptTensor:
        value = m.b.cast(m.ref(x), FLOAT32)
        rank, axis = m.b.rank(value), m.b.axis(value, dim)
        order = [i for i in range(rank) if i != axis] + [axis]
        back = [order.index(i) for i in range(rank)]
        return ScriptTensor(m.b.transpose(over_last_axis(m.b, op, m.b.transpose(value, order)), back))

    return translate


def _best_place(op: str) -> Callable[..., ScriptTensor]:
    def translate(m: Machine, x: Any, dim: Any = None, keepdim: Any = False) -> ScriptTensor:
        value = m.ref(x)
        if dim is None:
            value, dim = m.b.reshape(value, (-1,)), 0
        axis = m.b.axis(value, dim)
        made = m.b.add(op, [value, m.b.ints(axis, "axis")], output_type=INT64)
        return ScriptTensor(m.b.expand_dims(made, axis) if keepdim else made)

    return translate


def _best(kind: str) -> Callable[..., Any]:
    """``max(x)``, ``max(x, y)``, ``max(x, dim, keepdim)``, which gives the places, too."""

    def translate(m: Machine, x: Any, dim: Any = None, keepdim: Any = False) -> Any:
        if isinstance(dim, ScriptTensor):
            return ScriptTensor(m.b.add(f"{kind}imum", list(m.pair(x, dim))))
        values = _reduce(kind)(m, x, dim, keepdim)
        return values if dim is None else (values, _best_place(f"Arg{kind}")(m, x, dim, keepdim))

    return translate


OPS: Mapping[str, Callable[..., Any]] = {
    **{name: _reduce(op) for name, op in (("sum", "Sum"), ("mean", "Mean"), ("amax", "Max"), ("amin", "Min"))},
    "norm": _norm,
    "frobenius_norm": lambda m, x, dim=None, keepdim=False: _norm(m, x, 2, dim, keepdim),
    "linalg_vector_norm": _norm,
    "linalg_norm": _norm,
    "std": _variance(root=True),
    "var": _variance(root=False),
    "softmax": _softmax("Softmax"),
    "log_softmax": _softmax("LogSoftmax"),
    "argmax": _best_place("ArgMax"),
    "argmin": _best_place("ArgMin"),
    "max": _best("Max"),
    "min": _best("Min"),
}
