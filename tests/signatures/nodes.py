"""Graphs for the tests of ``signatures``, made of its own nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import Graph, Node, TensorShape

FLOAT, INT = np.dtype(np.float32), np.dtype(np.int32)
Dims = Sequence[int | None] | None


def placeholder(name: str, dims: Dims = (None, 3), dtype: np.dtype = FLOAT) -> Node:
    """An input; ``dims`` None is an unknown rank."""
    return Node(name, "Placeholder", (), {"dtype": dtype, "shape": TensorShape(None if dims is None else tuple(dims))})


def constant(name: str, value: Any) -> Node:
    """A Const."""
    return Node(name, "Const", value=np.asarray(value))


def op(name: str, kind: str, *inputs: str, **attrs: Any) -> Node:
    """Any other node."""
    return Node(name, kind, inputs, attrs)


def graph(*nodes: Node) -> Graph:
    """A graph of nodes that are in order already."""
    return Graph(nodes)
