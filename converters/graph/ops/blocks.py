"""SpaceToBatchND and BatchToSpaceND, between which TensorFlow puts a dilated convolution."""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct

from export_model.converters.graph.nn.dilation import (
    Blocks,
    batch_to_space,
    blocks_of,
    convolve_dilated,
    space_to_batch,
)
from export_model.converters.graph.nodes import Node, normal_ref
from export_model.converters.graph.ops.base import OpDef, written_as_older
from export_model.converters.graph.ops.rewriting import GraphBuilder, refuse_by_name

_CONVOLUTIONS = ("Conv2D", "DepthwiseConv2dNative")
#: What makes a sequence of an image of height 1, and an image of a sequence.
_FLATTENING = ("Squeeze", "Reshape")


class Convolved(Struct, frozen=True):
    """A convolution between the two: what gave its rows, its kernel, and the bias that is added to its result."""

    rows: Node
    kernel: str
    depthwise: bool
    bias: str | None


def find_convolution(producer: Callable[[str], Node], reference: str) -> Convolved | None:
    """The plain convolution that made a tensor; None: it was something else."""
    node, bias = producer(reference), None
    flat = node.op in _FLATTENING
    node = producer(node.inputs[0]) if flat else node
    if node.op == "BiasAdd" and node.attrs.get("data_format", "NHWC") == "NHWC":
        node, bias = producer(node.inputs[0]), node.inputs[1]
    plain = all(set(node.attrs.get(key, (1,))) == {1} for key in ("strides", "dilations"))
    nhwc = node.attrs.get("data_format", "NHWC") == "NHWC"
    if node.op not in _CONVOLUTIONS or not plain or not nhwc or node.attrs.get("padding") != "VALID":
        return None
    rows = producer(node.inputs[0])
    if flat:
        if rows.op != "ExpandDims":
            return None
        rows = producer(rows.inputs[0])
    return Convolved(rows, node.inputs[1], node.op != "Conv2D", bias)


def _blocks(builder: GraphBuilder, node: Node) -> Blocks:
    factors, pads = (builder.known_value(normal_ref(r), "its block") for r in node.inputs[1:3])
    return blocks_of(factors, pads)


def _split(builder: GraphBuilder, node: Node) -> str:
    blocks = _blocks(builder, node)
    return _write(builder, node, lambda b, x: [space_to_batch(b, x, blocks)])


def _write(builder: GraphBuilder, node: Node, layer: Callable[..., list[str]]) -> str:
    (made,) = builder.write([normal_ref(node.inputs[0])], layer, node.name)
    return made


def _join(builder: GraphBuilder, node: Node) -> str:
    """The dilated convolution that the blocks were made for; without one they are put together."""
    crops = _blocks(builder, node)
    found = find_convolution(lambda r: builder.producer(normal_ref(r)), node.inputs[0])
    if found is None or found.rows.op != "SpaceToBatchND":
        return _write(builder, node, lambda b, x: [batch_to_space(b, x, crops)])
    blocks = _blocks(builder, found.rows).without(crops)
    operands = [found.rows.inputs[0], found.kernel, *([] if found.bias is None else [found.bias])]
    (made,) = builder.write(
        [normal_ref(r) for r in operands],
        lambda b, x, k, bias=None: [convolve_dilated(b, x, k, bias, blocks, depthwise=found.depthwise)],
        node.name,
    )
    return made


OPS = (
    OpDef("SpaceToBatchND", written_as_older, older=refuse_by_name(_split)),
    OpDef("BatchToSpaceND", written_as_older, older=refuse_by_name(_join)),
)
