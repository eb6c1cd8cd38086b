"""What TensorFlow.js computes differently, put into ops that it computes right (measured on 4.22, cpu and wasm).

- OneHot: only the last axis, no depth of 1, and on wasm only int32 values (float ones come out as bit patterns): int32,
  then Cast.
- Select (TF 1) with a vector condition: broadcasts over the last axis instead of the first. SelectV2 of a reshaped
  condition.
- Softsign does not exist. Cast from float to bool cuts (0.6 is false on wasm). A stride beside a shrunk axis of a
  StridedSlice gives other elements. A SAME convolution whose windows leave a rest is all zeros on wasm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from converters.graph.editor import Editor
from converters.graph.nodes import Graph, Node
from converters.graph.ops.convolution import window_padding
from converters.graph.shapes import Types, infer_types
from converters.graph.types import BOOL, INT32


def for_tfjs(graph: Graph) -> Graph:
    """See the module; names of the nodes that stay are kept."""
    if not any(n.op in _REWRITES for n in graph.nodes):
        return graph
    types = infer_types(graph)
    editor = Editor(graph)
    for node in graph.nodes:
        if node.op in _REWRITES:
            _REWRITES[node.op](editor, node, types)
        else:
            editor.keep(node)
    return editor.graph()


def _softsign(editor: Editor, node: Node, types: Types) -> None:
    size = editor.add("Abs", [node.inputs[0]], f"{node.name}/abs")
    one = editor.const(np.ones((), types[node.name].dtype), f"{node.name}/one")
    below = editor.add("Add", [size, one], f"{node.name}/below")
    editor.keep(Node(node.name, "RealDiv", (node.inputs[0], below), origin=node.origin))


def _cast(editor: Editor, node: Node, types: Types) -> None:
    source = types[node.inputs[0]].dtype
    if node.attrs["DstT"] != BOOL or source.kind != "f":
        editor.keep(node)
        return
    zero = editor.const(np.zeros((), source), f"{node.name}/zero")
    editor.keep(Node(node.name, "NotEqual", (node.inputs[0], zero), origin=node.origin))


def _strided_slice(editor: Editor, node: Node, types: Types) -> None:
    """A stride other than 1 beside a shrunk axis: the slice with its axes kept, then a Squeeze."""
    operands = [types[r].constant for r in node.inputs[1:4]]
    attrs = node.attrs
    shrunk = [i for i in range(32) if int(attrs["shrink_axis_mask"]) >> i & 1]
    plain = not (attrs["ellipsis_mask"] or attrs["new_axis_mask"])
    if not shrunk or not plain or any(o is None for o in operands):
        editor.keep(node)
        return
    begin, end, strides = (np.array(o) for o in operands)
    if (strides == 1).all():
        editor.keep(node)
        return
    end_mask = int(attrs["end_mask"])
    for axis in shrunk:
        end[axis], strides[axis] = begin[axis] + 1, 1
        end_mask = end_mask | 1 << axis if begin[axis] == -1 else end_mask & ~(1 << axis)
    begin_mask = int(attrs["begin_mask"]) & ~sum(1 << axis for axis in shrunk)
    bounds = [editor.const(v, f"{node.name}/{k}") for k, v in (("begin", begin), ("end", end), ("strides", strides))]
    kept = editor.add(
        "StridedSlice", [node.inputs[0], *bounds], f"{node.name}/kept", begin_mask=begin_mask, end_mask=end_mask
    )
    editor.keep(Node(node.name, "Squeeze", (kept,), {"squeeze_dims": tuple(shrunk)}, origin=node.origin))


def _convolution(editor: Editor, node: Node, types: Types) -> None:
    """SAME whose windows leave a rest (so that there is less than nothing to pad) as Pad and VALID."""
    image, kernel = types[node.inputs[0]].shape, types[node.inputs[1]].shape
    if node.attrs["padding"] != "SAME" or image is None or kernel is None:
        editor.keep(node)
        return
    pads, rest = [(0, 0)], False
    for size, span, stride, dilation in zip(
        image[1:3], kernel[:2], node.attrs["strides"][1:3], node.attrs["dilations"][1:3], strict=True
    ):
        if not isinstance(size, int) or not isinstance(span, int):
            editor.keep(node)
            return
        window = (span - 1) * dilation + 1
        count, before, after = window_padding(size, window, stride, "SAME")
        rest |= (count - 1) * stride + window < size
        pads.append((before, after))
    if not rest:
        editor.keep(node)
        return
    amounts = editor.const(np.array([*pads, (0, 0)], INT32), f"{node.name}/pads")
    padded = editor.add("Pad", [node.inputs[0], amounts], f"{node.name}/pad")
    editor.keep(replace(node, inputs=(padded, *node.inputs[1:]), attrs={**node.attrs, "padding": "VALID"}))


def _one_hot(editor: Editor, node: Node, types: Types) -> None:
    """on/off values are applied after the cast: off + hot·(on − off)."""
    indices, depth, on, off = node.inputs
    on_value, off_value = types[on].constant, types[off].constant
    dtype = types[on].dtype
    one = editor.const(np.array(1, INT32), f"{node.name}/one")
    zero = editor.const(np.array(0, INT32), f"{node.name}/zero")
    size = types[depth].constant
    if size is not None and int(size) < 2:  # tfjs refuses a depth of 1
        last = editor.const(np.array(-1, INT32), f"{node.name}/last")
        index = editor.add("ExpandDims", [indices, last], f"{node.name}/index")
        only = editor.const(np.zeros((), types[indices].dtype), f"{node.name}/only")
        equal = editor.add("Equal", [index, only], f"{node.name}/equal")
        hot = editor.add("Cast", [equal], f"{node.name}/hot", DstT=INT32)
    else:
        hot = editor.add("OneHot", [indices, depth, one, zero], f"{node.name}/hot", axis=-1)
    axis, rank = int(node.attrs["axis"]), types[node.name].rank
    if axis >= 0 and rank is not None and axis != rank - 1:
        order = [*range(axis), rank - 1, *range(axis, rank - 1)]
        hot = editor.add(
            "Transpose", [hot, editor.const(np.array(order, INT32), f"{node.name}/perm")], f"{node.name}/moved"
        )
    plain = on_value is not None and off_value is not None and on_value == 1 and off_value == 0
    if plain:
        editor.nodes.append(Node(node.name, "Cast", (hot,), {"DstT": dtype, "Truncate": False}, origin=node.origin))
        return
    scaled = editor.add("Cast", [hot], f"{node.name}/cast", DstT=dtype)
    width = editor.add("Sub", [on, off], f"{node.name}/width")
    product = editor.add("Mul", [scaled, width], f"{node.name}/scaled")
    editor.nodes.append(Node(node.name, "Add", (product, editor.resolve(off)), origin=node.origin))


def _select(editor: Editor, node: Node, types: Types) -> None:
    condition, a, b = node.inputs
    rank, wide = types[condition].rank, types[a].rank
    if rank == 1 and wide is not None and wide > 1:
        shape = editor.const(np.array([-1] + [1] * (wide - 1), INT32), f"{node.name}/rows")
        condition = editor.add("Reshape", [condition, shape], f"{node.name}/condition")
    editor.keep(Node(node.name, "SelectV2", (condition, a, b), origin=node.origin))


_REWRITES: dict[str, Callable[[Editor, Node, Types], None]] = {
    "OneHot": _one_hot,
    "Select": _select,
    "Softsign": _softsign,
    "Cast": _cast,
    "StridedSlice": _strided_slice,
    "Conv2D": _convolution,
    "DepthwiseConv2dNative": _convolution,
}
