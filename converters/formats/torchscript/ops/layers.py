"""Layers with weights: products, convolutions, normalisations, pools."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.formats.torchscript.machine import Machine
from export_model.converters.formats.torchscript.values import ScriptTensor
from export_model.converters.graph.nn import normalisation, pooling
from export_model.converters.graph.nn.activations import scale_and_shift
from export_model.converters.graph.nn.convolution import Window, conv2d, conv2d_transposed
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.types import BOOL, FLOAT32
from export_model.signatures.errors import UnsupportedOpError


def _linear(m: Machine, x: Any, weight: Any, bias: Any = None) -> ScriptTensor:
    value, kernel = m.ref(x), m.ref(weight)
    m.expect(value, -1, m.b.length(kernel, -1))
    product = matmul(m.b, value, m.b.transpose(kernel, [1, 0]))
    return ScriptTensor(product if bias is None else m.b.add("BiasAdd", [product, m.ref(bias)]))


def _matmul(m: Machine, x: Any, y: Any) -> ScriptTensor:
    left, right = m.ref(x), m.ref(y)
    m.expect(left, -1, m.b.length(right, max(m.b.rank(right) - 2, 0)))
    return ScriptTensor(matmul(m.b, left, right))


def _addmm(m: Machine, bias: Any, x: Any, y: Any, beta: Any = 1, alpha: Any = 1) -> ScriptTensor:
    if (beta, alpha) != (1, 1):
        raise UnsupportedOpError("a product with factors", why="factors of 1 are known")
    return ScriptTensor(m.b.add("Add", list(m.pair(_matmul(m, x, y), bias))))


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
    if padding == "same":  # what is odd goes behind
        wide = [gap * (n - 1) for n, gap in zip(size, gaps, strict=True)]
        return _of_two_axes(size, strides, gaps, [(n // 2, n - n // 2) for n in wide])
    if isinstance(padding, str):
        raise UnsupportedOpError(f"a padding that is called {padding[:20]!r}", why="numbers are known")
    return _of_two_axes(size, strides, gaps, [(n, n) for n in _numbers(padding, axes)])


def _of_two_axes(
    size: Sequence[int], strides: Sequence[int], gaps: Sequence[int], pads: Sequence[tuple[int, int]]
) -> Window:
    axes = len(size)
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


def _from_image(m: Machine, image: str, axes: int) -> ScriptTensor:
    value = m.b.transpose(image, (0, 3, 1, 2))
    return ScriptTensor(m.b.squeeze(value, [2]) if axes == 1 else value)


def _convolution(
    m: Machine, x: Any, weight: Any, bias: Any, stride: Any, padding: Any, dilation: Any, groups: Any
) -> ScriptTensor:
    kernel, axes = _kernel(m, weight)
    m.expect(m.ref(x), 1, kernel.shape[1] * groups)
    window = _window(kernel.shape[-axes:], stride, padding, dilation)
    made = conv2d(m.b, _as_image(m, x, axes), kernel.transpose(2, 3, 1, 0), window, groups)
    return _biased_image(m, made, bias, axes)


def _kernel(m: Machine, weight: Any) -> tuple[np.ndarray, int]:
    """[…, …, height, width], the height 1 for one over a row, and how many axes it has of an image."""
    kernel = m.constant_numbers(weight, "the kernel")
    axes = kernel.ndim - 2
    if axes not in (1, 2):
        raise UnsupportedOpError(f"a kernel of {kernel.ndim} axes", why="one and two axes are known")
    return (kernel if axes == 2 else kernel[:, :, None, :]), axes


def _biased_image(m: Machine, image: str, bias: Any, axes: int) -> ScriptTensor:
    return _from_image(m, image if bias is None else m.b.add("BiasAdd", [image, m.ref(bias)]), axes)


def _conv(
    m: Machine,
    x: Any,
    weight: Any,
    bias: Any = None,
    stride: Any = 1,
    padding: Any = 0,
    dilation: Any = 1,
    groups: Any = 1,
) -> ScriptTensor:
    return _convolution(
        m, x, weight=weight, bias=bias, stride=stride, padding=padding, dilation=dilation, groups=groups
    )


def _turn_convolution(
    m: Machine,
    x: Any,
    weight: Any,
    bias: Any = None,
    stride: Any = 1,
    padding: Any = 0,
    output_padding: Any = 0,
    groups: Any = 1,
    dilation: Any = 1,
) -> ScriptTensor:
    """The kernel is [in, out per group, …]."""
    kernel, axes = _kernel(m, weight)
    m.expect(m.ref(x), 1, kernel.shape[0])
    window = _window(kernel.shape[-axes:], stride, padding, dilation)
    extra = _numbers(output_padding, axes)
    behind = (extra[0], extra[1]) if axes == 2 else (0, extra[0])
    made = conv2d_transposed(m.b, _as_image(m, x, axes), kernel.transpose(2, 3, 0, 1), window, behind, groups)
    return _biased_image(m, made, bias, axes)


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
) -> ScriptTensor:
    if transposed:
        return _turn_convolution(
            m,
            x,
            weight=weight,
            bias=bias,
            stride=stride,
            padding=padding,
            output_padding=output_padding,
            groups=groups,
            dilation=dilation,
        )
    return _convolution(
        m, x, weight=weight, bias=bias, stride=stride, padding=padding, dilation=dilation, groups=groups
    )


def _max_pool(axes: int) -> Callable[..., ScriptTensor]:
    def translate(
        m: Machine,
        x: Any,
        kernel_size: Any,
        stride: Any = None,
        padding: Any = 0,
        dilation: Any = 1,
        ceil_mode: Any = False,
    ) -> ScriptTensor:
        if ceil_mode:
            raise UnsupportedOpError("a pool with ceil_mode", why="what is beyond the edge is not known")
        window = _window(_numbers(kernel_size, axes), stride, padding, dilation)
        return _from_image(m, pooling.max_pool(m.b, _as_image(m, x, axes), window), axes)

    return translate


def _average_pool(axes: int) -> Callable[..., ScriptTensor]:
    def translate(
        m: Machine,
        x: Any,
        kernel_size: Any,
        stride: Any = None,
        padding: Any = 0,
        ceil_mode: Any = False,
        count_include_pad: Any = True,
        divisor_override: Any = None,
    ) -> ScriptTensor:
        if ceil_mode or divisor_override is not None:
            raise UnsupportedOpError("a pool with ceil_mode or a divisor", why="the plain mean is known")
        window = _window(_numbers(kernel_size, axes), stride, padding, 1)
        counted = window.pads if count_include_pad else None
        return _from_image(m, pooling.average_pool(m.b, _as_image(m, x, axes), window, counted), axes)

    return translate


# ------------------------------------------------------------------ normalisations


def _layer_norm(
    m: Machine, x: Any, shape: Any, weight: Any = None, bias: Any = None, eps: Any = 1e-5, *rest: Any
) -> ScriptTensor:
    value = m.ref(x)
    axis = m.b.rank(value) - len(shape)
    for at, length in enumerate(shape):
        m.expect(value, axis + at, length)
    scale = m.b.floats(np.ones(tuple(shape))) if weight is None else m.ref(weight)
    made, _, _ = normalisation.layer(m.b, value, axis, scale, None if bias is None else m.ref(bias), float(eps))
    return ScriptTensor(made)


def _rms_norm(m: Machine, x: Any, shape: Any, weight: Any = None, eps: Any = None) -> ScriptTensor:
    """Without an epsilon that of float32 is taken (torch/nn/functional.py)."""
    value = m.ref(x)
    axis = m.b.rank(value) - len(shape)
    scale = m.b.floats(np.ones(tuple(shape))) if weight is None else m.ref(weight)
    least = float(np.finfo(np.float32).eps if eps is None else eps)
    return ScriptTensor(normalisation.rms(m.b, value, axis, scale, least))


def _affine(m: Machine, weight: Any, bias: Any, channels: int) -> tuple[str, str]:
    scale = m.b.floats(np.ones(channels)) if weight is None else m.ref(weight)
    return scale, m.b.floats(np.zeros(channels)) if bias is None else m.ref(bias)


def _group_norm(
    m: Machine, x: Any, groups: Any, weight: Any = None, bias: Any = None, eps: Any = 1e-5, *rest: Any
) -> ScriptTensor:
    value = m.ref(x)
    scale, shift = _affine(m, weight, bias, m.b.length(value, 1))
    return ScriptTensor(normalisation.group(m.b, value, int(groups), scale, shift, float(eps)))


def _instance_norm(
    m: Machine,
    x: Any,
    weight: Any,
    bias: Any,
    mean: Any,
    variance: Any,
    own: Any,
    momentum: Any,
    eps: Any,
    *rest: Any,
) -> ScriptTensor:
    """By the row's own statistics (``own``), or by stored ones, as a batch normalisation."""
    if not own:
        return _batch_norm(m, x, weight, bias, mean, variance, training=False, momentum=momentum, eps=eps)
    value = m.ref(x)
    scale, shift = _affine(m, weight, bias, m.b.length(value, 1))
    return ScriptTensor(normalisation.instance(m.b, value, scale, shift, float(eps)))


def _attention(
    m: Machine,
    query: Any,
    key: Any,
    value: Any,
    mask: Any = None,
    dropout: Any = 0.0,
    causal: Any = False,
    scale: Any = None,
    *rest: Any,
) -> ScriptTensor:
    """Softmax(q·kᵀ·scale + mask)·v over the last two axes; ``causal``: no element sees those behind it."""
    if dropout:
        raise UnsupportedOpError("dropout of a module that is in training", why="call eval() before it is saved")
    q, k, v = (m.ref(t) for t in (query, key, value))
    rank = m.b.rank(k)
    turned = m.b.transpose(k, [*range(rank - 2), rank - 1, rank - 2])
    factor = 1 / math.sqrt(m.b.length(q, -1)) if scale is None else float(scale)
    scores = scale_and_shift(m.b, matmul(m.b, q, turned), factor)
    if causal:
        rows, columns = m.b.length(scores, -2), m.b.length(scores, -1)
        m.b.room(rows * columns)
        seen = m.b.const(np.tril(np.ones((rows, columns), bool)), "seen")
        scores = m.b.where(seen, scores, m.b.number(scores, -np.inf))
    elif mask is not None:
        given = m.ref(mask)
        if m.b.dtype(given) == BOOL:
            scores = m.b.where(given, scores, m.b.number(scores, -np.inf))
        else:
            scores = m.b.add("Add", [scores, given])
    return ScriptTensor(matmul(m.b, m.b.add("Softmax", [scores]), v))


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
) -> ScriptTensor:
    if training:
        raise UnsupportedOpError("batch normalisation of a module in training", why="call eval() before it is saved")
    centre, spread = (m.constant_numbers(v, "its statistics") for v in (mean, variance))
    scale = np.ones_like(centre) if weight is None else m.constant_numbers(weight, "its scale")
    shift = np.zeros_like(centre) if bias is None else m.constant_numbers(bias, "its bias")
    value = m.b.cast(m.ref(x), FLOAT32)
    m.expect(value, 1, len(centre))
    with np.errstate(all="ignore"):
        return ScriptTensor(
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
    "_convolution_mode": _conv,
    "conv_transpose1d": _turn_convolution,
    "conv_transpose2d": _turn_convolution,
    "_convolution": _traced_conv,
    "max_pool1d": _max_pool(1),
    "max_pool2d": _max_pool(2),
    "avg_pool1d": _average_pool(1),
    "avg_pool2d": _average_pool(2),
    "layer_norm": _layer_norm,
    "batch_norm": _batch_norm,
    "rms_norm": _rms_norm,
    "group_norm": _group_norm,
    "instance_norm": _instance_norm,
    "scaled_dot_product_attention": _attention,
    "baddbmm": _addmm,
}
