"""A policy's graph where a bundle has none that we read: what a verification asks of it is which outputs are drawn."""

from __future__ import annotations

import numpy as np

from converters.graph.nodes import Graph, Node, TensorShape
from signatures.roles import Role
from signatures.spec import PolicySignature


def outline(signature: PolicySignature, *, noise_kept: bool) -> Graph:
    """Inputs and outputs of a signature: a drawn output is a sampler, the others are constants."""
    size = Node("size", "Const", value=np.array([1, 1], np.int32))
    nodes = [size]
    for spec in signature.inputs:
        attrs = {"dtype": np.dtype(spec.dtype), "shape": TensorShape(spec.shape)}
        nodes.append(Node(spec.name, "Placeholder", attrs=attrs))
    for spec in signature.outputs:
        drawn = spec.role is Role.SAMPLED or (spec.role is Role.CONTINUOUS and noise_kept)
        attrs = {"dtype": np.dtype(np.float32)} if drawn else {}
        nodes.append(Node(spec.name, "RandomStandardNormal" if drawn else "Identity", ("size",), attrs))
    return Graph(tuple(nodes))
