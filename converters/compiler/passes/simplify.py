"""Take out what changes nothing: identities, reshapes that reshape nothing, chains of them, dead nodes.

Precondition: folded graph. Postcondition: no Identity-like op is left; a chain of ops that only renames axes of
length 1 is one Reshape or none; everything left is upstream of ``roots``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.slicing import strided_steps
from export_model.converters.graph.ops.table import op_of, traits
from export_model.converters.graph.shapes import Types, infer_types
from export_model.converters.graph.types import INT32, Dim


def drop_identities(graph: Graph, fetches: Mapping[str, str]) -> tuple[Graph, dict[str, str]]:
    """The graph without pass-through ops, and where the fetched tensors are now."""
    editor = Editor(graph)
    for node in graph.nodes:
        if traits(node).moves == "same":
            editor.redirect(node.name, editor.resolve(node.inputs[0]))
        else:
            editor.keep(node)
    moved = {name: editor.resolve(reference) for name, reference in fetches.items()}
    return editor.graph().prune(moved.values()), moved


def collapse_views(graph: Graph, fetches: Mapping[str, str]) -> tuple[Graph, dict[str, str]]:
    """The graph with chains of reshaping ops collapsed, and where the fetched tensors are now."""
    types = infer_types(graph)
    editor = Editor(graph)
    base: dict[str, str] = {}  # output of a view → the tensor whose elements it shows, in the same order
    for node in graph.nodes:
        if not _is_view(node, types):
            editor.keep(node)
            continue
        source = base.get(node.inputs[0], node.inputs[0])
        base[node.name] = source
        shape = types[node.name].shape
        if shape == types[source].shape:
            editor.redirect(node.name, editor.resolve(source))
        elif shape is not None and sum(1 for d in shape if isinstance(d, str)) <= 1:
            target = np.array([-1 if isinstance(d, str) else d for d in shape], INT32)
            if node.inputs == (source, f"{node.name}/to") and _is_equal(editor.constant_of(node.inputs[1]), target):
                editor.keep(node)  # made here, and read back
                continue
            made = editor.add(
                "Reshape", [source, editor.const(target, f"{node.name}/to")], f"{node.name}/view", node.origin
            )
            editor.redirect(node.name, made)
        else:
            del base[node.name]
            editor.keep(node)
    moved = {name: editor.resolve(reference) for name, reference in fetches.items()}
    return editor.graph().prune(moved.values()), moved


def _is_equal(known: np.ndarray | None, target: np.ndarray) -> bool:
    return known is not None and np.array_equal(known, target)


def _is_view(node: Node, types: Types) -> bool:
    """Whether a node shows the same elements in the same order under another shape."""
    entry = op_of(node)
    if entry.moves == "view":
        return types[node.inputs[0]].shape is not None and types[node.name].shape is not None
    if entry.moves == "join":
        return len(entry.data_operands(node.inputs)) == 1 and types[node.name].shape is not None
    before = types[node.inputs[0]].shape if node.inputs else None
    if before is None:
        return False
    if node.op == "Transpose":
        permutation = types[node.inputs[1]].constant
        moved = None if permutation is None else [int(p) for p in permutation if before[int(p)] != 1]
        return moved is not None and moved == sorted(moved)
    return node.op == "StridedSlice" and _takes_all(node, types, before)


def _takes_all(node: Node, types: Types, before: tuple[Dim, ...]) -> bool:
    """Whether a slice takes every element of a tensor of shape ``before``, in its order."""
    operands = [types[r].constant for r in node.inputs[1:4]]
    if any(o is None for o in operands):
        return False
    steps = strided_steps(node, len(before), *(o.tolist() for o in operands if o is not None))
    taken = [step for step in steps if step[0] != "new"]
    return all(_takes_axis(step, length) for step, length in zip(taken, before, strict=False))


def _takes_axis(step: tuple[Any, ...], length: Dim) -> bool:
    if step[0] == "take":
        return bool(length == 1)
    if step[0] != "slice" or step[1:] in ((None, None, 1), (0, None, 1)):
        return True
    first, last, stride = step[1:]
    whole = isinstance(length, int) and len(range(*slice(first, last, stride).indices(length))) == length
    return whole and (stride > 0 or length == 1)
