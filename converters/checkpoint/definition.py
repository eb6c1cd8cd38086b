"""A training graph's own definition with constants in place of its variables: what TensorFlow runs as the original.

The policy's graph is frozen by ``converters.checkpoint.freeze``; this does the same to the GraphDef as it was read,
node for node, so that what a runtime is given owes nothing to the compiler, and no saver or initialiser has to be run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from converters import schema
from converters.detached import Detached
from converters.frozen_graph.tensors import from_array
from converters.graph.nodes import NameScope, node_of
from converters.graph.ops.table import hands_on


def with_values(graph_def: Any, values: Mapping[str, np.ndarray], detached: Detached) -> Any:
    """A GraphDef in which the variables named in ``values`` are constants, and what reads them reads these.

    Large values go to ``detached``.
    """
    frozen = schema.GraphDef()
    frozen.versions.CopyFrom(graph_def.versions)
    scope = NameScope(n.name for n in graph_def.node)
    dtypes = _handles(graph_def, values)
    for node in graph_def.node:
        if node.name in values:
            frozen.node.append(_constant(node.name, values[node.name], detached))
            continue
        copy = frozen.node.add()
        copy.CopyFrom(node)
        dtype = dtypes.get(node_of(node.input[0])) if node.input else None
        if dtype is None:
            continue
        if node.op == "ReadVariableOp":
            _become(copy, "Identity", T=dtype)
        elif hands_on(node):
            copy.attr["T"].type = dtype
        elif node.op == "VariableShape":
            copy.op = "Shape"
            copy.attr["T"].type = dtype
        elif node.op == "ResourceGather":
            axis = scope.fresh(f"{node.name}/axis")
            frozen.node.append(_constant(axis, np.array(0, np.int32), detached))
            indices = node.attr["Tindices"].type
            _become(copy, "GatherV2", Tparams=dtype, Tindices=indices, Taxis=schema.dtype_number(np.dtype(np.int32)))
            copy.input.insert(2, axis)
    return frozen


def _handles(graph_def: Any, values: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Frozen variables and what passes them on → their DataType."""
    found = {name: schema.dtype_number(array.dtype) for name, array in values.items()}
    readers: dict[str, list[Any]] = {}
    for node in graph_def.node:
        if hands_on(node):
            for reference in node.input:
                readers.setdefault(node_of(reference), []).append(node)
    stack = list(found)
    while stack:
        name = stack.pop()
        for node in readers.get(name, ()):
            if node.name not in found:
                found[node.name] = found[name]
                stack.append(node.name)
    return found


def _constant(name: str, value: np.ndarray, detached: Detached) -> Any:
    node = schema.NodeDef(name=name, op="Const")
    node.attr["dtype"].type = schema.dtype_number(value.dtype)
    node.attr["value"].tensor.CopyFrom(from_array(value, detached))
    return node


def _become(node: Any, op: str, **types: int) -> None:
    node.op = op
    node.attr.clear()
    for key, number in types.items():
        node.attr[key].type = number
