"""MultiHeadAttention, GroupedQueryAttention, dot-product and additive attention, as matrix products."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.nn.reduction import over_last_axis
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import UnsupportedOpError

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
    if step.get("attention_axes") not in (None, [1], [1, 1], 1):
        raise UnsupportedOpError("it looks along several axes")
    heads, width = int(step.get("num_heads")), int(step.get("key_dim"))
    return _attend(step, heads, heads, width, int(step.get("value_dim") or width))


def _grouped_query(step: Step) -> list[str]:
    """MultiHeadAttention where several heads of the query share a head of key and value."""
    heads, shared = int(step.get("num_query_heads")), int(step.get("num_key_value_heads"))
    if shared < 1 or heads % shared:
        raise step.damaged_error(f"shares {shared} heads among {heads}")
    width = int(step.get("head_dim"))
    return _attend(step, heads, shared, width, width)


def _attend(step: Step, heads: int, shared: int, width: int, value_width: int) -> list[str]:
    """Softmax of query·keyᵀ/√width times the value, for each head; ``shared`` are the heads of key and value."""
    b = step.net
    step.refuse_unless("use_gate", False)
    step.refuse_unless("sliding_window", None)
    tensors = dict(zip(("query", "value", "key"), step.tensors, strict=False))
    tensors |= {k: v for k, v in step.kwargs.items() if k in ("query", "value", "key") and v is not None}
    query, value = tensors["query"], tensors["value"]
    if any(b.rank(t) != 3 for t in (query, value, tensors.get("key", value))):
        raise UnsupportedOpError("it looks along several axes")
    projected = [_project_heads(step, query, heads, heads, width)]
    for source, size in ((tensors.get("key", value), width), (value, value_width)):
        projected.append(_project_heads(step, source, shared, heads, size))
    scaled = b.add("Mul", [projected[0], b.number(projected[0], 1 / math.sqrt(width))])
    scores = matmul(b, scaled, b.transpose(projected[1], [0, 1, 3, 2]))
    mask = step.kwargs.get("attention_mask")
    if mask is not None:
        scores = _mask_scores(b, scores, mask)
    if step.kwargs.get("use_causal_mask"):
        scores = _causal(b, scores)
    shares = over_last_axis(b, "Softmax", scores)
    seen = b.transpose(matmul(b, shares, projected[2]), [0, 2, 1, 3])
    rows, length, *_ = b.shape(query)
    seen = b.reshape(seen, (rows, length, heads * value_width))
    kernel = step.take(heads, value_width, None)
    result = matmul(b, seen, b.const(kernel.reshape(-1, kernel.shape[-1]), "kernel"))
    result = step.add_bias(result, kernel.shape[-1])
    return [result, shares] if step.kwargs.get("return_attention_scores") else [result]


def _project_heads(step: Step, x: str, own: int, heads: int, width: int) -> str:
    """[B, T, n] as [B, heads, T, width]; each of the ``own`` heads serves as many others."""
    b = step.net
    rows, length, _ = b.shape(x)
    kernel = np.repeat(step.take(b.length(x, 2), own, width), heads // own, axis=1)
    value = matmul(b, x, b.const(kernel.reshape(-1, heads * width), "kernel"))
    if step.get("use_bias", True):
        bias = np.repeat(step.take(own, width), heads // own, axis=0)
        value = b.add("BiasAdd", [value, b.const(bias.reshape(-1), "bias")])
    return b.transpose(b.reshape(value, (rows, length, heads, width)), [0, 2, 1, 3])


def _dot_scores(step: Step, query: str, key: str) -> str:
    """query·keyᵀ."""
    b = step.net
    scores = matmul(b, query, b.transpose(key, [0, 2, 1]))
    return b.add("Mul", [scores, b.const(step.take(), "scale")]) if step.get("use_scale") else scores


def _additive_scores(step: Step, query: str, key: str) -> str:
    """Σ scale·tanh(query + key), of each query with each key."""
    b = step.net
    met = b.add("Tanh", [b.add("Add", [b.expand_dims(query, 2), b.expand_dims(key, 1)])])
    if step.get("use_scale", True):
        met = b.add("Mul", [met, b.const(step.take(b.length(query, 2)), "scale")])
    return b.reduce("Sum", met, [3], keep=False)


def _attention(step: Step, score: Callable[[Step, str, str], str]) -> list[str]:
    """Softmax of the scores, times the value; query, value and key are [B, T, n]."""
    b = step.net
    step.refuse_unless("score_mode", "dot")
    if step.kwargs.get("mask") is not None:
        raise UnsupportedOpError("it is given masks")
    query, value, *rest = step.tensors
    scores = score(step, query, rest[0] if rest else value)
    if step.kwargs.get("use_causal_mask") or step.get("causal"):
        scores = _causal(b, scores)
    shares = over_last_axis(b, "Softmax", scores)
    result = matmul(b, shares, value)
    return [result, shares] if step.kwargs.get("return_attention_scores") else [result]


LAYERS: Mapping[str, Translate] = {
    "MultiHeadAttention": _multi_head,
    "GroupedQueryAttention": _grouped_query,
    "Attention": partial(_attention, score=_dot_scores),
    "AdditiveAttention": partial(_attention, score=_additive_scores),
}
