"""The statistics that a policy normalises an observation with."""

from __future__ import annotations

import numpy as np

from converters.graph.nodes import Graph, node_of


def normaliser(graph: Graph, name: str) -> dict[str, object] | None:
    """Mean and standard deviation that the policy normalises an observation with, or None.

    The form is the same in every ML-Agents version: clip((x − mean) / sqrt(variance / steps), −5, 5), its square root
    folded to a constant here.
    """
    centred = [n for n in graph.nodes if n.op == "Sub" and node_of(n.inputs[0]) == name]
    readers = graph.consumers() if centred else {}
    for node in centred:
        mean = graph.constant(node.inputs[1])
        for reader in readers[node.name]:
            std = graph.constant(reader.inputs[1]) if reader.op == "RealDiv" else None
            if (
                mean is not None
                and std is not None
                and mean.ndim == 1
                and np.all(np.isfinite(std))
                and np.all(np.isfinite(mean))
            ):
                width = np.broadcast_shapes(mean.shape, std.shape)
                return {
                    "kind": "normal",
                    "mean": np.broadcast_to(mean, width).astype(float).tolist(),
                    "std": np.broadcast_to(std, width).astype(float).tolist(),
                    "clip": 5.0,
                }
    return None
