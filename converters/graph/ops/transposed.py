"""Conv2DBackpropInput, as which TensorFlow writes a transposed convolution."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from export_model.converters.graph.nn.convolution import conv2d_transposed, transposed_window
from export_model.converters.graph.nodes import Node, normal_ref
from export_model.converters.graph.ops.base import OpDef, written_as_older
from export_model.converters.graph.ops.rewriting import GraphBuilder, refuse_by_name
from export_model.signatures.errors import UnsupportedOpError


def result_lengths(
    producer: Callable[[str], Node], constant: Callable[[str], np.ndarray | None], sizes: str
) -> tuple[int, int]:
    """Height and width among the sizes of a result, of which the batch may be computed. Raises UnsupportedOpError."""
    whole, node = constant(sizes), producer(sizes)
    parts = (
        [*whole.reshape(-1)] if whole is not None else [constant(r) for r in node.inputs] if node.op == "Pack" else []
    )
    known = [None if p is None else int(np.reshape(p, ())) for p in parts]
    if len(known) != 4 or known[1] is None or known[2] is None:
        raise UnsupportedOpError("the size of its result is computed while the graph runs")
    return known[1], known[2]


def _as_plain_convolution(builder: GraphBuilder, node: Node) -> str:
    sizes, kernel, image = (normal_ref(r) for r in node.inputs)

    def constant(reference: str) -> np.ndarray | None:
        return builder.constant_of(normal_ref(reference))

    result = result_lengths(lambda r: builder.producer(normal_ref(r)), constant, sizes)
    weights = builder.known_value(kernel, "its kernel")
    shape = builder.shape_of(image) or ()
    lengths = [n for n in shape[1:3] if isinstance(n, int)]
    if len(lengths) != 2 or weights.ndim != 4 or node.attrs.get("data_format", "NHWC") != "NHWC":
        raise UnsupportedOpError("the size of its image is not known")
    padding, dilations = node.attrs["padding"], {*node.attrs.get("dilations", (1,))}
    if dilations != {1}:
        raise UnsupportedOpError("its dilations are not read")
    if padding not in ("SAME", "VALID"):
        raise UnsupportedOpError(f"its padding is {padding}; it must be SAME or VALID")
    _, down, across, _ = node.attrs["strides"]
    window, extra = transposed_window(
        (weights.shape[0], weights.shape[1]), (down, across), lengths, result, same=padding == "SAME"
    )
    (made,) = builder.write(
        [image], lambda b, x: [conv2d_transposed(b, x, weights.swapaxes(2, 3), window, extra)], node.name
    )
    return made


OPS = (OpDef("Conv2DBackpropInput", written_as_older, older=refuse_by_name(_as_plain_convolution)),)
