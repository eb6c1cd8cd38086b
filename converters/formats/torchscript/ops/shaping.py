"""Ops that put elements elsewhere. Those that give a view in PyTorch give one here: what is written to it shows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.formats.torchscript.machine import Machine, unknown_length
from export_model.converters.formats.torchscript.ops.scalars import dtype_of
from export_model.converters.formats.torchscript.values import OpenLength, Put, ScriptTensor, Show, TensorView
from export_model.converters.graph.types import FLOAT32, INT64, Dim
from export_model.signatures.errors import UnsupportedOpError

#: What stands for "to the end" in a slice.
_END = (1 << 63) - 1
_MAX_PARTS = 1024


def _view(x: ScriptTensor, show: Show, put: Put | None = None) -> ScriptTensor:
    return TensorView(x, show, put)


def _tensor(x: Any) -> ScriptTensor:
    if not isinstance(x, ScriptTensor):
        raise UnsupportedOpError(f"a {type(x).__name__} is given where a tensor is expected", why="it has no axes")
    return x


# ------------------------------------------------------------------ parts


def _slice(m: Machine, x: Any, dim: Any = 0, start: Any = None, end: Any = None, step: Any = 1) -> Any:
    if isinstance(x, list):
        return x[dim:start:end] if end is not None else x[dim:start]
    x = _tensor(x)
    axis = m.b.axis(x.read(), dim)
    length = m.b.shape(x.read())[axis]
    first, last = _bounds(start, end, length)
    if first in (None, 0) and last is None and step == 1:
        return _view(x, lambda whole: whole, lambda whole, part: part)

    def show(whole: str) -> str:
        made = m.b.slice(whole, axis, first, last, step)
        known = _sliced_length(first, last) if isinstance(length, str) and step == 1 else None
        if known is not None:
            kind = m.b.types[made]
            dims = tuple(known if i == axis else d for i, d in enumerate(kind.shape or ()))
            m.b.types[made] = replace(kind, shape=dims)
        return made

    def put(whole: str, part: str) -> str:
        before = [m.b.slice(whole, axis, None, first)] if first else []
        after = [] if last is None else [m.b.slice(whole, axis, last, None)]
        return m.b.concat([*before, part, *after], axis)

    return _view(x, show, put if step == 1 else None)


def _bounds(start: Any, end: Any, length: Dim) -> tuple[int | None, int | None]:
    """From where to where, as numpy counts; within the axis where its length is known."""
    first, last = start, None if end is None or end >= _END else end
    if isinstance(length, int):
        first, last, _ = slice(first, last).indices(length)
        return first, None if last == length else max(last, first)
    return first, last


def _sliced_length(first: int | None, last: int | None) -> int | None:
    """How long a part of an axis of unknown length is, if the axis is long enough."""
    if last is None:
        return -first if first is not None and first < 0 else None
    same_side = (first or 0) >= 0 and last >= 0
    return last - (first or 0) if same_side and last > (first or 0) else None


def _select(m: Machine, x: Any, dim: Any, index: Any) -> ScriptTensor:
    x = _tensor(x)
    axis = m.b.axis(x.read(), dim)
    length = m.b.shape(x.read())[axis]
    at = index + length if isinstance(length, int) and index < 0 else index
    if isinstance(length, int) and not 0 <= at < length:
        raise UnsupportedOpError(f"an element beyond {length} is taken", why="there is none")
    end = at + 1 if at != -1 else None

    def put(whole: str, part: str) -> str:
        before = [m.b.slice(whole, axis, None, at)] if at else []
        after = [] if end is None or end == length else [m.b.slice(whole, axis, end, None)]
        return m.b.concat([*before, m.b.expand_dims(part, axis), *after], axis)

    return _view(x, lambda whole: m.b.squeeze(m.b.slice(whole, axis, at, end), [axis]), put)


def _split_by(m: Machine, x: Any, sizes: Sequence[int], dim: Any) -> list[ScriptTensor]:
    ends = np.cumsum([0, *sizes]).tolist()
    if len(sizes) > _MAX_PARTS:
        raise UnsupportedOpError(f"it is cut into {len(sizes)} parts", why=f"up to {_MAX_PARTS} are known")
    return [_slice(m, x, dim, int(a), int(b)) for a, b in itertools.pairwise(ends)]


def _split(m: Machine, x: Any, size: Any, dim: Any = 0) -> list[ScriptTensor]:
    if isinstance(size, list | tuple):
        return _split_by(m, x, size, dim)
    length = m.b.length(_tensor(x).read(), dim)
    full, rest = divmod(length, size)
    if full > _MAX_PARTS:
        raise UnsupportedOpError(f"it is cut into {full} parts", why=f"up to {_MAX_PARTS} are known")
    return _split_by(m, x, [size] * full + ([rest] if rest else []), dim)


def _chunk(m: Machine, x: Any, chunks: Any, dim: Any = 0) -> list[ScriptTensor]:
    return _split(m, x, -(-m.b.length(_tensor(x).read(), dim) // chunks), dim)


def _unbind(m: Machine, x: Any, dim: Any = 0) -> list[ScriptTensor]:
    length = m.b.length(_tensor(x).read(), dim)
    if length > _MAX_PARTS:
        raise UnsupportedOpError(f"it is cut into {length} parts", why=f"up to {_MAX_PARTS} are known")
    return [_select(m, x, dim, i) for i in range(length)]


def _index_select(m: Machine, x: Any, dim: Any, index: Any) -> ScriptTensor:
    value = m.ref(x)
    places = [int(n) for n in m.constant_numbers(index, "which elements are taken").reshape(-1)]
    length = m.b.length(value, dim)
    if any(not -length <= n < length for n in places):
        raise UnsupportedOpError(f"an element beyond {length} is taken", why="there is none")
    return ScriptTensor(m.b.take(value, [n % length for n in places], m.b.axis(value, dim)))


def _known_list(m: Machine, indices: Any) -> tuple[int, Any]:
    """(axis, list of places) of ``x[:, index]`` with one list that is known."""
    given = [(axis, i) for axis, i in enumerate(indices) if i is not None]
    if len(given) != 1 or m.b.rank(m.ref(given[0][1])) != 1:
        raise UnsupportedOpError("elements are taken by several lists, or by a mask", why="one list is known")
    if m.constant_numbers(given[0][1], "which elements are taken").dtype.kind == "b":
        raise UnsupportedOpError("elements are taken by a mask", why="how many there are must be known")
    return given[0]


def _index(m: Machine, x: Any, indices: Any) -> ScriptTensor:
    return _index_select(m, x, *_known_list(m, indices))


def _index_put(m: Machine, x: Any, indices: Any, values: Any, accumulate: Any = False) -> ScriptTensor:
    """``x[:, index] = values``: both joined, and of each place what it has now."""
    axis, index = _known_list(m, indices)
    before, length = m.ref(x), m.b.length(m.ref(x), axis)
    places = m.constant_numbers(index, "which elements are set")
    if not ((-length <= places) & (places < length)).all() or len({*(places % length).tolist()}) < len(places):
        raise UnsupportedOpError(f"elements of {length} are set twice or beyond", why="which one stays is not told")
    if accumulate:
        raise UnsupportedOpError("it adds to elements by a list", why="setting them is known")
    shape = [len(places) if i == axis else n for i, n in enumerate(m.b.shape(before))]
    given = m.b.cast(m.b.broadcast(m.ref(values), shape), m.b.dtype(before))
    order = np.arange(length)
    order[places] = length + np.arange(len(places))
    return ScriptTensor(m.b.take(m.b.concat([before, given], axis), order.tolist(), axis))


# ------------------------------------------------------------------ other shapes


def _dims(m: Machine, x: str, wanted: Sequence[Any]) -> list[int]:
    """The shape that is asked for, its −1 worked out where the rest is known."""
    dims = [int(n) for n in wanted]
    own = m.b.shape(x)
    if dims.count(-1) == 1 and all(isinstance(d, int) for d in own):
        rest = math.prod(d for d in dims if d != -1)
        size = math.prod(int(d) for d in own)
        if rest <= 0 or size % rest:
            raise UnsupportedOpError(f"{list(own)} is seen as {dims}", why="the numbers do not fit")
        dims[dims.index(-1)] = size // rest
    return dims


def _reshape(m: Machine, x: Any, shape: Any) -> ScriptTensor:
    x = _tensor(x)
    if isinstance(shape, int):
        return ScriptTensor(m.b.cast(x.read(), dtype_of(shape)))  # view(dtype)
    before, dims = m.b.shape(x.read()), _dims(m, x.read(), shape)
    return _view(x, lambda whole: m.b.reshape(whole, dims), lambda whole, part: m.b.reshape(part, before))


def _flatten(m: Machine, x: Any, start: Any = 0, end: Any = -1) -> ScriptTensor:
    value = _tensor(x).read()
    shape = m.b.shape(value)
    first, last = m.b.axis(value, start), m.b.axis(value, end)
    inner = [d for d in shape[first : last + 1] if isinstance(d, int)]
    if len(inner) <= last - first:
        return _reshape(m, x, [*shape[:first], -1, *shape[last + 1 :]])
    return _reshape(m, x, [*shape[:first], math.prod(inner), *shape[last + 1 :]])


def _unflatten(m: Machine, x: Any, dim: Any, sizes: Sequence[Any]) -> ScriptTensor:
    value = _tensor(x).read()
    axis, dims = m.b.axis(value, dim), [*_size(m, x)]
    return _reshape(m, x, [*dims[:axis], *sizes, *dims[axis + 1 :]])


def _unsqueeze(m: Machine, x: Any, dim: Any) -> ScriptTensor:
    x = _tensor(x)
    axis = m.b.axis_of(dim, m.b.rank(x.read()) + 1)
    return _view(x, lambda whole: m.b.expand_dims(whole, axis), lambda whole, part: m.b.squeeze(part, [axis]))


def _squeeze(m: Machine, x: Any, dim: Any = None) -> ScriptTensor:
    given = _tensor(x)
    shape = m.b.shape(given.read())
    wanted = range(len(shape)) if dim is None else [dim] if isinstance(dim, int) else dim
    axes = sorted({m.b.axis(given.read(), a) for a in wanted if shape and shape[m.b.axis(given.read(), a)] == 1})
    if not axes:
        return given

    def put(whole: str, part: str) -> str:
        for axis in axes:
            part = m.b.expand_dims(part, axis)
        return part

    return _view(given, lambda whole: m.b.squeeze(whole, axes), put)


def _permute(m: Machine, x: Any, dims: Sequence[Any]) -> ScriptTensor:
    x = _tensor(x)
    order = [m.b.axis(x.read(), a) for a in dims]
    back = [order.index(i) for i in range(len(order))]
    return _view(x, lambda whole: m.b.transpose(whole, order), lambda whole, part: m.b.transpose(part, back))


def _transpose(m: Machine, x: Any, first: Any, second: Any) -> ScriptTensor:
    value = _tensor(x).read()
    order = list(range(m.b.rank(value)))
    a, b = m.b.axis(value, first), m.b.axis(value, second)
    order[a], order[b] = order[b], order[a]
    return _permute(m, x, order)


def _swap_axes(m: Machine, x: Any) -> ScriptTensor:
    given = _tensor(x)
    return _transpose(m, given, 0, 1) if m.b.rank(given.read()) > 1 else given


# ------------------------------------------------------------------ more elements


def _cat(m: Machine, parts: Sequence[Any], dim: Any = 0) -> ScriptTensor:
    given = [m.ref(p) for p in parts]
    if any(m.b.dtype(r) != m.b.dtype(given[0]) for r in given):
        given = [m.b.cast(r, FLOAT32) for r in given]
    axis = m.b.axis(given[0], dim)
    for other in given[1:]:
        for at, (mine, its) in enumerate(zip(m.b.shape(given[0]), m.b.shape(other), strict=True)):
            if at != axis and mine != its:
                known, open_one = (its, given[0]) if isinstance(its, int) else (mine, other)
                if isinstance(known, int):
                    m.expect(open_one, at, known)
    return ScriptTensor(m.b.concat(given, axis))


def _stack(m: Machine, parts: Sequence[Any], dim: Any = 0) -> ScriptTensor:
    return _cat(m, [_unsqueeze(m, p, dim) for p in parts], dim)


def _expand(m: Machine, x: Any, sizes: Sequence[Any], implicit: Any = False) -> ScriptTensor:
    value = _tensor(x).read()
    own = (1,) * (len(sizes) - m.b.rank(value)) + tuple(m.b.shape(value))
    dims = [o if n == -1 else n for o, n in zip(own, sizes, strict=True)]
    return ScriptTensor(m.b.broadcast(value, dims))


def _expand_as(m: Machine, x: Any, other: Any) -> ScriptTensor:
    return ScriptTensor(m.b.broadcast(m.ref(x), m.b.shape(m.ref(other))))


def _repeat(m: Machine, x: Any, times: Sequence[Any]) -> ScriptTensor:
    value = _tensor(x).read()
    own = (1,) * (len(times) - m.b.rank(value)) + tuple(m.b.shape(value))
    return ScriptTensor(m.b.add("Tile", [m.b.reshape(value, own), m.b.ints([int(n) for n in times], "times")]))


def _full(m: Machine, shape: Sequence[Any], value: Any, dtype: Any = None, *rest: Any, **named: Any) -> ScriptTensor:
    dims = [int(n) for n in shape]
    m.b.room(math.prod(dims))
    kind = (INT64 if isinstance(value, int) and not isinstance(value, bool) else FLOAT32) if dtype is None else None
    return ScriptTensor(m.b.const(np.full(dims, value, kind or dtype_of(dtype))))


def _zeros(value: float) -> Callable[..., ScriptTensor]:
    def translate(m: Machine, shape: Sequence[Any], dtype: Any = None, *rest: Any, **named: Any) -> ScriptTensor:
        return _full(m, shape, value, dtype if dtype is not None else 6)

    return translate


def _like(value: float) -> Callable[..., ScriptTensor]:
    def translate(m: Machine, x: Any, dtype: Any = None, *rest: Any, **named: Any) -> ScriptTensor:
        like = m.ref(x)
        made = m.b.broadcast(m.b.number(like, value), m.b.shape(like))
        return ScriptTensor(made if dtype is None else m.b.cast(made, dtype_of(dtype)))

    return translate


def _tensor_of(m: Machine, value: Any, dtype: Any = None, *rest: Any, **named: Any) -> ScriptTensor:
    """``torch.tensor`` of numbers."""
    array = np.array(value)
    if array.dtype.kind not in "biuf" or array.size > _MAX_PARTS:
        raise UnsupportedOpError("a tensor must be made of a list of numbers", why="its code is damaged")
    kind = {"f": FLOAT32, "b": array.dtype}.get(array.dtype.kind, INT64) if dtype is None else dtype_of(dtype)
    return ScriptTensor(m.b.const(array.astype(kind)))


def _arange(m: Machine, *given: Any, **named: Any) -> ScriptTensor:
    bounds = [n for n in given if isinstance(n, int) and not isinstance(n, bool)]
    start, end = (0, bounds[0]) if len(given) < 2 or given[1] is None else (bounds[0], bounds[1])
    m.b.room(end - start)
    return ScriptTensor(m.b.const(np.arange(start, end)))


def _to(m: Machine, x: Any, *given: Any, **named: Any) -> ScriptTensor:
    """``x.to(…)``: another dtype where one is named, or that of another tensor; a device makes no difference."""
    x = _tensor(x)
    asked = [v for v in (named.get("dtype"), *given[:2]) if isinstance(v, int) and not isinstance(v, bool)]
    other = next((v for v in given[:1] if isinstance(v, ScriptTensor)), None)
    if other is not None:
        return _cast(m, x, m.b.dtype(other.read()))
    return _cast(m, x, dtype_of(asked[0])) if asked else x


def _cast(m: Machine, x: ScriptTensor, dtype: np.dtype[Any]) -> ScriptTensor:
    return x if m.b.dtype(x.read()) == dtype else ScriptTensor(m.b.cast(x.read(), dtype))


def _size(m: Machine, x: Any, dim: Any = None) -> Any:
    value = _tensor(x).read()
    if dim is None:
        return [_length(m, value, axis) for axis in range(m.b.rank(value))]
    return _length(m, value, dim)


def _length(m: Machine, value: str, axis: int) -> Any:
    length = m.b.shape(value)[m.b.axis(value, axis)]
    if isinstance(length, str) and not m.is_open(length):
        raise unknown_length()
    if isinstance(length, str):
        return OpenLength(length)
    return length


def _same(m: Machine, x: Any, *given: Any, **named: Any) -> Any:
    return x


def _copy(m: Machine, x: Any, *given: Any, **named: Any) -> ScriptTensor:
    return ScriptTensor(m.ref(x))


OPS: Mapping[str, Callable[..., Any]] = {
    "slice": _slice,
    "narrow": lambda m, x, dim, start, length: _slice(m, x, dim, start, start + length),
    "select": _select,
    "split": _split,
    "split_with_sizes": _split_by,
    "chunk": _chunk,
    "unsafe_chunk": _chunk,
    "unsafe_split": _split,
    "unbind": _unbind,
    "index_select": _index_select,
    "index": _index,
    "index_put": _index_put,
    "view": _reshape,
    "reshape": _reshape,
    "_unsafe_view": _reshape,
    "view_as": lambda m, x, other: _reshape(m, x, _size(m, other)),
    "flatten": _flatten,
    "unflatten": _unflatten,
    "unsqueeze": _unsqueeze,
    "squeeze": _squeeze,
    "permute": _permute,
    "transpose": _transpose,
    "t": _swap_axes,
    "numpy_T": lambda m, x: _permute(m, x, range(m.b.rank(_tensor(x).read()))[::-1]),
    "cat": _cat,
    "concat": _cat,
    "stack": _stack,
    "hstack": lambda m, parts: _cat(m, parts, 1),
    "expand": _expand,
    "expand_as": _expand_as,
    "repeat": _repeat,
    "full": _full,
    "zeros": _zeros(0),
    "ones": _zeros(1),
    "zeros_like": _like(0),
    "ones_like": _like(1),
    "tensor": _tensor_of,
    "arange": _arange,
    "to": _to,
    "type_as": lambda m, x, other: _cast(m, _tensor(x), m.b.dtype(m.ref(other))),
    "size": _size,
    "dim": lambda m, x: m.b.rank(_tensor(x).read()),
    "numel": lambda m, x: math.prod(_size(m, x)),
    **dict.fromkeys(("contiguous", "detach", "alias", "cpu", "cuda", "lift_fresh"), _same),
    "clone": _copy,
    "is_cuda": lambda m, x: False,
    "ops.prim.is_cuda": lambda m, x: False,
}
