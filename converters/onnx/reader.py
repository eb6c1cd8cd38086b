"""ONNX bytes to Graph: the model is checked, its functions are inlined, its nodes are translated one by one."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from converters.fetch import Fetched
from converters.graph.builder import MAX_NODES
from converters.graph.nodes import Graph, TensorShape
from converters.graph.types import BATCH, Dim, TensorType
from converters.onnx.importer.importer import Importer, joined_errors
from converters.onnx.importer.node import DTYPES, STANDARD
from converters.onnx.importer.table import TABLE
from converters.onnx.memories import OnnxMemory, separate_memories
from converters.onnx.one_row import check_rows
from converters.onnx.proto import array_of, decoded, load_external, tensors
from signatures.errors import DamagedFileError, NotAPolicyError, UnsupportedOpError
from signatures.memories import SeparateMemory
from signatures.roles import ACTION_NAMES, CONSTANT_NAMES

#: Opsets that are read. Before 7 broadcasting was an attribute of each op.
FIRST_OPSET = 7
#: Numbers that a model with a fixed batch may take at a time (32 MiB).
_MAX_NUMBERS = 1 << 23
_FLOAT, _FLOAT16, _BFLOAT16, _DOUBLE = 1, 10, 16, 11
_INT = 2  # AttributeProto.AttributeType
#: The scalar that TensorFlow's recurrent policies take: how many steps a sequence has. A policy runs one.
_SEQUENCE_LENGTH = "sequence_length"


@dataclass(frozen=True)
class OnnxModel:
    """A model as it was read.

    ``inputs`` and ``outputs`` map the model's values to nodes of the graph, in the file's order. ``draws`` are the
    values that an in-graph sampler of normals makes. ``batch`` is the number of rows it was exported for, where that
    is fixed. ``left_out`` are outputs that cannot be converted, with the reason.
    """

    graph: Graph
    files: tuple[Path, ...]
    producer: str
    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    opset: int
    draws: tuple[str, ...] = ()
    batch: int | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    #: op types, those of bodies too
    kinds: frozenset[str] = frozenset()
    #: a recurrent layer takes its memory in a form that is right for one row only
    one_row: bool = False
    #: a sampler's seed is an integer where ONNX says float
    integer_seeds: bool = False
    doubles: bool = False
    #: node → shape, for inputs and outputs
    shapes: Mapping[str, tuple[Dim, ...] | None] = field(default_factory=dict)
    #: inputs and outputs of their own that are one memory
    memories: tuple[SeparateMemory, ...] = ()


def read_onnx(given: Fetched) -> OnnxModel:
    """Read a model. Raises DamagedFileError, NotAPolicyError, UnsupportedOpError, GraphError."""
    model, files = parse(given)
    opsets = _opsets(model)
    graph = model.graph
    constants = {t.name for t in graph.initializer}
    declared = [v for v in graph.input if v.name not in constants]
    memories, axes = _memories(graph, declared)
    batch = _fixed_batch(declared, axes)
    _check_names([*(v.name for v in declared), *(t.name for t in graph.initializer)])
    importer = _imported(graph, opsets, declared, batch, axes)
    if batch is None and _baked(importer, graph.output):
        batch = 1
        importer = _imported(graph, opsets, declared, batch, axes)
        check_rows(importer.graph(), [importer.values[v.name] for v in graph.output if v.name in importer.values])
    outputs, left_out = _outputs(importer, [v.name for v in graph.output])
    return OnnxModel(
        importer.graph(),
        (given.path, *files),
        f"{model.producer_name} {model.producer_version}".strip(),
        {v.name: importer.values[v.name] for v in declared},
        outputs,
        opsets[""],
        tuple(importer.draws),
        batch,
        {p.key: p.value for p in model.metadata_props},
        left_out,
        frozenset(n.op_type for n in _all_nodes(graph)),
        importer.one_row,
        any(a.name == "seed" and a.type == _INT for n in graph.node for a in n.attribute),
        any(t.data_type == _DOUBLE for t in tensors(graph)),
        {n: importer.type_of(n).shape for n in (*(importer.values[v.name] for v in declared), *outputs.values())},
        _joint(importer, memories, outputs),
    )


def _imported(
    graph: Any, opsets: Mapping[str, int], declared: Sequence[Any], batch: int | None, axes: Mapping[str, int]
) -> Importer:
    """The nodes of a GraphProto, imported; ``axes`` are the batch axes of memories."""
    constants = {t.name for t in graph.initializer}
    reserved = [v.name for v in (*declared, *graph.output)] + [c for c in CONSTANT_NAMES if c in constants]
    importer = Importer(TABLE, opsets, reserved, batch)
    for value in declared:
        _input(importer, value, batch, axes.get(value.name, 0))
    for tensor in graph.initializer:
        importer.initializer(tensor.name, array_of(tensor))
    importer.run(graph.node)
    return importer


def _baked(importer: Importer, outputs: Sequence[Any]) -> bool:
    """Whether a model that says it takes any number of rows takes one: a Reshape inside kept the 1 of its export."""
    made = {v.name: importer.type_of(importer.values[v.name]).shape for v in outputs if v.name in importer.values}
    free = [v.name for v in outputs if (_dims(v) or (0,))[0] is None]
    return any((made.get(name) or (0,))[0] == 1 for name in free)


def parse(given: Fetched) -> tuple[Any, list[Path]]:
    """(ModelProto without functions and with all its data, the files of that data). Raises DamagedFileError."""
    model = decoded(given.data)
    if not model.graph.node and not model.graph.output:
        raise NotAPolicyError("the model has no nodes", fix="give the model that training exported")
    if model.graph.sparse_initializer:
        raise UnsupportedOpError(
            "the model has sparse weights", issues=[(model.graph.sparse_initializer[0].values.name, "Constant")]
        )
    model = _inlined(model)
    return model, load_external(model.graph, given.path.parent)


def _inlined(model: Any) -> Any:
    """The model without functions: its own, and those of ONNX's ops that are defined by others and not in the table."""
    import onnx.inliner

    if model.functions:
        _check_unfolding(model)
        bodies = (model.graph, *model.functions)
        own = {(f.domain, f.name): f.attribute_proto for f in model.functions}
        _complete([n for body in bodies for n in _all_nodes(body)], own)
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
    _complete(_all_nodes(model.graph), {("", kind): _defaults(schema) for kind, schema in defined.items()})
    try:
        chosen = [("", kind) for kind in defined]
        return onnx.inliner.inline_selected_functions(model, chosen, inline_schema_functions=True)
    except (RuntimeError, ValueError, onnx.checker.ValidationError):
        return model  # an op whose definition needs more than is known stays, and is refused by its name


def _defined(model: Any) -> dict[str, Any]:
    """Op → schema, of the model's ops that are in no table here and that ONNX defines by others."""
    import onnx.defs

    known, version = {kind for domain, kind in TABLE if not domain}, _opsets(model)[""]
    used = {n.op_type for n in _all_nodes(model.graph) if n.domain in STANDARD}
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
                sizes[key] = size(_all_nodes(functions[key]), callers | {key})
            total += sizes.get(key, 1)
            if total > MAX_NODES:
                raise UnsupportedOpError(
                    f"the model's functions unfold to more than {MAX_NODES} nodes",
                    issues=[(node.name, node.op_type)],
                    why="a policy has some hundreds",
                    fix="give the policy alone, without the training part",
                )
        return total

    size(_all_nodes(model.graph), frozenset())


def _all_nodes(graph: Any) -> list[Any]:
    found = list(graph.node)
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("g"):
                found.extend(_all_nodes(attribute.g))
    return found


def _opsets(model: Any) -> dict[str, int]:
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


def _check_names(names: Sequence[str]) -> None:
    seen: set[str] = set()
    for name in names:
        if not name or name in seen:
            raise DamagedFileError(
                f"two inputs or constants are called {name!r}" if name else "an input or constant has no name",
                why="names of values must be unique",
                fix="export the model again",
            )
        seen.add(name)


# ------------------------------------------------------------------ inputs and outputs


def _dims(value: Any) -> tuple[int | None, ...] | None:
    """The declared shape; a length of 0 or below, and a named one, is free."""
    kind = value.type.tensor_type
    if not kind.HasField("shape"):
        return None
    return tuple(int(d.dim_value) if d.HasField("dim_value") and d.dim_value > 0 else None for d in kind.shape.dim)


def _memories(graph: Any, declared: Sequence[Any]) -> tuple[tuple[OnnxMemory, ...], dict[str, int]]:
    floats = frozenset(v.name for v in declared if v.type.tensor_type.elem_type == _FLOAT)
    return separate_memories(
        graph, {v.name: _dims(v) for v in declared}, {v.name: _dims(v) for v in graph.output}, floats
    )


def _joint(
    importer: Importer, memories: Sequence[OnnxMemory], outputs: Mapping[str, str]
) -> tuple[SeparateMemory, ...]:
    """The memories by nodes; empty where one of them could not be made."""
    if any(m.output not in outputs for m in memories):
        return ()
    found = []
    for memory in memories:
        node = importer.values[memory.input]
        shape = tuple(None if isinstance(d, str) else d for d in importer.type_of(node).shape or ())
        found.append(SeparateMemory(node, outputs[memory.output], shape, shape, memory.part))
    return tuple(found)


def _fixed_batch(declared: Sequence[Any], axes: Mapping[str, int]) -> int | None:
    """The number of rows that all inputs were exported with, None where an input leaves any length free.

    torch.onnx.export fixes every length that ``dynamic_axes`` does not name; Stable-Baselines3's and rsl_rl's recipes
    name none. ``axes`` are the batch axes of memories; one that is fixed fixes the model, whatever else is left free.
    """
    memories = {dims[axes[v.name]] for v in declared if v.name in axes and (dims := _dims(v)) is not None}
    if memories:
        return memories.pop() if len(memories) == 1 else None
    shapes = [_dims(v) for v in declared]
    if any(dims is None or None in dims for dims in shapes):
        return None
    leading = {dims[0] for dims in shapes if dims is not None and len(dims) > 1}
    if not leading:  # a discrete state: one number a row
        numbers = (v for v in declared if DTYPES.get(v.type.tensor_type.elem_type, np.dtype("f4")).kind in "iu")
        leading = {dims[0] for v in numbers if (dims := _dims(v)) is not None and len(dims) == 1}
    batch = leading.pop() if len(leading) == 1 else None
    return None if batch is None else _bearable(batch, shapes)


def _bearable(batch: int, shapes: Sequence[tuple[int | None, ...] | None]) -> int:
    """A number of rows, if a run of the model with so many is no more than a runtime can bear."""
    numbers = sum(math.prod(d or 1 for d in dims) for dims in shapes if dims is not None)
    if numbers > _MAX_NUMBERS:
        raise NotAPolicyError(
            f"was exported for {batch} rows at a time, which are {numbers} numbers",
            why=f"it can be run with as many only, and no more than {_MAX_NUMBERS} are given to a runtime",
            fix="export it with a free batch axis (dynamic_axes), or for one row",
        )
    return batch


def _input(importer: Importer, value: Any, batch: int | None, axis: int) -> None:
    kind = value.type.tensor_type
    if not value.type.HasField("tensor_type") or kind.elem_type not in DTYPES or kind.elem_type == _DOUBLE:
        wide = value.type.HasField("tensor_type") and kind.elem_type in (_FLOAT16, _BFLOAT16, _DOUBLE)
        raise NotAPolicyError(
            f"the input {value.name!r} is no tensor of float32, integers or booleans",
            why=f"its data type is {kind.elem_type}; policies take float32, and TensorFlow.js has no other float"
            if wide
            else "policies take tensors",
            fix="export the model in float32 (model.float())" if wide else None,
        )
    dtype, dims = DTYPES[kind.elem_type], _dims(value)
    assumed = None
    if value.name.split(":")[0].rpartition("/")[2] == _SEQUENCE_LENGTH and dtype.kind in "iu" and not dims:
        assumed, dims = np.ones((), dtype), ()
    elif batch is not None and dims and (len(dims) > 1 or dtype.kind in "iu") and dims[axis] == batch:
        dims = (*dims[:axis], None, *dims[axis + 1 :])
    node = importer.placeholder(value.name, dtype, TensorShape(dims), assumed)
    if axis and dims is not None:
        importer.types[node] = TensorType(dtype, tuple(BATCH if i == axis else d or 0 for i, d in enumerate(dims)))


def _outputs(importer: Importer, names: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """(output → node, output that could not be made → why). An action that cannot be made is an error."""
    outputs: dict[str, str] = {}
    broken: dict[str, UnsupportedOpError] = {}
    for name in dict.fromkeys(names):
        if name in importer.values:
            outputs[name] = importer.values[name]
        elif name in importer.broken:
            broken[name] = importer.broken[name]
        else:
            raise DamagedFileError(
                f"nothing makes the output {name!r}", why="the model was cut or edited", fix="export the model again"
            )
    needed = [n for n in broken if n.split(":")[0] in ACTION_NAMES]
    if broken and (needed or not _computed(outputs, importer)):
        raise joined_errors([broken[n] for n in needed or broken])
    return outputs, {name: error.what for name, error in broken.items()}


def _computed(outputs: Mapping[str, str], importer: Importer) -> Collection[str]:
    """The outputs that are no constants of the model."""
    return [name for name, node in outputs.items() if importer.constant(node) is None]
