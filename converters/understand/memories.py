"""The parts of a memory: which columns are cell states, which hidden ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from converters.graph.nodes import Graph, Node, ref
from converters.graph.ops.table import op_of
from converters.graph.shapes import infer_types, run_kernel
from signatures.errors import GraphError


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
        joined = op_of(node).moves == "join"
        if read and op_of(node).moves and len(known) == len(operands):
            for index, columns in enumerate(_moved(node, known)):
                shown[ref(node.name, index)] = columns
        elif joined or node.op == "Mul":
            for columns in read:
                part = tuple(columns.reshape(-1).tolist())
                parts[part] = "h" if joined else parts.get(part, "c")
    ordered = sorted(parts)
    whole = [column for part in ordered for column in part] == list(range(shape[-1]))
    return tuple(parts[part] for part in ordered) if whole else ()


def _moved(node: Node, row: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """The results of a node that moves elements, of one row; nothing where it takes several apart."""
    try:
        return run_kernel(op_of(node), node, row)
    except GraphError:
        return ()
