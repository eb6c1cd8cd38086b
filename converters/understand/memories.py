"""The parts of a memory: which columns are cell states, which hidden ones."""

from __future__ import annotations

import numpy as np

from converters.graph.nodes import Graph, ref
from converters.graph.ops.table import op_of
from converters.graph.shapes import infer_types, run_kernel

#: Ops that only pick and move elements.
_MOVES = frozenset(("StridedSlice", "Slice", "Split", "SplitV", "ConcatV2", "Tile"))


def memory_layout(graph: Graph, name: str) -> tuple[str, ...]:
    """The parts of the memory in order: ``("c", "h")`` for one LSTM, twice that for two; empty where it is unknown.

    A part that is joined to the cell's input is a hidden state h; one that is only multiplied by a gate is a cell
    state c. Parts are followed through slices of slices and repetitions by their columns.
    """
    types = infer_types(graph)
    shape = types[name].shape
    if not shape or not isinstance(shape[-1], int):
        return ()
    # tensor → the columns of the memory that it shows, as one row of it
    shown = {name: np.arange(shape[-1]).reshape((1,) * (len(shape) - 1) + (shape[-1],))}
    parts: dict[tuple[int, ...], str] = {}
    for node in graph.nodes:
        read = [shown[r] for r in node.inputs if r in shown]
        operands = [shown.get(r, types[r].constant) for r in node.inputs]
        known = [o for o in operands if o is not None]
        if read and node.op in _MOVES and len(known) == len(operands):
            for index, columns in enumerate(run_kernel(op_of(node), node, known)):
                shown[ref(node.name, index)] = columns
        elif node.op in ("ConcatV2", "Mul"):
            for columns in read:
                part = tuple(columns.reshape(-1).tolist())
                parts[part] = "h" if node.op == "ConcatV2" else parts.get(part, "c")
    ordered = sorted(parts)
    whole = [column for part in ordered for column in part] == list(range(shape[-1]))
    return tuple(parts[part] for part in ordered) if whole else ()
