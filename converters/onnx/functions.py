"""The functions of a model written out: its own, and those of ONNX's ops that ONNX itself defines by others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from converters.graph.builder import MAX_NODES
from converters.onnx.importer.node import STANDARD
from converters.onnx.importer.table import TABLE
from signatures.errors import DamagedFileError, UnsupportedOpError

#: Opsets that are read. Before 7 broadcasting was an attribute of each op.
FIRST_OPSET = 7


def inlined(model: Any) -> Any:
    """The model without functions: its own, and those of ONNX's ops that are defined by others and not in the table."""
    import onnx.inliner

    if model.functions:
        _check_unfolding(model)
        bodies = (model.graph, *model.functions)
        own = {(f.domain, f.name): f.attribute_proto for f in model.functions}
        _complete([n for body in bodies for n in all_nodes(body)], own)
        try:
            model = onnx.inliner.inline_local_functions(model)
        except (RuntimeError, ValueError, onnx.checker.ValidationError) as error:
            raise DamagedFileError(
                "the model's functions cannot be inlined",
                why=str(error).strip().splitlines()[0],
                fix="export it with functions inlined (onnx.inliner.inline_local_functions)",
            ) from error
    defined = _defined(model)
    if not defined:
        return model
    _complete(all_nodes(model.graph), {("", kind): _defaults(schema) for kind, schema in defined.items()})
    try:
        chosen = [("", kind) for kind in defined]
        return onnx.inliner.inline_selected_functions(model, chosen, inline_schema_functions=True)
    except (RuntimeError, ValueError, onnx.checker.ValidationError):
        return model  # an op whose definition needs more than is known stays, and is refused by its name


def _defined(model: Any) -> dict[str, Any]:
    """Op → schema, of the model's ops that are in no table here and that ONNX defines by others."""
    import onnx.defs

    known, version = {kind for domain, kind in TABLE if not domain}, opsets_of(model)[""]
    used = {n.op_type for n in all_nodes(model.graph) if n.domain in STANDARD}
    found = {}
    for kind in sorted(used - known):
        with suppress(onnx.defs.SchemaError):
            schema: Any = onnx.defs.get_schema(kind, version)
            if schema.has_function or schema.has_context_dependent_function:
                found[kind] = schema
    return found


def _defaults(schema: Any) -> list[Any]:
    return [a.default_value for a in schema.attributes.values() if a.default_value.name]


def _complete(nodes: Sequence[Any], defaults: Mapping[tuple[str, str], Sequence[Any]]) -> None:
    """Write out the attributes that calls of functions, by (domain, name), leave to their defaults.

    onnx's inliner drops an attribute of a function's body that refers to one that is left out: without ``axes``,
    MeanVarianceNormalization would take the mean of everything.
    """
    for node in nodes:
        given = {a.name for a in node.attribute}
        known = defaults.get(("" if node.domain in STANDARD else node.domain, node.op_type), ())
        node.attribute.extend(a for a in known if a.name not in given)


def _check_unfolding(model: Any) -> None:
    """Functions that call functions that call functions may unfold a small file to any size: refuse before."""
    functions = {(f.domain, f.name): f for f in model.functions}
    sizes: dict[tuple[str, str], int] = {}

    def size(nodes: Sequence[Any], callers: frozenset[tuple[str, str]]) -> int:
        total = 0
        for node in nodes:
            key = (node.domain, node.op_type)
            if key in callers:
                raise DamagedFileError(f"the function {node.op_type!r} calls itself", fix="export the model again")
            if key in functions and key not in sizes:
                sizes[key] = size(all_nodes(functions[key]), callers | {key})
            total += sizes.get(key, 1)
            if total > MAX_NODES:
                raise UnsupportedOpError(
                    f"the model's functions unfold to more than {MAX_NODES} nodes",
                    issues=[(node.name, node.op_type)],
                    why="a policy has some hundreds",
                    fix="give the policy alone, without the training part",
                )
        return total

    size(all_nodes(model.graph), frozenset())


def all_nodes(graph: Any) -> list[Any]:
    """The nodes of a graph or function, those of its bodies too."""
    found = list(graph.node)
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("g"):
                found.extend(all_nodes(attribute.g))
    return found


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
