"""Placeholders: fix the ones that get a value, derive the batch size, find shapes that the file does not say."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.passes.normalise import as_placeholder
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, TensorShape, downstream, node_of, topological
from export_model.converters.graph.ops.base import Layer
from export_model.converters.graph.ops.loops.layers import window_padding
from export_model.converters.graph.ops.table import is_fed, traits
from export_model.converters.graph.shapes import MAX_ELEMENTS
from export_model.converters.graph.types import INT32
from export_model.converters.policy.inputs import placeholder_rank
from export_model.signatures.errors import GraphError, UsageError
from export_model.signatures.roles import OBSERVATIONS, Role

_LARGEST_IMAGE = 512


def set_values(graph: Graph, values: Mapping[str, float]) -> Graph:
    """Placeholders with a value from ``--set`` become constants of their dtype and (free axes: 1) shape."""
    missing = [name for name in values if name not in graph]
    if missing:
        raise UsageError(
            f"--set names {missing[0]!r}, which is not in the graph", fix="export-model inspect FILE lists the inputs"
        )
    nodes = []
    for node in graph.nodes:
        if node.name in values:
            if not is_fed(node):
                raise UsageError(f"--set names {node.name!r}, which is a {node.op}, not a placeholder")
            node = constant_for(node, values[node.name])
        nodes.append(node)
    return Graph(tuple(nodes))


def give_rows(graph: Graph, original: Graph, values: Mapping[str, float], observation: str) -> Graph:
    """Values of ``--set`` with a row for each agent, where they are joined to what the agents are fed.

    A single row goes with any number wherever elements meet one another, but not in a concatenation.
    """
    alone, set_here = set[str](), set[str]()
    joined = False
    for node in graph.nodes:
        sources = {node_of(r) for r in node.inputs}
        if node.name in values:
            set_here.add(node.name)
        elif not is_fed(node) and sources and sources <= alone | set_here:
            (set_here if sources & set_here else alone).add(node.name)
        elif node.op == "Const":
            alone.add(node.name)
        elif traits(node).moves == "join" and sources & set_here:
            joined = True
    if not joined:
        return graph
    editor = Editor(graph)
    for node in graph.nodes:
        dims = original[node.name].dims if node.name in values else None
        if not dims or dims[0] is not None:
            editor.keep(node)
            continue
        row = editor.const(constant_value(original[node.name], values[node.name]), f"{node.name}/row")
        count = _first_length(editor, observation, node.name, vector=True)
        others = editor.ints([1] * (len(dims) - 1), f"{node.name}/others")
        times = editor.add("ConcatV2", [count, others, editor.ints(0, f"{node.name}/axis")], f"{node.name}/times")
        editor.redirect(node.name, editor.add("Tile", [row, times], f"{node.name}/rows"))
    return Graph(topological(editor.graph().nodes))


def constant_value(node: Node, value: float) -> np.ndarray:
    """The array that a placeholder with one fixed value stands for (free axes: length 1)."""
    dims = tuple(1 if d is None else d for d in node.dims or ())
    dtype = node.attrs["dtype"]
    if math.prod(dims) > MAX_ELEMENTS:
        raise GraphError(
            f"the placeholder {node.name!r} takes {math.prod(dims)} elements",
            why=f"no policy has a tensor of more than {MAX_ELEMENTS} per row",
            fix="the graph is damaged, or not a policy; freeze it again from its checkpoint",
        )
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        possible = float(value).is_integer() and limits.min <= value <= limits.max
    else:
        possible = dtype.kind != "b" or value in (0, 1)
    if not possible:
        raise UsageError(
            f"--set {node.name}={value:g} cannot be: it is of dtype {dtype.name}",
            fix="give a whole number" if dtype.kind in "iu" else "give true or false",
        )
    return np.full(dims, value, dtype)


def constant_for(node: Node, value: float) -> Node:
    """A Const in place of a placeholder."""
    return Node(node.name, "Const", value=constant_value(node, value), origin=node.origin)


def settle_inputs(graph: Graph, roles: Mapping[str, Role]) -> Graph:
    """``sequence_length`` becomes 1, ``batch_size`` the length of an observation's first axis.

    Postcondition: the placeholders left are those whose role stays in the signature; defaults that the signature
    names are plain placeholders.
    """
    observation = next(name for name, role in roles.items() if role in OBSERVATIONS)
    editor = Editor(graph)
    for node in graph.nodes:
        role = roles.get(node.name)
        if role is Role.SEQUENCE_LENGTH:
            editor.keep(constant_for(node, 1))
        elif role is Role.BATCH_SIZE:
            editor.redirect(node.name, _batch_size(editor, graph, node, observation))
        elif role is not None and node.op == "PlaceholderWithDefault":
            editor.keep(as_placeholder(node))
        else:
            editor.keep(node)
    return editor.graph()


def batch_size_rank(graph: Graph, node: Node) -> int:
    """0 where the graph uses ``batch_size`` as a number, 1 where as a vector of one (Unity fed it so)."""
    joined = any(reader.op == "ConcatV2" for reader in graph.consumers()[node.name])
    return 1 if placeholder_rank(node) == 1 or joined else 0


def _batch_size(editor: Editor, graph: Graph, node: Node, observation: str) -> str:
    """Shape(observation)[0]: a scalar, or a vector of one where the graph uses it as one."""
    return _first_length(editor, observation, node.name, vector=batch_size_rank(graph, node) == 1)


def _first_length(editor: Editor, observation: str, name: str, *, vector: bool) -> str:
    shape = editor.add("Shape", [observation], f"{name}/shape", out_type=INT32)
    bounds = [editor.ints([v], f"{name}/{k}") for k, v in (("b", 0), ("e", 1), ("s", 1))]
    return editor.add("StridedSlice", [shape, *bounds], f"{name}/derived", shrink_axis_mask=0 if vector else 1)


def complete_shapes(graph: Graph, roles: Mapping[str, Role]) -> Graph:
    """Shapes for placeholders that have none, from what reads them.

    A vector observation's length is the kernel's of the dense layer it feeds; an image's channels are the kernel's of
    its convolution, and its sides the smallest square that makes the flattened features fit the next dense layer.
    """
    consumers = graph.consumers()
    found: dict[str, TensorShape] = {}
    for name, role in roles.items():
        node = graph.get(name)
        if node is None or node.op != "Placeholder":
            continue
        shape: TensorShape = node.attrs["shape"]
        if role is Role.VISUAL and (shape.dims is None or any(d is None for d in shape.dims[1:])):
            found[name] = _image_shape(graph, node, consumers, shape)
        elif role is not Role.PARAMETER and shape.dims is None:
            length = _dense_length(graph, node, consumers)
            if length is not None:
                found[name] = TensorShape((None, length))
    if not found:
        return graph
    return Graph(
        tuple(replace(n, attrs={**n.attrs, "shape": found[n.name]}) if n.name in found else n for n in graph.nodes)
    )


def _dense_length(graph: Graph, node: Node, consumers: Mapping[str, list[Node]]) -> int | None:
    """Rows of the nearest kernel that a placeholder is multiplied with, perhaps normalised or activated before."""
    for reader in downstream(node, consumers, lambda n: traits(n).elementwise or traits(n).moves == "same"):
        kernel = graph.constant(reader.inputs[1]) if reader.op == "MatMul" else None
        if kernel is not None:
            return int(kernel.shape[1 if reader.attrs.get("transpose_b") else 0])
    return None


def _image_shape(graph: Graph, node: Node, consumers: Mapping[str, list[Node]], known: TensorShape) -> TensorShape:
    first = _next(node, consumers, "convolution")
    if first is None:
        return known
    kernel = graph.constant(first.inputs[1])
    channels = None if kernel is None else int(kernel.shape[2])
    dims = known.dims if known.dims is not None and len(known.dims) == 4 else (None, None, None, channels)
    if any(d is not None for d in dims[1:3]) and None not in dims[1:3]:
        return TensorShape((None, dims[1], dims[2], dims[3] or channels))
    layers, last = _window_chain(first, consumers)
    dense = _next(last, consumers, "dense")
    weights = None if dense is None else graph.constant(dense.inputs[1])
    if weights is None:
        return TensorShape((None, dims[1], dims[2], dims[3] or channels))
    for side in range(1, _LARGEST_IMAGE + 1):
        height, width = dims[1] or side, dims[2] or side
        if _flat_size(layers, graph, height, width) == weights.shape[0]:
            return TensorShape((None, height, width, dims[3] or channels))
    return TensorShape((None, dims[1], dims[2], dims[3] or channels))


def _next(node: Node, consumers: Mapping[str, list[Node]], *layers: Layer) -> Node | None:
    """The first node downstream that computes one of ``layers``, nearest first."""
    return next((r for r in downstream(node, consumers, lambda n: True) if traits(r).layer in layers), None)


def _window_chain(first: Node, consumers: Mapping[str, list[Node]]) -> tuple[list[Node], Node]:
    """Convolutions and pools in a row from ``first`` on."""
    chain, node = [first], first
    while (following := _next(node, consumers, "convolution", "pool", "dense")) and traits(following).layer != "dense":
        chain.append(following)
        node = following
    return chain, node


def _flat_size(layers: list[Node], graph: Graph, height: int, width: int) -> int:
    channels = 0
    for layer in layers:
        kernel = None if traits(layer).layer == "pool" else graph.constant(layer.inputs[1])
        window = layer.attrs["ksize"][1:3] if kernel is None else kernel.shape[:2]
        if kernel is not None:
            channels = int(kernel.shape[3]) * (int(kernel.shape[2]) if layer.op == "DepthwiseConv2dNative" else 1)
        strides = layer.attrs["strides"][1:3]
        height = window_padding(height, int(window[0]), int(strides[0]), layer.attrs["padding"])[0]
        width = window_padding(width, int(window[1]), int(strides[1]), layer.attrs["padding"])[0]
        if height < 1 or width < 1:
            return 0
    return height * width * channels
