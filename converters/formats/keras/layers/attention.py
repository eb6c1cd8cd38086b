"""MultiHeadAttention and dot-product attention, as matrix products."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from converters.formats.keras.layers.step import Step, Translate
from converters.graph.builder import Builder
from converters.graph.nn.linear import matmul
from converters.graph.nn.reduction import over_last_axis
from converters.graph.types import FLOAT32
from signatures.errors import UnsupportedOpError

#: What is added to the score of what must not be looked at.
_HIDDEN = -1e9


def _mask_scores(b: Builder, scores: str, mask: str) -> str:
    """Scores [B, …, T, S] with those at a mask's zeros [B, T, S] far below all others."""
    shown = b.cast(mask, FLOAT32)
    rank = b.rank(scores)
    while b.rank(shown) < rank:
        shown = b.expand_dims(shown, 1)
    hidden = b.add("Mul", [b.add("Sub", [b.number(shown, 1), shown]), b.number(shown, _HIDDEN)])
    return b.add("Add", [scores, hidden])


def _causal(b: Builder, scores: str) -> str:
    """Scores [B, …, T, S] without those of later steps."""
    rows, columns = b.length(scores, -2), b.length(scores, -1)
    b.room(rows * columns)
    later = np.triu(np.full((rows, columns), _HIDDEN, FLOAT32), 1)
    return b.add("Add", [scores, b.const(later.reshape((1,) * (b.rank(scores) - 2) + later.shape), "later")])


def _multi_head(step: Step) -> list[str]:
    """Query, value and key [B, T, n]; kernels [n, heads, width], the last [heads, width, out]."""
    b, heads = step.net, int(step.get("num_heads"))
    step.refuse_unless("use_gate", False)
    step.refuse_unless("sliding_window", None)
    tensors = dict(zip(("query", "value", "key"), step.tensors, strict=False))
    tensors |= {k: v for k, v in step.kwargs.items() if k in ("query", "value", "key") and v is not None}
    query, value = tensors["query"], tensors["value"]
    sources = (query, tensors.get("key", value), value)
    if any(b.rank(t) != 3 for t in sources) or step.get("attention_axes") not in (None, [1], [1, 1], 1):
        raise UnsupportedOpError("it looks along several axes")
    width = int(step.get("key_dim"))
    widths = (width, width, int(step.get("value_dim") or width))
    parts = [_project_heads(step, t, heads, n) for t, n in zip(sources, widths, strict=True)]
    scaled = b.add("Mul", [parts[0], b.number(parts[0], 1 / math.sqrt(width))])
    scores = matmul(b, scaled, b.transpose(parts[1], [0, 1, 3, 2]))
    mask = step.kwargs.get("attention_mask")
    if mask is not None:
        scores = _mask_scores(b, scores, mask)
    if step.kwargs.get("use_causal_mask"):
        scores = _causal(b, scores)
    shares = over_last_axis(b, "Softmax", scores)
    seen = b.transpose(matmul(b, shares, parts[2]), [0, 2, 1, 3])
    rows, length, *_ = b.shape(query)
    seen = b.reshape(seen, (rows, length, heads * widths[2]))
    kernel = step.take(heads, widths[2], None)
    result = matmul(b, seen, b.const(kernel.reshape(-1, kernel.shape[-1]), "kernel"))
    result = step.add_bias(result, kernel.shape[-1])
    return [result, shares] if step.kwargs.get("return_attention_scores") else [result]


def _project_heads(step: Step, x: str, heads: int, width: int) -> str:
    """[B, T, n] as [B, heads, T, width]."""
    b = step.net
    rows, length, _ = b.shape(x)
    kernel = step.take(b.length(x, 2), heads, width)
    value = matmul(b, x, b.const(kernel.reshape(-1, heads * width), "kernel"))
    if step.get("use_bias", True):
        value = b.add("BiasAdd", [value, b.const(step.take(heads, width).reshape(-1), "bias")])
    return b.transpose(b.reshape(value, (rows, length, heads, width)), [0, 2, 1, 3])


def _dot_product(step: Step) -> list[str]:
    """Softmax of query·keyᵀ, times the value; query, value and key are [B, T, n]."""
    b = step.net
    step.refuse_unless("score_mode", "dot")
    if step.kwargs.get("mask") is not None:
        raise UnsupportedOpError("it is given masks")
    query, value, *rest = step.tensors
    scores = matmul(b, query, b.transpose(rest[0] if rest else value, [0, 2, 1]))
    if step.get("use_scale"):
        scores = b.add("Mul", [scores, b.const(step.take(), "scale")])
    if step.kwargs.get("use_causal_mask") or step.get("causal"):
        scores = _causal(b, scores)
    shares = over_last_axis(b, "Softmax", scores)
    result = matmul(b, shares, value)
    return [result, shares] if step.kwargs.get("return_attention_scores") else [result]


LAYERS: Mapping[str, Translate] = {"MultiHeadAttention": _multi_head, "Attention": _dot_product}
