"""What a policy does with an observation before anything else: how it normalises it, how large its colours are.

ML-Agents divides bytes by 255 outside of the policy, so its images are 0 to 1. Stable-Baselines3 (preprocessing.py,
``normalize_images``) and CleanRL (``x / 255.0``) divide inside: fed 0 to 1, such a policy sees black.
"""

from __future__ import annotations

import math

import numpy as np

from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.ops.table import passes_on, traits


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


BYTE = 255.0
#: A divisor may be repeated for each colour.
_CHANNELS = 16


def highest_colour(graph: Graph, name: str) -> int:
    """255 where everything that reads the image divides it by 255 first, else 1."""
    readers = _readers(graph, graph[name])
    return int(BYTE) if readers and all(_divides(graph, reader, source) for reader, source in readers) else 1


def _readers(graph: Graph, image: Node) -> list[tuple[Node, str]]:
    """(what reads the image, behind what only passes it on; the name under which it reads it)."""
    consumers, found, stack = graph.consumers(), [], [image.name]
    seen: set[str] = set()
    while stack:
        name = stack.pop()
        for reader in consumers[name]:
            shows = passes_on(reader) or reader.op == "Cast" or traits(reader).moves == "turn"
            if shows and reader.inputs[0] == name:
                if reader.name not in seen:
                    seen.add(reader.name)
                    stack.append(reader.name)
            elif reader.op != "Shape":
                found.append((reader, name))
    return found


def _divides(graph: Graph, reader: Node, source: str) -> bool:
    product = reader.op == "Mul"
    if not (product or reader.op == "RealDiv") or len(reader.inputs) != 2:
        return False
    other = reader.inputs[1] if reader.inputs[0] == source else reader.inputs[0]
    value = graph.constant(other)
    if value is None or value.dtype.kind not in "iuf" or not 0 < value.size <= _CHANNELS:
        return False
    if not product and other != reader.inputs[1]:
        return False  # 255 / image
    wanted = 1 / BYTE if product else BYTE
    return all(math.isclose(float(v), wanted, rel_tol=1e-5) for v in value.reshape(-1))
