"""GraphDef bytes to Graph.

The reader takes the file as it is: all ops, all attributes, training part included. What the policy needs is decided
later (``export_model.converters.compiler.passes``), so that a graph with unknown training ops can still be read.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.formats.frozen_graph.emptied import lacks_values
from export_model.converters.formats.frozen_graph.tensors import to_array
from export_model.converters.graph.nodes import Graph, Node, TensorShape, node_of, normal_ref, topological
from export_model.converters.graph.ops.table import CALLS, is_fed
from export_model.converters.graph.size_limits import Allowance
from export_model.signatures.errors import DamagedFileError, NotAPolicyError

#: Before this GraphDef version a Placeholder's ``shape {}`` meant "unknown", not "scalar" (array_ops.cc, Placeholder).
SCALAR_SHAPE_PRODUCER = 24
#: Axes of a shape, attributes of a node, values of a list: TensorFlow allows 254 axes, and no policy has the others.
_MAX_AXES, _MAX_ATTRIBUTES, _MAX_LISTED = 254, 1 << 10, 1 << 16


def read_graph(data: bytes) -> Graph:
    """Parse a serialised GraphDef.

    Raises DamagedFileError when it cannot be decoded, GraphError on dangling inputs or cycles, NotAPolicyError when
    it decodes to a graph without nodes.
    """
    detached = Detached()
    return from_graph_def(schema.parse(schema.GraphDef, data, "TensorFlow graph", detached), detached)


def from_graph_def(graph_def: Any, detached: Detached | None = None) -> Graph:
    """A Graph of a GraphDef message (ours, or any object with the same fields), its constants views of the detached."""
    if not graph_def.node:
        raise NotAPolicyError("the graph has no nodes", fix="give the frozen graph that training wrote")
    schema.check_nodes(len(graph_def.node))
    calls = {f.signature.name for f in graph_def.library.function}
    allowance = Allowance()
    nodes = [_node(n, graph_def.versions.producer, allowance, detached) for n in graph_def.node]
    if lacks_values(graph_def):
        raise DamagedFileError(
            "the graph's constants hold no values",
            why="they were taken out, as TensorFlow.js before 1.0 did: those of a tensorflowjs_model.pb are in shards "
            "next to it, and weights_manifest.json says where",
            fix="give the folder with all of them, or freeze the graph again",
        )
    for node in nodes:
        if node.op in calls or node.op in CALLS:
            raise NotAPolicyError(
                f"node {node.name!r} calls the function {node.op!r}",
                why="the graph was saved from TensorFlow 2 functions and is not flat",
                fix="freeze it with convert_variables_to_constants_v2(f, lower_control_flow=True), which inlines them",
            )
    return Graph(topological(nodes))


def _node(proto: Any, producer: int, allowance: Allowance, detached: Detached | None) -> Node:
    if not proto.name or not proto.op:
        raise DamagedFileError(
            "a node has no name or no op",
            why="the bytes decode as protobuf but not as a TensorFlow graph",
            fix="give the frozen graph (.bytes, frozen_graph_def.pb) that training wrote",
        )
    if node_of(proto.name) != proto.name:
        raise DamagedFileError(
            f"a node is called {proto.name!r}",
            why="that is how the output of a node is called: a node's own name has no colon",
            fix="freeze the graph again; this file is damaged",
        )
    _few(len(proto.attr), _MAX_ATTRIBUTES, f"the node {proto.name!r} has", "attributes")
    attrs: dict[str, Any] = {}
    value: np.ndarray | None = None
    for key in sorted(proto.attr):
        if key.startswith("_"):
            continue
        try:
            if proto.op == "Const" and key == "value":
                value = to_array(proto.attr[key].tensor, allowance, detached)
            else:
                attrs[key] = _attribute(proto.attr[key], allowance, detached)
        except DamagedFileError as error:
            raise error.at(f"node {proto.name!r}, attribute {key!r}") from error
    if proto.op == "Const":
        if value is None:
            raise DamagedFileError(
                f"the constant {proto.name!r} has no value", fix="freeze the graph again; this file is damaged"
            )
        attrs = {}
    inputs = tuple(normal_ref(i) for i in proto.input if not i.startswith("^"))
    node = Node(proto.name, proto.op, inputs, attrs, value, origin=f"{proto.name}:0")
    if is_fed(node):
        _check_placeholder(proto.name, attrs)
    if proto.op == "Placeholder" and attrs.get("shape") == TensorShape(()) and producer < SCALAR_SHAPE_PRODUCER:
        attrs["shape"] = TensorShape(None)
    return node


def _check_placeholder(name: str, attrs: dict[str, Any]) -> None:
    """Raise DamagedFileError where a placeholder does not say its dtype, or says a shape that is none."""
    for key, kind in (("dtype", np.dtype), ("shape", TensorShape)):
        if not isinstance(attrs.get(key, TensorShape(None) if key == "shape" else None), kind):
            raise DamagedFileError(
                f"the placeholder {name!r} has {key} {attrs.get(key)!r}",
                why=f"it must be a {key}, so what it takes cannot be known",
                fix="freeze the graph again; this file is damaged",
            )


def _shape(proto: Any) -> TensorShape:
    if proto.unknown_rank:
        return TensorShape(None)
    _few(len(proto.dim), _MAX_AXES, "a shape has", "axes")
    return TensorShape(tuple(None if d.size < 0 else int(d.size) for d in proto.dim))


def _attribute(proto: Any, allowance: Allowance, detached: Detached | None) -> Any:
    kind = proto.WhichOneof("value")
    if kind == "s":
        return _text(proto.s)
    if kind in ("i", "f", "b"):
        return getattr(proto, kind)
    if kind == "type":
        return schema.dtype_of(proto.type)
    if kind == "shape":
        return _shape(proto.shape)
    if kind == "tensor":
        return to_array(proto.tensor, allowance, detached)
    if kind == "func":
        return proto.func.name
    if kind == "list":
        items = proto.list
        for field, convert in (
            ("s", _text),
            ("i", int),
            ("f", float),
            ("b", bool),
            ("type", schema.dtype_of),
            ("shape", _shape),
        ):
            if values := getattr(items, field):
                _few(len(values), _MAX_LISTED, "a list has", "values")
                return tuple(convert(v) for v in values)
        return ()
    return None


def _few(count: int, most: int, whose: str, what: str) -> None:
    if count > most:
        raise DamagedFileError(
            f"{whose} {count} {what}", why=f"no graph has more than {most}", fix="freeze the policy's own outputs"
        )


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")
