"""A SavedModel as files: one, or with its weights as variables, where protobuf could not hold it.

The variables are TensorFlow's resources; what restores them is as a TensorFlow 1 saver writes it (saver.proto,
saved_model/loader_impl.py), which TensorFlow 2 and TensorFlow Serving run as well. Nothing can be saved with it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.chunks import Pieces
from export_model.converters.files.external_data import Detached, is_readable
from export_model.converters.formats.frozen_graph.tensors import constant
from export_model.converters.graph.nodes import NameScope

_VERSION_2 = 2  # SaverDef.CheckpointFormatVersion


def files_of(message: Any, detached: Detached, unique: str) -> dict[str, Pieces]:
    """The files of a SavedModel of one graph, by their paths in its folder.

    ``unique`` keeps its variables apart from those of another that is loaded in the same process.
    """
    whole = schema.pieces(message, detached)
    if is_readable(whole):
        return {"saved_model.pb": whole}
    from export_model.converters.formats.checkpoint.write import (
        checkpoint,  # no other policy needs a checkpoint's tables
    )

    (meta,) = message.meta_graphs
    values = _variables(meta, detached, unique)
    variables = {f"variables/variables{end}": data for end, data in checkpoint(values).items()}
    return {"saved_model.pb": schema.pieces(message, detached), **variables}


def _variables(meta: Any, detached: Detached, unique: str) -> dict[str, np.ndarray]:
    """Make the detached constants of a graph variables; their values, by the names of these."""
    given = schema.GraphDef()
    given.CopyFrom(meta.graph_def)
    graph, scope = meta.graph_def, NameScope(n.name for n in given.node)
    graph.ClearField("node")
    found: dict[str, np.ndarray] = {}
    handles: dict[str, int] = {}
    for node in given.node:
        array = detached.array(node.attr["value"].tensor.tensor_content) if node.op == "Const" else None
        if array is None:
            graph.node.append(node)
            continue
        name, kind = scope.fresh(f"{node.name}/variable"), node.attr["dtype"].type
        handle = graph.node.add(name=name, op="VarHandleOp")
        handle.attr["dtype"].type = kind
        handle.attr["shape"].shape.CopyFrom(node.attr["value"].tensor.tensor_shape)
        handle.attr["shared_name"].s = f"{unique}/{name}".encode()
        graph.node.append(schema.node_def(node.name, "ReadVariableOp", [name], dtype=kind))
        dtype = schema.dtype_of(kind).newbyteorder("<")
        shape = [d.size for d in node.attr["value"].tensor.tensor_shape.dim]
        found[name] = (array if array.dtype == dtype else array.view(dtype)).reshape(shape)
        handles[name] = kind
    _saver(meta, scope, handles)
    return found


def _saver(meta: Any, scope: NameScope, handles: dict[str, int]) -> None:
    graph, names = meta.graph_def, list(handles)

    def text(wish: str, values: np.ndarray) -> str:
        graph.node.append(constant(scope.fresh(wish), values))
        return str(graph.node[-1].name)

    place = text("save/Const", np.array(b"model"))
    listed = text("save/RestoreV2/tensor_names", np.array([n.encode() for n in names]))
    slices = text("save/RestoreV2/shape_and_slices", np.array([b""] * len(names)))
    restore = graph.node.add(name=scope.fresh("save/RestoreV2"), op="RestoreV2", input=[place, listed, slices])
    restore.attr["dtypes"].list.type.extend(handles.values())
    assigned = []
    for index, (name, kind) in enumerate(handles.items()):
        sources, assign = [name, f"{restore.name}:{index}"], scope.fresh("save/AssignVariableOp")
        graph.node.append(schema.node_def(assign, "AssignVariableOp", sources, dtype=kind))
        assigned.append(f"^{assign}")
    done = graph.node.add(name=scope.fresh("save/restore_all"), op="NoOp", input=assigned)
    meta.saver_def.filename_tensor_name = meta.saver_def.save_tensor_name = f"{place}:0"
    meta.saver_def.restore_op_name = done.name
    meta.saver_def.version = _VERSION_2
