"""What a ``.nn`` computes, written from the format's description on [N, H, W, C] arrays in float64.

Naive on purpose, and independent of the kernels: plain loops over pixels, numpy for the elementwise part.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from export_model.converters.formats.barracuda.format import Layer, NnModel

Array = np.ndarray

_erf = np.vectorize(math.erf)


def evaluate(model: NnModel, feeds: Mapping[str, Array], dtype: type = np.float64) -> dict[str, Array]:
    """Every tensor by name; samplers' results must be among ``feeds`` (by the layer's name)."""
    values = {name: np.asarray(array, dtype) for name, array in feeds.items()}
    for layer in model.layers:
        if layer.name in values:
            continue
        data = [model.array(d).astype(dtype) for d in layer.datasets]
        if layer.type == 255:
            for dataset, array in zip(layer.datasets, data, strict=True):
                values[dataset.name] = array
            continue
        args = [values[name] for name in layer.inputs] + data
        with np.errstate(all="ignore"):
            result = compute(layer, args, model.version)
            if layer.type != 50 and layer.activation:
                result = activation(layer.activation, result, 1.0, 0.0)
        values[layer.name] = result.astype(dtype)
    return values


def compute(layer: Layer, args: Sequence[Array], version: int) -> Array:
    x = args[0]
    kind = layer.type
    if kind in (0, 60):
        return x
    if kind == 1:
        product = x.reshape(len(x), -1) @ args[1].reshape(len(args[1]), -1) + args[2].reshape(-1)
        return product[:, None, None, :]
    if kind == 2:
        return _matmul(layer, x, args[1])
    if kind == 3:
        return np.einsum("nhwc,wm->nhmc", x, args[1][:, 0, 0, :]) + args[2].reshape(1, 1, -1, 1)
    if kind == 50:
        if layer.activation == 13:
            return np.maximum(x, 0) + args[1] * np.minimum(x, 0)
        return activation(layer.activation, x, layer.alpha, layer.beta)
    if kind == 51:
        return x * args[1] + args[2]
    if kind == 52:
        mean = x.mean(axis=(1, 2), keepdims=True)
        variance = ((x - mean) ** 2).mean(axis=(1, 2), keepdims=True)
        return (x - mean) / np.sqrt(variance + (layer.beta or 1e-38)) * args[1] + args[2]
    if kind == 67:
        return _one_hot(layer, x, version)
    if kind in WINDOWS:
        return WINDOWS[kind](layer, *args)
    if kind in (29, 160, 161, 162):
        return _border(layer, x)
    if kind == 23:
        return x.repeat(layer.pool[1], axis=1).repeat(layer.pool[0], axis=2)
    if kind in FOLDS:
        total = x
        for other in args[1:]:
            total = FOLDS[kind](total, other)
        return total / len(args) if kind == 112 else total
    if kind in LOGIC:
        return LOGIC[kind](*args).astype(np.float64)
    if kind == 149:
        return np.where(x != 0, args[1], args[2])
    if kind == 150:
        return np.sign(x)
    axis = layer.axis if layer.axis < 0 else layer.axis if version < 17 else {2: 0, 5: 1, 6: 2, 7: 3}.get(layer.axis, 9)
    if kind in REDUCTIONS:
        return REDUCTIONS[kind](x, axis)
    return _moved(layer, args, axis)


def _moved(layer: Layer, args: Sequence[Array], axis: int) -> Array:
    x, kind = args[0], layer.type
    four = [layer.pool[i] for i in (2, 5, 6, 7)] if len(layer.pool) == 8 else list(layer.pool)
    if kind == 200:
        return x.reshape(len(x), 1, 1, -1)
    if kind == 201:
        target = four or list(args[1].shape)
        target = [s if t == 0 else t for t, s in zip(target, x.shape, strict=True)]
        return x.reshape(target)
    if kind == 202:
        if len(layer.pool) == 8:
            four = [{2: 0, 5: 1, 6: 2, 7: 3}[p] for p in four]
        return x.transpose(four)
    if kind in (203, 204):
        return x
    if kind == 205:
        return np.take(x, args[1].reshape(-1).astype(int), axis=axis)
    if kind in (206, 207):
        return _blocks(layer, x)
    if kind == 208:
        return np.broadcast_to(x, [max(a, b) for a, b in zip(x.shape, four, strict=True)])
    if kind == 210:
        return np.concatenate(args, axis=axis)
    if kind == 211:
        return _slice(layer, x)
    if kind == 212:
        return np.tile(x, four)
    raise AssertionError(f"no formula for layer type {kind}")


# ------------------------------------------------------------------ activations


def _softmax(x: Array) -> Array:
    rows = x.reshape(len(x), -1)
    e = np.exp(rows - rows.max(axis=1, keepdims=True))
    return (e / e.sum(axis=1, keepdims=True))[:, None, None, :]


def _hardmax(x: Array) -> Array:
    rows = x.reshape(len(x), -1)
    result = np.zeros_like(rows)
    result[np.arange(len(rows)), rows.argmax(axis=1)] = 1
    return result[:, None, None, :]


def activation(number: int, x: Array, a: float, b: float) -> Array:
    formulas: dict[int, Callable[[], Array]] = {
        0: lambda: x,
        1: lambda: np.maximum(x, 0),
        2: lambda: _softmax(x),
        3: lambda: np.tanh(x),
        4: lambda: 1 / (1 + np.exp(-x)),
        5: lambda: np.where(x <= 0, a * (np.exp(x) - 1), x),
        6: lambda: np.minimum(np.maximum(x, 0), 6),
        7: lambda: np.where(x < 0, a * x, x),
        8: lambda: b * np.where(x <= 0, a * np.exp(x) - a, x),
        9: lambda: x / (1 + np.exp(-x)),
        10: lambda: np.log(_softmax(x)),
        11: lambda: np.log(np.exp(x) + 1),
        12: lambda: x / (1 + np.abs(x)),
        20: lambda: _hardmax(x),
        21: lambda: np.maximum(0, np.minimum(1, a * x + b)),
        100: lambda: np.abs(x),
        101: lambda: -x,
        102: lambda: np.ceil(x),
        103: lambda: np.clip(x, a, b),
        104: lambda: np.floor(x),
        105: lambda: np.round(x),
        110: lambda: 1 / x,
        111: lambda: np.sqrt(x),
        112: lambda: x**a,
        113: lambda: np.exp(x),
        114: lambda: np.log(x),
        200: lambda: np.arccos(x),
        201: lambda: np.arccosh(x),
        202: lambda: np.arcsin(x),
        203: lambda: np.arcsinh(x),
        204: lambda: np.arctan(x),
        205: lambda: np.arctanh(x),
        206: lambda: np.cos(x),
        207: lambda: np.cosh(x),
        208: lambda: np.sin(x),
        209: lambda: np.sinh(x),
        210: lambda: np.tan(x),
        211: lambda: _erf(x),
    }
    return formulas[number]()


# ------------------------------------------------------------------ windows


def _pads(layer: Layer, x: Array, kh: int, kw: int) -> tuple[int, int, int, int]:
    """left, top, right, bottom."""
    if layer.pad[0] >= 0:
        left, top, right, bottom = layer.pad
        return left, top, right, bottom
    found = []
    for size, k, stride in ((x.shape[2], kw, layer.stride[0]), (x.shape[1], kh, layer.stride[1])):
        total = max((-(-size // stride) - 1) * stride + k - size, 0)
        small, large = total // 2, total - total // 2
        found.append((small, large) if layer.pad[0] == -1 else (large, small))
    return found[0][0], found[1][0], found[0][1], found[1][1]


def _windows(layer: Layer, x: Array, kh: int, kw: int) -> tuple[tuple[int, int], Callable[[int, int], Array]]:
    """(height, width) of the result, and the pixels under a window as [N, pixels, C] with their offsets."""
    left, top, right, bottom = _pads(layer, x, kh, kw)
    sw, sh = layer.stride
    size = ((x.shape[1] + top + bottom - kh) // sh + 1, (x.shape[2] + left + right - kw) // sw + 1)

    def under(y: int, column: int) -> Array:
        """[N, kh, kw, C], NaN where the image is not."""
        patch = np.full((len(x), kh, kw, x.shape[3]), np.nan)
        for dy, dx in itertools.product(range(kh), range(kw)):
            oy, ox = y * sh + dy - top, column * sw + dx - left
            if 0 <= oy < x.shape[1] and 0 <= ox < x.shape[2]:
                patch[:, dy, dx] = x[:, oy, ox]
        return patch

    return size, under


def _conv(layer: Layer, x: Array, k: Array, b: Array) -> Array:
    (height, width), under = _windows(layer, x, *k.shape[:2])
    out = np.zeros((len(x), height, width, k.shape[3]))
    for y, column in itertools.product(range(height), range(width)):
        out[:, y, column] = np.einsum("nijc,ijck->nk", np.nan_to_num(under(y, column)), k)
    return out + b


def _depthwise(layer: Layer, x: Array, k: Array, b: Array) -> Array:
    (height, width), under = _windows(layer, x, *k.shape[:2])
    out = np.zeros((len(x), height, width, k.shape[3]))
    for y, column in itertools.product(range(height), range(width)):
        out[:, y, column] = np.einsum("nijc,ijc->nc", np.nan_to_num(under(y, column)), k[:, :, 0])
    return out + b


def _conv_trans(layer: Layer, x: Array, k: Array, b: Array) -> Array:
    """Every pixel paints the kernel, times its value, onto the result; then the pads are cut off."""
    kh, kw, _, channels = k.shape
    step = layer.stride[0]
    left, top, right, bottom = layer.pad
    n, h, w, _ = x.shape
    adjust = layer.pool or ((w + left + right - kw) % step, (h + top + bottom - kh) % step)
    height, width = (h - 1) * step + kh - top - bottom + adjust[1], (w - 1) * step + kw - left - right + adjust[0]
    canvas = np.zeros((n, h * step + kh + step, w * step + kw + step, channels))
    for y, column in itertools.product(range(h), range(w)):
        canvas[:, y * step : y * step + kh, column * step : column * step + kw] += np.einsum(
            "nc,ijck->nijk", x[:, y, column], k
        )
    return canvas[:, top : top + height, left : left + width] + b


def _max_pool(layer: Layer, x: Array) -> Array:
    (height, width), under = _windows(layer, x, layer.pool[1], layer.pool[0])
    return np.stack(
        [np.stack([np.nanmax(under(y, c), axis=(1, 2)) for c in range(width)], axis=1) for y in range(height)], axis=1
    )


def _avg_pool(layer: Layer, x: Array) -> Array:
    (height, width), under = _windows(layer, x, layer.pool[1], layer.pool[0])
    return np.stack(
        [np.stack([np.nanmean(under(y, c), axis=(1, 2)) for c in range(width)], axis=1) for y in range(height)], axis=1
    )


WINDOWS: dict[int, Callable[..., Array]] = {
    20: _conv,
    21: _depthwise,
    22: _conv_trans,
    25: _max_pool,
    26: _avg_pool,
    27: lambda layer, x: x.max(axis=(1, 2), keepdims=True),
    28: lambda layer, x: x.mean(axis=(1, 2), keepdims=True),
}


def _border(layer: Layer, x: Array) -> Array:
    pad = layer.pad if len(layer.pad) == 6 else (*layer.pad[:2], 0, *layer.pad[2:], 0)
    n, h, w, c = x.shape
    out = np.zeros((n, h + pad[1] + pad[4], w + pad[0] + pad[3], c + pad[2] + pad[5]))
    for y, column, channel in itertools.product(*map(range, out.shape[1:])):
        place = [y - pad[1], column - pad[0], channel - pad[2]]
        inside = all(0 <= p < s for p, s in zip(place, x.shape[1:], strict=True))
        if not inside and layer.type == 29:
            out[:, y, column, channel] = layer.beta
            continue
        for i, (p, size) in enumerate(zip(place, x.shape[1:], strict=True)):
            last = size - 1
            if layer.type == 160:
                p = -p if p < 0 else last - (p - last) if p > last else p
            elif layer.type == 161:
                p = -p - 1 if p < 0 else last - (p - last) + 1 if p > last else p
            place[i] = min(max(p, 0), last)
        out[:, y, column, channel] = x[:, place[0], place[1], place[2]]
    return out


# ------------------------------------------------------------------ the rest


FOLDS: dict[int, Callable[[Array, Array], Array]] = {
    100: np.add,
    101: np.subtract,
    102: np.multiply,
    103: np.divide,
    104: np.power,
    110: np.minimum,
    111: np.maximum,
    112: np.add,
}

LOGIC: dict[int, Callable[..., Array]] = {
    140: np.greater,
    141: np.greater_equal,
    142: np.less,
    143: np.less_equal,
    144: np.equal,
    145: lambda a, b: (a != 0) | (b != 0),
    146: lambda a, b: (a != 0) & (b != 0),
    147: lambda a: a == 0,
    148: lambda a, b: (a != 0) ^ (b != 0),
}

REDUCTIONS: dict[int, Callable[[Array, int], Array]] = {
    120: lambda x, axis: np.abs(x).sum(axis=axis, keepdims=True),
    121: lambda x, axis: np.sqrt((x * x).sum(axis=axis, keepdims=True)),
    122: lambda x, axis: np.log(x.sum(axis=axis, keepdims=True)),
    123: lambda x, axis: np.log(np.exp(x).sum(axis=axis, keepdims=True)),
    124: lambda x, axis: x.max(axis=axis, keepdims=True),
    125: lambda x, axis: x.mean(axis=axis, keepdims=True),
    126: lambda x, axis: x.min(axis=axis, keepdims=True),
    127: lambda x, axis: x.prod(axis=axis, keepdims=True),
    128: lambda x, axis: x.sum(axis=axis, keepdims=True),
    129: lambda x, axis: (x * x).sum(axis=axis, keepdims=True),
    163: lambda x, axis: x.argmax(axis=axis)[(slice(None),) * (axis % 4) + (None,)].astype(float),
    164: lambda x, axis: x.argmin(axis=axis)[(slice(None),) * (axis % 4) + (None,)].astype(float),
}


def _matmul(layer: Layer, x: Array, y: Array) -> Array:
    ranks = layer.pool or (2, 2)
    if ranks == (2, 2):
        return (x.reshape(len(x), -1) @ y.reshape(len(y), -1))[:, None, None, :]
    if ranks == (3, 3):  # [N, 1, W, C] is ONNX's [N, C, W]
        return (x[:, 0].transpose(0, 2, 1) @ y[:, 0].transpose(0, 2, 1)).transpose(0, 2, 1)[:, None]
    left = x.transpose(0, 3, 1, 2)  # ONNX order: N, C, H, W
    right = y[:, 0, 0, :] if ranks[1] == 2 else y.transpose(0, 3, 1, 2)
    return (left @ right).transpose(0, 2, 3, 1)


def _one_hot(layer: Layer, x: Array, version: int) -> Array:
    depth = layer.pool[0]
    n = len(x)
    index = x.reshape(n, -1).astype(int)
    hot = np.where(index[..., None] == np.arange(depth), layer.alpha, layer.beta)  # [N, count, depth]
    if version <= 16:
        return hot[:, None]
    if layer.axis == 2:
        return hot.transpose(0, 2, 1)[:, None]
    return hot.reshape(n, 1, 1, depth)


def _slice(layer: Layer, x: Array) -> Array:
    picks = []
    for begin, end, stride, length in zip(
        *(_four(v) for v in (layer.pad, layer.pool, layer.stride)), x.shape, strict=True
    ):
        first = begin % length if begin < length else length
        if stride == 0:
            picks.append(slice(first, first + 1))
            continue
        last = length if end == 0 or end >= length else end % length
        picks.append(slice(first, last, stride))
    return x[tuple(picks)]


def _four(values: Sequence[int]) -> list[int]:
    return [values[i] for i in (2, 5, 6, 7)] if len(values) == 8 else list(values)


def _blocks(layer: Layer, x: Array) -> Array:
    across, down = layer.pool
    n, h, w, c = x.shape
    if layer.type == 207:
        out = np.zeros((n, h // down, w // across, c * across * down))
        for y, column, k in itertools.product(*map(range, out.shape[1:])):
            out[:, y, column, k] = x[:, y * down + k // c // across, column * across + k // c % across, k % c]
        return out
    deep = c // (across * down)
    out = np.zeros((n, h * down, w * across, deep))
    for y, column, k in itertools.product(*map(range, out.shape[1:])):
        by, bx = y % down, column % across
        source = k * across * down + by * across + bx if layer.axis == 1 else (by * across + bx) * deep + k
        out[:, y, column, k] = x[:, y // down, column // across, source]
    return out
