"""Dense layers, and those that move, join or scale elements."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from export_model.converters.formats.keras.layers.activations import apply_activation
from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.ops.einsum import einsum
from export_model.converters.graph.types import FLOAT32, INT32, Dim


def _dense(step: Step) -> str:
    b, units = step.net, int(step.get("units"))
    step.refuse_unless("quantization_config", None)
    kernel = step.take(b.length(step.x, -1), units)
    return apply_activation(step, step.add_bias(matmul(b, step.x, b.const(kernel, "kernel")), units))


def _einsum_dense(step: Step) -> str:
    b, equation = step.net, str(step.get("equation"))
    step.refuse_unless("quantization_config", None)
    value = einsum(b, equation, [step.x, b.const(step.take(), "kernel")], shape_of=b.shape)
    if step.get("bias_axes"):
        value = b.add("Add", [value, b.const(step.take(), "bias")])
    return apply_activation(step, value)


def _embedding(step: Step) -> str:
    step.refuse_unless("mask_zero", False, None)
    b = step.net
    table = step.take(int(step.get("input_dim")), int(step.get("output_dim")))
    index = b.cast(step.x, INT32)
    return b.add("GatherV2", [b.const(table, "embeddings"), index, b.ints(0, "axis")])


# ------------------------------------------------------------------ shapes


def _flatten(step: Step) -> str:
    b, x = step.net, step.x
    rank = b.rank(x)
    if step.get("data_format") == "channels_first" and rank > 2:
        x = b.transpose(x, [0, *range(2, rank), 1])
    return b.reshape(x, (-1, math.prod(b.length(x, i) for i in range(1, rank))))


def _reshape(step: Step) -> str:
    b, x = step.net, step.x
    target = [int(n) for n in step.get("target_shape")]
    size = math.prod(b.length(x, i) for i in range(1, b.rank(x)))
    if target.count(-1) == 1:
        target[target.index(-1)] = size // max(-math.prod(target), 1)
    if math.prod(target) != size or min(target, default=1) < 0:
        raise step.damaged_error(f"makes {target} of {size} numbers")
    return b.reshape(x, (b.shape(x)[0], *target))


def _repeat_vector(step: Step) -> str:
    if step.rank != 2:
        raise step.damaged_error("takes [B, n]")
    b = step.net
    rows, width = b.shape(step.x)
    return b.broadcast(b.reshape(step.x, (rows, 1, width)), (rows, int(step.get("n")), width))


def _pairs(value: Any, axes: int) -> list[tuple[int, int]]:
    """``2``, ``(1, 2)``, ``((1, 2), (3, 4))`` as one pair per axis."""
    if isinstance(value, int):
        return [(value, value)] * axes
    if axes == 1 and len(value) == 2 and isinstance(value[0], int):
        return [(int(value[0]), int(value[1]))]
    return [(int(v), int(v)) if isinstance(v, int) else (int(v[0]), int(v[1])) for v in value]


def _pad_or_crop(step: Step, key: str, sign: int) -> str:
    """Paddings (sign 1) or croppings (−1) of the axes between batch and channels."""
    axes = step.rank - 2
    pairs = [(sign * a, sign * z) for a, z in _pairs(step.get(key), axes)]
    first = step.get("data_format") == "channels_first"
    for axis, (a, z) in enumerate(pairs, 2 if first else 1):
        if sign < 0 and -a - z >= step.net.length(step.x, axis):
            raise step.damaged_error("leaves nothing of an axis")
    return step.net.pad(step.x, [(0, 0), (0, 0), *pairs] if first else [(0, 0), *pairs, (0, 0)])


# ------------------------------------------------------------------ several tensors


def _align_ranks(step: Step) -> list[str]:
    """The tensors with as many axes each: new ones stand behind the batch."""
    b = step.net
    rank = max(b.rank(t) for t in step.tensors)
    shapes: list[tuple[str, Sequence[Dim]]] = [(t, b.shape(t)) for t in step.tensors]
    return [t if len(s) == rank else b.reshape(t, (s[0], *[1] * (rank - len(s)), *s[1:])) for t, s in shapes]


def _merge_tensors(step: Step, op: str) -> str:
    first, *rest = _align_ranks(step)
    for other in rest:
        first = step.net.add(op, [first, other])
    return first


def _average(step: Step) -> str:
    total = _merge_tensors(step, "Add")
    return step.net.add("RealDiv", [total, step.net.number(total, len(step.tensors))])


def _concatenate(step: Step) -> str:
    axis = step.net.axis(step.x, int(step.get("axis", -1)))
    return step.net.concat(step.tensors, axis)


def _dot(step: Step) -> str:
    step.refuse_unless("normalize", False)
    b, (x, y) = step.net, step.tensors
    axes = step.get("axes")
    first, second = (axes, axes) if isinstance(axes, int) else axes
    first, second = b.axis(x, first), b.axis(y, second)
    letters = [f"a{'bcdefg'[: b.rank(x) - 1]}", f"a{'tuvwxyz'[: b.rank(y) - 1]}"]
    letters[1] = letters[1].replace(letters[1][second], letters[0][first])
    result = "a" + "".join(c for c in letters[0][1:] + letters[1][1:] if c != letters[0][first])
    value = einsum(b, f"{letters[0]},{letters[1]}->{result}", [x, y], shape_of=b.shape)
    return b.reshape(value, (b.shape(x)[0], 1)) if len(result) == 1 else value


# ------------------------------------------------------------------ numbers


def _rescaling(step: Step) -> str:
    b = step.net
    x = b.cast(step.x, FLOAT32)
    scale, offset = (np.asarray(step.get(k, d), FLOAT32) for k, d in (("scale", 1.0), ("offset", 0.0)))
    value = b.add("Mul", [x, b.const(scale, "scale")])
    return value if not offset.any() else b.add("Add", [value, b.const(offset, "offset")])


def _normalization(step: Step) -> str:
    """(x − mean) / max(√variance, 1e-7) along ``axis``."""
    b = step.net
    x = b.cast(step.x, FLOAT32)
    axis = step.get("axis", -1)
    axes = [] if axis is None else [b.axis(x, int(a)) for a in ([axis] if isinstance(axis, int) else axis)]
    shape = [b.length(x, i) if i in axes else 1 for i in range(b.rank(x))]
    if step.left:
        mean, variance = (step.take() for _ in range(2))
        del step.left[:]  # how many rows were seen
    else:
        mean, variance = (np.asarray(step.get(k), FLOAT32) for k in ("mean", "variance"))
    centre, spread = (np.broadcast_to(a if a.size == 1 else a.reshape(shape), shape) for a in (mean, variance))
    deviation = np.maximum(np.sqrt(spread), FLOAT32.type(1e-7))
    operands = [b.const(np.ascontiguousarray(a), name) for a, name in ((centre, "mean"), (deviation, "deviation"))]
    if step.get("invert"):
        return b.add("Add", [operands[0], b.add("Mul", [x, operands[1]])])
    return b.add("RealDiv", [b.add("Sub", [x, operands[0]]), operands[1]])


_IDENTITIES = (
    *("Dropout", "SpatialDropout1D", "SpatialDropout2D", "GaussianNoise", "GaussianDropout", "AlphaDropout"),
    *("ActivityRegularization", "Identity"),
)
_MERGES = {"Add": "Add", "Multiply": "Mul", "Subtract": "Sub", "Maximum": "Maximum", "Minimum": "Minimum"}
LAYERS: Mapping[str, Translate] = {
    **dict.fromkeys(_IDENTITIES, lambda s: s.x),
    **{name: partial(_merge_tensors, op=op) for name, op in _MERGES.items()},
    "Average": _average,
    "Concatenate": _concatenate,
    "Dot": _dot,
    "Dense": _dense,
    "EinsumDense": _einsum_dense,
    "Embedding": _embedding,
    "Flatten": _flatten,
    "Reshape": _reshape,
    "RepeatVector": _repeat_vector,
    "Permute": lambda s: s.net.transpose(s.x, [0, *(int(d) for d in s.get("dims"))]),
    **dict.fromkeys(("ZeroPadding1D", "ZeroPadding2D"), partial(_pad_or_crop, key="padding", sign=1)),
    **dict.fromkeys(("Cropping1D", "Cropping2D"), partial(_pad_or_crop, key="cropping", sign=-1)),
    "Rescaling": _rescaling,
    "Normalization": _normalization,
}
