"""Nodes of this project's own graphs, made by hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.ops.base import REQUIRED
from export_model.converters.graph.ops.table import TABLE

Array = npt.NDArray[Any]


def defaults(op: str) -> dict[str, Any]:
    """The attributes of an op that have a default."""
    return {a.name: a.default for a in TABLE[op].attrs if a.derive is None and a.default is not REQUIRED}


def placeholder(name: str, shape: Sequence[int | None] | None, dtype: Any = np.float32) -> Node:
    """An input, whose origin is itself; ``shape`` None is an unknown rank."""
    attrs = {"dtype": np.dtype(dtype), "shape": TensorShape(None if shape is None else tuple(shape))}
    return Node(name, "Placeholder", attrs=attrs, origin=f"{name}:0")


def const(name: str, value: Any, dtype: Any = np.int32) -> Node:
    """A constant; int32 unless it is an array already."""
    return Node(name, "Const", value=value if isinstance(value, np.ndarray) else np.array(value, dtype))


def node(name: str, op: str, *inputs: str, **attrs: Any) -> Node:
    """A node of any op, with the op's defaults, whose origin is itself."""
    return Node(name, op, inputs, {**defaults(op), **attrs}, origin=f"{name}:0")


def graph(*nodes: Node) -> Graph:
    return Graph(nodes)


def ops(made: Graph) -> list[str]:
    """Op types in graph order, constants and inputs left out."""
    return [n.op for n in made.nodes if n.op not in ("Const", "Placeholder")]
