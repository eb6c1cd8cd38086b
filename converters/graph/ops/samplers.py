"""Samplers. Their kernels draw from a numpy generator; the numpy runner feeds recorded draws in their place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.arrays import target_dims
from export_model.converters.graph.ops.barracuda import layers as nn
from export_model.converters.graph.ops.barracuda.base import FIRST, Nn
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.converters.graph.ops.base import (
    Attr,
    Kernel,
    Lower,
    OnnxBuilder,
    OpDef,
    Sampler,
    as_int64,
    constant_input,
    type_attr,
)
from export_model.converters.graph.ops.litert.arrays import multinomial, random
from export_model.converters.graph.ops.loops import layers as loops
from export_model.converters.graph.types import INT64, Dim, Symbols, TensorType

_SEEDS = (Attr("seed", "int", 0), Attr("seed2", "int", 0))


class _Stream:
    """The stream that the kernels draw from: one per process, as in every runtime.

    Made on the first draw: numpy.random costs megabytes, and an export draws nothing.
    """

    def __init__(self) -> None:
        self._seed = 0
        self._generator: np.random.Generator | None = None

    def restart(self, seed: int) -> None:
        self._seed, self._generator = seed, None

    @property
    def generator(self) -> np.random.Generator:
        if self._generator is None:
            self._generator = np.random.default_rng(self._seed)
        return self._generator


_stream = _Stream()


def reseed(seed: int) -> None:
    """Restart the stream that the kernels draw from."""
    _stream.restart(seed)


def _infer_random(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    dims = target_dims(args[0], symbols)
    return [TensorType(node.attrs["dtype"], None if dims is None else tuple(dims))]


def _normal(node: Node, shape: np.ndarray) -> np.ndarray:
    return _stream.generator.standard_normal([int(d) for d in shape]).astype(node.attrs["dtype"])


def _uniform(node: Node, shape: np.ndarray) -> np.ndarray:
    return _stream.generator.random([int(d) for d in shape]).astype(node.attrs["dtype"])


def _truncated_normal(node: Node, shape: np.ndarray) -> np.ndarray:
    draws = _stream.generator.standard_normal([int(d) for d in shape])
    while (outside := np.abs(draws) > 2).any():
        draws[outside] = _stream.generator.standard_normal(int(outside.sum()))
    return draws.astype(node.attrs["dtype"])


def _lower_random(onnx_op: str) -> Any:
    def lower(node: Node, builder: OnnxBuilder) -> Any:
        source = builder.producer(node.inputs[0])
        if source.op == "Shape" and builder.type_of(source.inputs[0]).dtype == node.attrs["dtype"]:
            return builder.emit(onnx_op, [builder.value(source.inputs[0])])
        shape = builder.emit("ConstantOfShape", [as_int64(node, builder, 0)], value=np.zeros(1, node.attrs["dtype"]))
        return builder.emit(onnx_op, [shape])

    return lower


def _multinomial(node: Node, logits: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Draws by the Gumbel trick: argmax of logits + Gumbel noise has the softmax distribution."""
    with np.errstate(all="ignore"):
        uniform = _stream.generator.random((logits.shape[0], int(count), logits.shape[1]))
        gumbel = -np.log(-np.log(uniform + 1e-300))
        return np.asarray(np.argmax(logits[:, None, :] + gumbel, axis=-1)).astype(node.attrs["output_dtype"])


def _infer_multinomial(node: Node, args: Sequence[TensorType], symbols: Symbols) -> list[TensorType]:
    count = args[1].constant
    columns: Dim = symbols.fresh() if count is None else int(count)
    rows = symbols.fresh() if args[0].shape is None else args[0].shape[0]
    return [TensorType(node.attrs["output_dtype"], (rows, columns))]


def _lower_multinomial(node: Node, builder: OnnxBuilder) -> Any:
    count = int(constant_input(node, builder, 1, "the number of draws"))
    return builder.emit(
        "Multinomial", [builder.value(node.inputs[0])], dtype=node.attrs["output_dtype"], sample_size=count
    )


def _of_shape(name: str, kernel: Kernel, lowering: Lower | None, sampler: Sampler, **facets: Any) -> OpDef:
    attrs = (*_SEEDS, Attr("dtype", "type"), type_attr("T"))
    return OpDef(name, _infer_random, kernel, lowering, attrs, foldable=False, sampler=sampler, **facets)


OPS = (
    _of_shape(
        "RandomStandardNormal",
        _normal,
        _lower_random("RandomNormalLike"),
        "normal",
        nn=nn.random(LayerType.RANDOM_NORMAL),
        litert=random("RANDOM_STANDARD_NORMAL"),
        loops=loops.normal,
    ),
    _of_shape("TruncatedNormal", _truncated_normal, None, "truncated normal", loops=loops.truncated_normal),
    _of_shape(
        "RandomUniform",
        _uniform,
        _lower_random("RandomUniformLike"),
        "uniform",
        nn=nn.random(LayerType.RANDOM_UNIFORM),
        litert=random("RANDOM_UNIFORM"),
        loops=loops.uniform,
    ),
    OpDef(
        "Multinomial",
        _infer_multinomial,
        _multinomial,
        _lower_multinomial,
        (*_SEEDS, type_attr("T"), Attr("output_dtype", "type", INT64, since="1.7")),
        nn=Nn(
            nn.drawn_class,
            FIRST,
            "a drawn class is read on inside the policy, and ML-Agents draws it from the scores itself",
        ),
        litert=multinomial,
        loops=loops.multinomial,
        foldable=False,
        sampler="categorical",
    ),
)
#: What every op draws that draws.
KINDS = {op.name: op.sampler for op in OPS}
SAMPLERS = frozenset(KINDS)
