"""What TensorFlow.js computes differently, put into ops that it computes right (measured on 4.22, cpu and wasm).

- OneHot: only the last axis, no depth of 1, and on wasm only int32 values (float ones come out as bit patterns): int32,
  then Cast.
- Select (TF 1) with a vector condition: broadcasts over the last axis instead of the first. SelectV2 of a reshaped
  condition.
- A seed other than 0 on a sampler makes *every* run draw the same numbers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from converters.graph.editor import Editor
from converters.graph.ops.chance import SAMPLERS
from converters.graph.shapes import Types, infer_types
from converters.graph.types import INT32
from signatures.graph import Graph, Node


def for_tfjs(graph: Graph) -> Graph:
    """See the module; names of the nodes that stay are kept."""
    if not any(n.op in ("OneHot", "Select", *SAMPLERS) for n in graph.nodes):
        return graph
    types = infer_types(graph)
    editor = Editor(graph)
    for node in graph.nodes:
        if node.op == "OneHot":
            _one_hot(editor, node, types)
        elif node.op == "Select":
            _select(editor, node, types)
        elif node.op in SAMPLERS:
            editor.keep(replace(node, attrs={**node.attrs, "seed": 0, "seed2": 0}))
        else:
            editor.keep(node)
    return editor.graph()


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
