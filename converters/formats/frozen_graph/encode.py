"""Graph to GraphDef.

Two dialects: *portable* writes only what TensorFlow 1.4 knows (no attribute or op newer than it, no ``_class``, no
device, no function library), which every later version reads too; *explicit* writes every op and attribute.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.formats.frozen_graph.tensors import from_array
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.ops.base import REQUIRED, Attr
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import Types, infer_types
from export_model.signatures.errors import GraphError, UnsupportedOpError

#: GraphDef version written: that of TF 1.4. (Graphs frozen by TF 1.x carry none, which TensorFlow.js cannot read.)
PRODUCER = 24
_RESOURCE = 20


def encode(graph: Graph, *, explicit: bool = False, detached: Detached | None = None) -> Any:
    """A GraphDef message, its large constants in ``detached``.

    Raises UnsupportedOpError when the portable dialect lacks an op.
    """
    types = infer_types(graph)
    message = schema.GraphDef()
    message.versions.producer = PRODUCER
    for node in graph.nodes:
        entry = op_of(node)
        if not explicit and entry.since is not None:
            raise UnsupportedOpError(
                f"{node.op} (node {node.name!r}) came with TensorFlow {entry.since}",
                issues=[(node.name, node.op)],
                why="a .bytes graph must load in the runtimes of its time",
                fix="write the other formats: --to saved_model,tfjs,onnx",
            )
        proto = message.node.add(name=node.name, op=node.op)
        proto.input.extend(node.inputs)
        if node.op == "Const":
            assert node.value is not None
            proto.attr["dtype"].type = schema.dtype_number(node.value.dtype)
            proto.attr["value"].tensor.CopyFrom(from_array(node.value, detached))
            continue
        for attr, value in attributes(node, types):
            if not explicit and attr.since is not None and value == attr.default:
                continue
            try:
                _set(proto.attr[attr.name], attr.kind, value)
            except (AttributeError, TypeError, ValueError) as error:
                raise GraphError(
                    f"node {node.name!r} ({node.op}) has {attr.name}={value!r}; it must be of the kind {attr.kind}",
                    fix="the graph is damaged; freeze it again from its checkpoint",
                ) from error
    return message


def attributes(node: Node, types: Types) -> Iterator[tuple[Attr, Any]]:
    """The attributes that a GraphDef has of a node, those that follow from its inputs and outputs included."""
    for attr in op_of(node).attrs:
        if attr.derive is not None:
            yield attr, _derive(node, attr.derive, types)
        elif (value := node.attrs.get(attr.name, attr.default)) is not REQUIRED:
            yield attr, value


def _derive(node: Node, derive: str, types: Types) -> Any:
    side, _, position = derive.partition(":")
    if side == "count":
        return len(node.inputs) - int(position or 0)
    if side == "in":
        return types[node.inputs[int(position)]].dtype
    return types[node.name].dtype


def as_read(graph: Graph) -> Any:
    """A GraphDef message of a graph that need not be compiled: nothing is asked of its ops, nothing is derived."""
    message = schema.GraphDef()
    message.versions.producer = PRODUCER
    for node in graph.nodes:
        proto = message.node.add(name=node.name, op=node.op)
        proto.input.extend(node.inputs)
        attrs = dict(node.attrs)
        if node.value is not None:
            attrs.update(dtype=node.value.dtype, value=node.value)
        for key, value in sorted(attrs.items()):
            kind = _kind(value)
            if kind is not None:
                _set(proto.attr[key], kind, value)
    return message


_PLAIN: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "int": ("i", int),
    "float": ("f", float),
    "bool": ("b", bool),
    "str": ("s", lambda text: text if isinstance(text, bytes) else text.encode()),
    "type": ("type", lambda dtype: schema.dtype_number(np.dtype(dtype))),
    "resource": ("type", lambda dtype: _RESOURCE),
}


def _kind(value: Any) -> str | None:
    """What a value is, where no entry of the op table says it; None: nothing that an attribute holds."""
    if isinstance(value, tuple):
        return _kind(value[0]) if value else "str"
    if isinstance(value, np.dtype | type) and np.dtype(value).kind == "O":
        return "resource"  # a resource or variant, which numpy has not
    for kind, types in (
        ("bool", bool),
        ("int", int),
        ("float", float),
        ("str", (str, bytes)),
        ("shape", TensorShape),
        ("tensor", np.ndarray),
        ("type", (np.dtype, type)),
    ):
        if isinstance(value, types):
            return kind
    return None


def _set(proto: Any, kind: str, value: Any) -> None:
    if isinstance(value, tuple):
        proto.list.SetInParent()
        for item in value:
            if kind == "shape":
                _set_shape(proto.list.shape.add(), item)
            else:
                field, plain = _PLAIN[kind]
                getattr(proto.list, field).append(plain(item))
    elif kind == "shape":
        _set_shape(proto.shape, value)
    elif kind == "tensor":
        proto.tensor.CopyFrom(from_array(value))
    else:
        field, plain = _PLAIN[kind]
        setattr(proto, field, plain(value))


def _set_shape(proto: Any, value: TensorShape) -> None:
    proto.SetInParent()
    if value.dims is None:
        proto.unknown_rank = True
        return
    for size in value.dims:
        proto.dim.add(size=-1 if size is None else size)
