"""What a finished graph tells of its inputs: the normaliser's statistics, the parts of the memory."""

from __future__ import annotations

import numpy as np

from converters.graph.shapes import infer_types
from signatures.graph import Graph, node_of


def normaliser(graph: Graph, name: str) -> dict[str, object] | None:
    """Mean and standard deviation that the policy normalises an observation with, or None.

    The form is the same in every ML-Agents version: clip((x − mean) / sqrt(variance / steps), −5, 5), its square root
    folded to a constant here.
    """
    for node in graph.nodes:
        if node.op != "Sub" or node_of(node.inputs[0]) != name:
            continue
        mean = graph.constant(node.inputs[1])
        for reader in graph.consumers()[node.name]:
            std = graph.constant(reader.inputs[1]) if reader.op == "RealDiv" else None
            if mean is not None and std is not None and mean.ndim == 1 and np.all(np.isfinite(std)):
                width = np.broadcast_shapes(mean.shape, std.shape)
                return {
                    "kind": "normal",
                    "mean": np.broadcast_to(mean, width).astype(float).tolist(),
                    "std": np.broadcast_to(std, width).astype(float).tolist(),
                    "clip": 5.0,
                }
    return None


def memory_layout(graph: Graph, name: str) -> tuple[str, ...]:
    """The parts of the memory in order: ``("c", "h")`` for one LSTM, twice that for two; empty where it is unknown.

    A part that is joined to the cell's input is a hidden state h; one that is only multiplied by a gate is a cell
    state c.
    """
    types = infer_types(graph)
    consumers = graph.consumers()
    parts: list[tuple[int, str]] = []
    for reader in consumers[name]:
        if reader.op != "StridedSlice":
            continue
        begin = types[reader.inputs[1]].constant
        readers = {r.op for r in consumers[reader.name]}
        if begin is None or begin.size < 2:
            return ()
        if "ConcatV2" in readers:
            parts.append((int(begin[1]), "h"))
        elif "Mul" in readers:
            parts.append((int(begin[1]), "c"))
    return tuple(letter for _, letter in sorted(parts))
