"""Numbers, flags, lists and texts of a program: computed while it is walked through."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any

from export_model.converters.formats.torchscript.machine import DTYPES, Machine
from export_model.converters.formats.torchscript.values import Device, ScriptTensor
from export_model.converters.graph.types import BOOL, FLOAT32, INT64
from export_model.signatures.errors import SourceError, UnsupportedOpError

#: Names that stand without ``torch.``.
BARE = frozenset(("int", "float", "bool", "range", "print"))
_MAX_RANGE = 4096


def _scalar(kind: Callable[[Any], Any]) -> Callable[[Machine, Any], Any]:
    def convert(m: Machine, value: Any) -> Any:
        if isinstance(value, ScriptTensor):
            known = m.b.constant(value.read())
            if known is None or known.size != 1:
                raise UnsupportedOpError("a number is taken out of a tensor", why="it depends on what is fed")
            value = known.reshape(()).item()
        return m.number(kind(value))

    return convert


def _range(m: Machine, *bounds: int) -> range:
    found = range(*bounds)
    if len(found) > _MAX_RANGE:
        raise UnsupportedOpError(f"a loop goes round {len(found)} times", why=f"up to {_MAX_RANGE} are unrolled")
    return found


def _number_to_tensor(m: Machine, value: Any) -> ScriptTensor:
    return value if isinstance(value, ScriptTensor) else ScriptTensor(m.ref(value))


def _dtype(m: Machine, value: Any) -> int:
    dtype = m.b.dtype(m.ref(value))
    return {FLOAT32: 6, INT64: 4, BOOL: 11}.get(dtype, 3)


def _raise(m: Machine, message: Any = "", *rest: Any) -> None:
    raise SourceError(
        "its code raises an error for what it is fed here",
        why=(message[:120] if isinstance(message, str) else "") or "it says nothing",
        fix="say what the agent observes: --sensors 48 (one shape per input)",
    )


def _length(m: Machine, value: Any) -> int:
    return m.b.length(value.read(), 0) if isinstance(value, ScriptTensor) else len(value)


def _append(m: Machine, items: list[Any], value: Any) -> list[Any]:
    if isinstance(value, list | tuple) or len(items) > _MAX_RANGE:
        raise UnsupportedOpError("lists grow in a list", why="lists of tensors and numbers are known")
    items.append(value)
    return items


def join_lists(a: list[Any], b: list[Any]) -> list[Any]:
    """Return one list of both. Raises UnsupportedOpError where it grows without end."""
    if len(a) + len(b) > _MAX_RANGE or any(isinstance(item, list | tuple) for item in (*a, *b)):
        raise UnsupportedOpError("lists grow in a list", why="lists of tensors and numbers are known")
    return [*a, *b]


def dtype_of(code: Any) -> Any:
    """Return numpy's dtype of a number that a program calls one by. Raises UnsupportedOpError."""
    if code not in DTYPES:
        raise UnsupportedOpError("it asks for another dtype", why="complex and quantised numbers are not known")
    return DTYPES[code]


OPS: Mapping[str, Callable[..., Any]] = {
    "int": _scalar(int),
    "float": _scalar(float),
    "bool": _scalar(bool),
    "range": _range,
    "ops.prim.NumToTensor": _number_to_tensor,
    "ops.prim.dtype": _dtype,
    "ops.prim.device": lambda m, value: Device(),
    "ops.prim.layout": lambda m, value: None,
    "ops.prim.RaiseException": _raise,
    "ops.prim.is_nested": lambda m, value: False,
    **dict.fromkeys(("is_autocast_enabled", "is_autocast_cpu_enabled", "is_grad_enabled"), lambda m, *given: False),
    "__derive_index": lambda m, index, start, step: m.number(start + index * step),
    "__range_length": lambda m, *bounds: len(_range(m, *bounds)),
    "ops.prim.min": lambda m, *given: min(*given),
    "ops.prim.max": lambda m, *given: max(*given),
    "device": lambda m, *given: Device(),
    "IntImplicit": _scalar(int),
    "FloatImplicit": _scalar(float),
    "ScalarImplicit": _scalar(lambda value: value),
    "item": _scalar(lambda value: value),
    "Int": _scalar(int),
    "Float": _scalar(float),
    "Bool": _scalar(bool),
    "__not__": lambda m, value: not m.truth(value),
    "__is__": lambda m, a, b: a is b,
    "__isnot__": lambda m, a, b: a is not b,
    "__contains__": lambda m, items, value: isinstance(value, int | float | str) and value in items,
    "__getitem__": lambda m, items, index: items[index],
    "len": _length,
    "list": lambda m, items: list(items),
    "append": _append,
    "format": lambda m, text, *given: text[:120] if isinstance(text, str) else "",
    **dict.fromkeys(("warn", "print"), lambda m, *given: None),
    "floordiv": lambda m, a, b: m.number(a // b),
}
NUMBERS: Mapping[str, Callable[[Any, Any], Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "eq": operator.eq,
    "ne": operator.ne,
    "lt": operator.lt,
    "le": operator.le,
    "gt": operator.gt,
    "ge": operator.ge,
}
