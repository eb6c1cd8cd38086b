"""Functions of ``keras.ops`` on one input, as the models of ``make_models.py``: (shape, dtype, function) by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from keras import layers as k
from keras import ops

WEIGHTS = np.arange(10, dtype="float32").reshape(5, 2) / 9
TABLE = np.arange(12, dtype="float32").reshape(4, 3) / 7


def pixels(x: Any) -> list[Any]:
    """Bytes: what is divided or averaged becomes a float, what is added up or compared stays whole."""
    return [
        *(ops.cast(x, "float32") / 255.0, x / 255, ops.mean(x, axis=-1), ops.sqrt(x), ops.cast(x, "int32") * 2 - 300),
        *(x > 128, ops.equal(x, 7), ops.max(x, axis=1), ops.cast(x > 3, "float32"), ops.cast(x, "bool")),
        *(ops.sum(ops.cast(x, "int32"), axis=1), ops.cast(x, "int32") + 0.5, ops.sum(x > 128, axis=1)),
        *(ops.maximum(ops.cast(x, "int32"), 9), ops.clip(ops.cast(x, "int32"), 3, 200)),
    ]


def compared(x: Any) -> list[Any]:
    above, below = x > 0.5, x < -0.5
    return [
        *(above, below, x >= 0, x <= 0, ops.equal(x, ops.floor(x)), ops.not_equal(x, ops.floor(x))),
        *(ops.logical_and(above, x < 1.5), ops.logical_or(above, below), ops.logical_xor(above, x < 1)),
        *(ops.logical_not(above), ops.where(above, x, 0.0), ops.where(above, 1.0, x), ops.where(above, 1, 0)),
        *(ops.any(above, axis=1), ops.all(x > -1.9, axis=-1, keepdims=True), ops.count_nonzero(above, axis=1)),
        *(ops.where(above, x, ops.exp(below)), ops.isnan(x), ops.isinf(x), ops.isfinite(x / (x - x))),
    ]


def functions(x: Any) -> list[Any]:
    inside, odd = x / 2.1, ops.concatenate([x[:, :2] / 0.0, ops.sqrt(x[:, 2:])], axis=1)
    return [
        *(ops.log(ops.abs(x)), ops.log1p(ops.abs(x)), ops.log2(ops.abs(x)), ops.log10(ops.abs(x)), ops.expm1(x)),
        *(ops.sin(x), ops.cos(x), ops.tan(inside), ops.tanh(x), ops.sinh(x), ops.cosh(x), ops.arctan(x)),
        *(ops.arcsinh(x), ops.arccosh(ops.abs(x) + 1.5), ops.arctanh(inside), ops.sign(x), ops.negative(x)),
        *(ops.rsqrt(ops.abs(x)), ops.reciprocal(x), ops.floor(x), ops.ceil(x), ops.round(x), ops.trunc(x * 3)),
        *(ops.erf(x), ops.erfc(x), ops.square(x), ops.power(ops.abs(x), 1.5), ops.mod(x, 0.7), x // 0.3, x % -0.7),
        *(ops.divide(x, 3.0), ops.divide_no_nan(x, ops.relu(x)), ops.nan_to_num(odd, posinf=8.0, neginf=-9.0)),
        *(
            ops.nan_to_num(odd, nan=2.0),
            ops.minimum(x, 0.2),
            ops.maximum(0.1, x),
            x * np.arange(6, dtype="float32"),
            -x,
        ),
        *(ops.full_like(x, 3.5) * x, ops.zeros_like(x) + x, ops.ones_like(x) + x, ops.stop_gradient(x), ops.copy(x)),
    ]


def bent(x: Any) -> list[Any]:
    names = "relu relu6 sigmoid selu softplus softsign silu hard_sigmoid hard_silu hard_tanh log_sigmoid tanh_shrink"
    return [
        *(getattr(ops, name)(x) for name in f"{names} sparse_plus sparse_sigmoid hard_shrink soft_shrink glu".split()),
        *(ops.squareplus(x), ops.celu(x, 0.7), ops.leaky_relu(x, 0.3), ops.log_softmax(x), ops.elu(x, 0.4)),
        *(ops.gelu(x, approximate=False), ops.softmax(x, axis=-1)),
    ]


def reduced(x: Any) -> list[Any]:
    return [
        *(ops.std(x, axis=1), ops.var(x, axis=[1, 2], keepdims=True), ops.norm(x, axis=1), ops.norm(x, axis=(1, 2))),
        *(ops.norm(x, ord=1, axis=-1, keepdims=True), ops.norm(x, ord=np.inf, axis=2), ops.prod(x, axis=1)),
        *(ops.logsumexp(x, axis=1), ops.sum(x, axis=(1, 2)), ops.min(x, axis=2, keepdims=True), ops.max(x, axis=-1)),
        *(ops.argmax(x, axis=1), ops.argmin(x, axis=-1, keepdims=True), ops.cumsum(x, axis=1), ops.cumprod(x, axis=-1)),
        *(ops.mean(x, axis=2), ops.einsum("bij,bkj->bik", x, x), ops.matmul(x, ops.swapaxes(x, 1, 2))),
        *(ops.matmul(x, WEIGHTS), ops.einsum("bij,jk->bik", x, WEIGHTS)),
    ]


def chosen(x: Any) -> list[Any]:
    index = ops.argmax(x, axis=-1)
    return [
        *(
            ops.sort(x, axis=-1),
            ops.argsort(x, axis=1),
            *ops.top_k(x, 3),
            ops.one_hot(index, 6),
            ops.take(TABLE, index % 4, 0),
        ),
        *(ops.take(x, [3, 1, -2], axis=1), ops.take(x, 2, axis=-1), ops.one_hot(index, 6, axis=0, dtype="int32")),
        ops.take_along_axis(x, ops.expand_dims(index, -1), axis=1),
    ]


def rearranged(x: Any) -> list[Any]:
    return [
        *(ops.pad(x, ((0, 0), (1, 2), (0, 1))), ops.pad(x, ((0, 0), (1, 0), (0, 1)), constant_values=2.5)),
        *(ops.pad(x, ((0, 0), (1, 2), (2, 0)), mode="reflect"), ops.pad(x, ((0, 0), (0, 1), (2, 1)), mode="symmetric")),
        *(ops.flip(x, axis=-1), ops.roll(x, 2, axis=1), ops.repeat(x, 2, axis=1), ops.repeat(x, [1, 0, 2], axis=2)),
        *(ops.tile(x, [1, 2, 1]), ops.moveaxis(x, 1, -1), ops.swapaxes(x, 1, 2), ops.tril(x), ops.triu(x, k=1)),
        *(ops.diff(x, axis=1), ops.diff(x, n=2, axis=1), *ops.split(x, 2, axis=1), *ops.split(x, [1, 3], axis=1)),
        *(*ops.unstack(x, axis=2), x[..., 1], x[:, None, ..., 0], x[..., -2:, :], ops.stack([x, x], axis=1)),
        *(ops.transpose(x, (0, 2, 1)), ops.squeeze(ops.expand_dims(x, 1), 1), ops.expand_dims(x, [1, -1])),
        *(ops.reshape(x, (-1, 12)), ops.concatenate([x, x], axis=2)),
    ]


OPERATIONS: dict[str, tuple[Sequence[int], str, Callable[[Any], Any]]] = {
    "operations on pixels": ([4, 5], "uint8", pixels),
    "operations that compare": ([6], "float32", compared),
    "operations on elements": ([6], "float32", functions),
    "operations that bend": ([6], "float32", bent),
    "operations over axes": ([4, 5], "float32", reduced),
    "operations that choose": ([6], "float32", chosen),
    "operations that rearrange": ([4, 3], "float32", rearranged),
    "operations on an image": (
        [8, 8, 3],
        "uint8",
        lambda x: k.Dense(2)(k.Flatten()(k.Conv2D(4, 3)(ops.cast(x, "float32") / 255.0))),
    ),
}
