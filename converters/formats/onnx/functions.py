"""The functions of a model written out: its own, and those of ONNX's ops that ONNX itself defines by others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from msgspec import Struct, field

from export_model.converters.formats.onnx.importer.node import STANDARD
from export_model.converters.formats.onnx.importer.table import TABLE
from export_model.converters.formats.onnx.messages import as_onnx_message
from export_model.converters.formats.onnx.proto import bodies
from export_model.converters.graph.builder import MAX_BUILT_NODES
from export_model.signatures.errors import DamagedFileError, UnsupportedOpError

#: Opsets that are read. Before 7 broadcasting was an attribute of each op.
FIRST_OPSET = 7
#: Copies of functions may hold this many bytes, and this factor of the model's.
_BYTES_FREE, _BYTES_FACTOR = 1 << 26, 4
_MAX_DEPTH = 64
#: The largest version that onnx asks its schemas for.
_INT32 = (1 << 31) - 1
#: Nodes that onnx's inliner looks at: all for each op whose definition asks for types. 1,000 among 1,000 take 5 s.
_MAX_LOOKED_AT = 1 << 18
#: What an attribute that a call gives is charged beside its bytes.
_ATTRIBUTE = 64


def inline_functions(model: Any) -> Any:
    """The model without functions: its own, and those of ONNX's ops that are defined by others and not in the table."""
    if model.functions:
        import onnx.inliner

        model = as_onnx_message(model)
        functions = {_identity(f, f.name): f for f in model.functions}
        called = _Unfolding(functions, int(model.ByteSize())).check(model.graph)
        bodies = (model.graph, *(functions[name] for name in called))
        own = {name: functions[name].attribute_proto for name in called}
        _complete([n for body in bodies for n in all_nodes(body)], own)
        try:
            model = onnx.inliner.inline_local_functions(model)
        except (RuntimeError, ValueError, onnx.checker.ValidationError) as error:
            raise DamagedFileError(
                "the model's functions cannot be inlined",
                why=str(error).strip().splitlines()[0],
                fix="export it with functions inlined (onnx.inliner.inline_local_functions)",
            ) from error
    defined = _schemas_of_unknown(model)
    if not defined:
        return model
    import onnx.inliner

    model = as_onnx_message(model)
    everything = all_nodes(model.graph)
    nodes = [n for n in everything if n.domain in STANDARD and n.op_type in defined]
    typed = [n for n in nodes if defined[n.op_type].has_context_dependent_function]
    if len(typed) * len(everything) > _MAX_LOOKED_AT:
        raise UnsupportedOpError(
            f"the model has {len(typed)} nodes that ONNX defines by others, among {len(everything)}",
            issues=[(n.name, n.op_type) for n in typed[:9]],
            why="its inliner looks at the whole model for each; a policy has a few of them",
            fix="give the policy alone, or export it with functions inlined (onnx.inliner)",
        )
    _complete(nodes, {_identity(n, n.op_type): _defaults(defined[n.op_type]) for n in nodes})
    try:
        chosen = [("", kind) for kind in defined]
        return onnx.inliner.inline_selected_functions(model, chosen, inline_schema_functions=True)
    except (RuntimeError, ValueError, onnx.checker.ValidationError):
        return model  # an op whose definition needs more than is known stays, and is refused by its name


def _schemas_of_unknown(model: Any) -> dict[str, Any]:
    """Op → schema, of the model's ops that are in no table here and that ONNX defines by others."""
    known, version = {kind for domain, kind in TABLE if not domain}, opsets_of(model)[""]
    unknown = {n.op_type for n in all_nodes(model.graph) if n.domain in STANDARD} - known
    if not unknown:
        return {}
    import onnx.defs

    found = {}
    for kind in sorted(unknown):
        with suppress(onnx.defs.SchemaError):
            schema: Any = onnx.defs.get_schema(kind, min(version, _INT32))
            if schema.has_function or schema.has_context_dependent_function:
                found[kind] = schema
    return found


def _defaults(schema: Any) -> list[Any]:
    return [a.default_value for a in schema.attributes.values() if a.default_value.name]


def _identity(message: Any, name: str) -> str:
    """What a function is called by: onnx's inliner joins the three texts, so that a name may hold two of them."""
    domain = "" if message.domain in STANDARD else message.domain
    return f"{domain}::{name}::{message.overload}" if message.overload else f"{domain}::{name}"


def _complete(nodes: Sequence[Any], defaults: Mapping[str, Sequence[Any]]) -> None:
    """Write out the attributes that calls of functions, by ``_identity``, leave to their defaults.

    onnx's inliner drops an attribute of a function's body that refers to one that is left out: without ``axes``,
    MeanVarianceNormalization would take the mean of everything.
    """
    for node in nodes:
        given = {a.name for a in node.attribute}
        node.attribute.extend(a for a in defaults.get(_identity(node, node.op_type), ()) if a.name not in given)


class _Load(Struct):
    """What a body unfolds to: nodes (a call is one, too), bytes that are copied, names of values.

    ``reads`` is how often it takes an attribute of the function that it is part of.
    """

    nodes: int = 0
    bytes: int = 0
    names: int = 0
    reads: Counter[str] = field(default_factory=Counter)

    def add(self, other: _Load, times: int = 1) -> None:
        self.nodes += times * other.nodes
        self.bytes += times * other.bytes
        self.names += times * other.names
        for name, count in other.reads.items():
            self.reads[name] += times * count


class _Unfolding:
    """Functions that call functions that call functions may unfold a small file to any size: refuse before."""

    def __init__(self, functions: Mapping[str, Any], size: int) -> None:
        self.functions = functions
        self.most = _BYTES_FREE + _BYTES_FACTOR * size
        self.loads: dict[str, _Load] = {}

    def check(self, graph: Any) -> Iterable[str]:
        """The functions that are called. Raises UnsupportedOpError, DamagedFileError."""
        self._body(graph, ())
        return self.loads

    def _body(self, body: Any, within: tuple[str, ...]) -> _Load:
        """``within`` are the functions and subgraphs around."""
        if len(within) > _MAX_DEPTH:
            raise UnsupportedOpError(
                f"the model's functions call one another more than {_MAX_DEPTH} deep",
                issues=[(body.name, "function")],
                why="a policy's are a few deep",
                fix="give the policy alone, without the training part",
            )
        load = _Load()
        for node in body.node:
            name = _identity(node, node.op_type)
            load.add(self._call(node, name, within) if name in self.functions else self._plain(node, within))
            if load.nodes > MAX_BUILT_NODES or load.bytes > self.most:
                raise UnsupportedOpError(
                    f"its functions unfold to more than {MAX_BUILT_NODES} nodes, or more bytes than a policy has",
                    issues=[(node.name, node.op_type)],
                    why="a policy has some hundreds of nodes",
                    fix="give the policy alone, without the training part",
                )
        return load

    def _plain(self, node: Any, within: tuple[str, ...]) -> _Load:
        load = _Load(1, 0, len(node.input) + len(node.output))
        for attribute in node.attribute:
            load.add(self._attribute(attribute, within))
        return load

    def _call(self, node: Any, name: str, within: tuple[str, ...]) -> _Load:
        """The function is copied, with the call's own names and attributes wherever it reads them."""
        if name in within:
            raise DamagedFileError(f"the function {node.op_type!r} calls itself", fix="export the model again")
        function = self.functions[name]
        if name not in self.loads:
            self.loads[name] = self._body(function, (*within, name))
        called = self.loads[name]
        values = [*node.input, *node.output]
        names = called.names * max((len(v.encode()) for v in values), default=0)
        load = _Load(1, int(function.ByteSize()) + int(node.ByteSize()) + names, len(values))
        load.add(_Load(called.nodes, called.bytes, called.names))
        given = {a.name for a in node.attribute}
        for attribute in (*node.attribute, *(a for a in function.attribute_proto if a.name not in given)):
            own = self._attribute(attribute, within)
            own.bytes += _ATTRIBUTE + int(attribute.ByteSize())
            load.add(own, 1 + called.reads[attribute.name])
        return load

    def _attribute(self, attribute: Any, within: tuple[str, ...]) -> _Load:
        load = _Load()
        if attribute.ref_attr_name:
            load.reads[attribute.ref_attr_name] = 1
        for graph in (*([attribute.g] if attribute.HasField("g") else ()), *attribute.graphs):
            load.add(self._body(graph, (*within, "")))
        return load


def all_nodes(graph: Any) -> list[Any]:
    """The nodes of a graph or function, those of its bodies too."""
    return [node for body in bodies(graph) for node in body.node]


def opsets_of(model: Any) -> dict[str, int]:
    """The version of each domain; raises UnsupportedOpError for one of ONNX that is too old."""
    opsets = {("" if o.domain in STANDARD else o.domain): int(o.version) for o in model.opset_import}
    version = opsets.setdefault("", 1)
    if version < FIRST_OPSET:
        raise UnsupportedOpError(
            f"the model is written in opset {version}",
            issues=[(model.graph.name or "model", f"opset {version}")],
            why=f"opsets from {FIRST_OPSET} on are read; before, broadcasting was an attribute of each op",
            fix="onnx.version_converter.convert_version(model, 9) brings it forward",
        )
    return opsets
