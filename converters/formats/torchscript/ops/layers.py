"""Layers with weights: products, convolutions, normalisations, pools."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from converters.formats.torchscript.machine import Machine
from converters.formats.torchscript.values import Tensor
from converters.graph.nn import normalisation, pooling
from converters.graph.nn.convolution import Window, conv2d
from converters.graph.nn.linear import matmul
from converters.graph.types import FLOAT32
from signatures.errors import UnsupportedOpError


def _linear(m: Machine, x: Any, weight: Any, bias: Any = None) -> Tensor:
    value, kernel = m.ref(x), m.ref(weight)
    m.expect(value, -1, m.b.length(kernel, -1))
    product = matmul(m.b, value, m.b.transpose(kernel, [1, 0]))
    return Tensor(product if bias is None else m.b.add("BiasAdd", [product, m.ref(bias)]))


def _matmul(m: Machine, x: Any, y: Any) -> Tensor:
    left, right = m.ref(x), m.ref(y)
    m.expect(left, -1, m.b.length(right, max(m.b.rank(right) - 2, 0)))
    return Tensor(matmul(m.b, left, right))


def _addmm(m: Machine, bias: Any, x: Any, y: Any, beta: Any = 1, alpha: Any = 1) -> Tensor:
    if (beta, alpha) != (1, 1):
        raise UnsupportedOpError("a product with factors", why="factors of 1 are known")
    return Tensor(m.b.add("Add", list(m.pair(_matmul(m, x, y), bias))))


# ------------------------------------------------------------------ windows


def _numbers(value: Any, count: int) -> list[int]:
    """One number for each axis."""
    found = [value] if isinstance(value, int) else [int(n) for n in value]
    return found * count if len(found) == 1 else found


def _window(size: Sequence[int], stride: Any, padding: Any, dilation: Any) -> Window:
    axes = len(size)
    strides, gaps = _numbers(stride or list(size), axes), _numbers(dilation, axes)
    if padding == "valid":
        padding = 0
    if isinstance(padding, str):
        raise UnsupportedOpError(f"a padding that is called {padding[:20]!r}", why="numbers are known")
    pads = [(n, n) for n in _numbers(padding, axes)]
    wide = [tuple(v) for v in ((1,) * (2 - axes) + tuple(a) for a in (size, strides, gaps))]
    around = ((0, 0),) * (2 - axes) + tuple(pads)
    if len(around) != 2 or any(len(v) != 2 for v in wide):
        raise UnsupportedOpError(f"a window with {axes} axes", why="one and two are known")
    return Window((wide[0][0], wide[0][1]), (wide[1][0], wide[1][1]), (wide[2][0], wide[2][1]), (around[0], around[1]))


def _as_image(m: Machine, x: Any, axes: int) -> str:
    """[B, C, L] or [B, C, H, W] as [B, H, W, C]."""
    value = m.ref(x)
    if m.b.rank(value) != axes + 2:
        raise UnsupportedOpError(f"a window over {axes} axes of {m.b.rank(value)}", why="a batch and channels go first")
    if axes == 1:
        value = m.b.expand_dims(value, 2)
    return m.b.transpose(value, (0, 2, 3, 1))


def _from_image(m: Machine, image: str, axes: int) -> Tensor:
    value = m.b.transpose(image, (0, 3, 1, 2))
    return Tensor(m.b.squeeze(value, [2]) if axes == 1 else value)


def _convolution(
    m: Machine, x: Any, weight: Any, bias: Any, stride: Any, padding: Any, dilation: Any, groups: Any
) -> Tensor:
    kernel = m.constant_numbers(weight, "the kernel")
    axes = kernel.ndim - 2
    if axes not in (1, 2):
        raise UnsupportedOpError(f"a kernel of {kernel.ndim} axes", why="one and two axes are known")
    m.expect(m.ref(x), 1, kernel.shape[1] * groups)
    window = _window(kernel.shape[2:], stride, padding, dilation)
    wide = kernel if axes == 2 else kernel[:, :, None, :]
    made = conv2d(m.b, _as_image(m, x, axes), wide.transpose(2, 3, 1, 0), window, groups)
    if bias is not None:
        made = m.b.add("BiasAdd", [made, m.ref(bias)])
    return _from_image(m, made, axes)


def _conv(
    m: Machine,
    x: Any,
    weight: Any,
    bias: Any = None,
    stride: Any = 1,
    padding: Any = 0,
    dilation: Any = 1,
    groups: Any = 1,
) -> Tensor:
    return _convolution(
        m, x, weight=weight, bias=bias, stride=stride, padding=padding, dilation=dilation, groups=groups
    )


def _traced_conv(
    m: Machine,
    x: Any,
    weight: Any,
    bias: Any,
    stride: Any,
    padding: Any,
    dilation: Any,
    transposed: Any,
    output_padding: Any,
    groups: Any,
    *rest: Any,
) -> Tensor:
    if transposed:
        raise UnsupportedOpError("a transposed convolution", why="policies have none")
    return _convolution(
        m, x, weight=weight, bias=bias, stride=stride, padding=padding, dilation=dilation, groups=groups
    )


def _max_pool(axes: int) -> Callable[..., Tensor]:
    def translate(
        m: Machine,
        x: Any,
        kernel_size: Any,
        stride: Any = None,
        padding: Any = 0,
        dilation: Any = 1,
        ceil_mode: Any = False,
    ) -> Tensor:
        if ceil_mode:
            raise UnsupportedOpError("a pool with ceil_mode", why="what is beyond the edge is not known")
        window = _window(_numbers(kernel_size, axes), stride, padding, dilation)
        return _from_image(m, pooling.max_pool(m.b, _as_image(m, x, axes), window), axes)

    return translate


def _average_pool(axes: int) -> Callable[..., Tensor]:
    def translate(
        m: Machine,
        x: Any,
        kernel_size: Any,
        stride: Any = None,
        padding: Any = 0,
        ceil_mode: Any = False,
        count_include_pad: Any = True,
        divisor_override: Any = None,
    ) -> Tensor:
        if ceil_mode or divisor_override is not None:
            raise UnsupportedOpError("a pool with ceil_mode or a divisor", why="the plain mean is known")
        window = _window(_numbers(kernel_size, axes), stride, padding, 1)
        counted = window.pads if count_include_pad else None
        return _from_image(m, pooling.average_pool(m.b, _as_image(m, x, axes), window, counted), axes)

    return translate


# ------------------------------------------------------------------ normalisations


def _layer_norm(
    m: Machine, x: Any, shape: Any, weight: Any = None, bias: Any = None, eps: Any = 1e-5, *rest: Any
) -> Tensor:
    value = m.ref(x)
    axis = m.b.rank(value) - len(shape)
    for at, length in enumerate(shape):
        m.expect(value, axis + at, length)
    scale = m.b.floats(np.ones(tuple(shape))) if weight is None else m.ref(weight)
    made, _, _ = normalisation.layer(m.b, value, axis, scale, None if bias is None else m.ref(bias), float(eps))
    return Tensor(made)


def _batch_norm(
    m: Machine,
    x: Any,
    weight: Any,
    bias: Any,
    mean: Any,
    variance: Any,
    training: Any,
    momentum: Any,
    eps: Any,
    *rest: Any,
) -> Tensor:
    if training:
        raise UnsupportedOpError("batch normalisation of a module in training", why="call eval() before it is saved")
    centre, spread = (m.constant_numbers(v, "its statistics") for v in (mean, variance))
    scale = np.ones_like(centre) if weight is None else m.constant_numbers(weight, "its scale")
    shift = np.zeros_like(centre) if bias is None else m.constant_numbers(bias, "its bias")
    value = m.b.cast(m.ref(x), FLOAT32)
    m.expect(value, 1, len(centre))
    with np.errstate(all="ignore"):
        return Tensor(
            normalisation.batch(m.b, value, scale=scale, bias=shift, mean=centre, variance=spread, epsilon=float(eps))
        )


OPS: Mapping[str, Callable[..., Any]] = {
    "linear": _linear,
    "matmul": _matmul,
    "mm": _matmul,
    "bmm": _matmul,
    "mv": _matmul,
    "addmm": _addmm,
    "conv1d": _conv,
    "conv2d": _conv,
    "_convolution": _traced_conv,
    "max_pool1d": _max_pool(1),
    "max_pool2d": _max_pool(2),
    "avg_pool1d": _average_pool(1),
    "avg_pool2d": _average_pool(2),
    "layer_norm": _layer_norm,
    "batch_norm": _batch_norm,
}
