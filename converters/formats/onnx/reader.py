"""ONNX bytes to Graph: the model is checked, its functions are inlined, its nodes are translated one by one."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.onnx.batch_axis import ModelReading, dims_of, read_rows
from export_model.converters.formats.onnx.exporters import repair_model
from export_model.converters.formats.onnx.functions import all_nodes, inline_functions, opsets_of
from export_model.converters.formats.onnx.half_precision import widen
from export_model.converters.formats.onnx.importer.importer import Importer, joined_errors
from export_model.converters.formats.onnx.importer.node import DTYPES
from export_model.converters.formats.onnx.importer.table import TABLE
from export_model.converters.formats.onnx.memories import FoundMemories, OnnxMemory, separate_memories
from export_model.converters.formats.onnx.proto import array_of, decode_model, load_external, tensors
from export_model.converters.formats.onnx.sequences import flatten_sequences
from export_model.converters.graph.nodes import Graph, TensorShape
from export_model.converters.graph.types import BATCH, Dim, TensorType
from export_model.converters.policy.memories import looks_like_state
from export_model.converters.policy.rules import RoleDecision
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, UnsupportedOpError
from export_model.signatures.memories import SeparateMemory
from export_model.signatures.roles import ACTION_NAMES, CONSTANT_NAMES

_FLOAT, _DOUBLE = 1, 11
_INT = 2  # AttributeProto.AttributeType
#: The scalar that TensorFlow's recurrent policies take: how many steps a sequence has. A policy runs one.
_SEQUENCE_LENGTH = "sequence_length"


class OnnxModel(Struct, frozen=True):
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
    #: its samplers draw alike after every start
    seeded: bool = False
    doubles: bool = False
    #: node → shape, for inputs and outputs
    shapes: Mapping[str, tuple[Dim, ...] | None] = field(default_factory=dict)
    #: inputs and outputs of their own that are one memory
    memories: tuple[SeparateMemory, ...] = ()
    #: it was made for one agent, without an axis for more
    alone: bool = False
    #: it is in half precision, and was read as float32
    halves: bool = False
    #: faults of the exporter that it shows, or that were mended, as sentences
    faults: tuple[str, ...] = ()
    #: what the graph is called
    name: str = ""
    #: node → what was decided of an input that a recurrent layer begins with
    decisions: Mapping[str, RoleDecision] = field(default_factory=dict)


def read_onnx(given: Fetched, repair: str | None = None) -> OnnxModel:
    """Read a model, with the fault ``repair`` of its exporter mended.

    Raises DamagedFileError, NotAPolicyError, UnsupportedOpError, GraphError, UsageError (exporters.py).
    """
    detached = Detached()
    model, files = parse(given, detached)
    faults = repair_model(model, repair)
    halves = widen(model, detached)
    flatten_sequences(model.graph, detached)
    opsets = opsets_of(model)
    graph = model.graph
    constants = {t.name for t in graph.initializer}
    declared = [v for v in graph.input if v.name not in constants]
    found = _memories(graph, declared)
    memories, axes = found.memories, found.axes
    _check_names([*(v.name for v in declared), *(t.name for t in graph.initializer)])
    ends = {m.output: m.axis for m in memories}
    imported = partial(_import_nodes, graph, detached, opsets, declared, axes)
    reading = read_rows(imported, declared, graph.output, axes, ends, graph.node)
    importer, types = reading.importer, reading.types
    outputs, left_out = _outputs(importer, [v.name for v in graph.output])
    return OnnxModel(
        graph=reading.graph,
        files=(given.path, *files),
        producer=f"{model.producer_name} {model.producer_version}".strip(),
        inputs={v.name: importer.values[v.name] for v in declared},
        outputs=outputs,
        opset=opsets[""],
        draws=tuple(importer.draws),
        batch=reading.batch,
        metadata={p.key: p.value for p in model.metadata_props},
        left_out=left_out,
        kinds=frozenset(n.op_type for n in all_nodes(graph)),
        one_row=importer.one_row,
        seeded=any(a.name == "seed" for n in graph.node for a in n.attribute),
        integer_seeds=any(a.name == "seed" and a.type == _INT for n in graph.node for a in n.attribute),
        doubles=any(t.data_type == _DOUBLE for t in tensors(graph))
        or any(v.type.tensor_type.elem_type == _DOUBLE for v in declared),
        shapes={n: types[n].shape for n in (*(importer.values[v.name] for v in declared), *outputs.values())},
        memories=_joint(reading, memories, outputs),
        alone=reading.alone,
        halves=halves,
        faults=faults,
        name=graph.name,
        decisions={
            importer.values[n]: replace(d, tensor=importer.values[n])
            for n, d in found.decisions.items()
            if n in importer.values
        },
    )


def _import_nodes(
    graph: Any,
    detached: Detached,
    opsets: Mapping[str, int],
    declared: Sequence[Any],
    axes: Mapping[str, int],
    batch: int | None,
    alone: bool,
) -> Importer:
    """The nodes of a GraphProto, imported; ``axes`` are the batch axes of memories, ``alone``: free lengths are 1."""
    constants = {t.name for t in graph.initializer}
    reserved = [v.name for v in (*declared, *graph.output)] + [c for c in CONSTANT_NAMES if c in constants]
    importer = Importer(TABLE, opsets, reserved, batch, detached)
    for value in declared:
        _input(importer, value, batch, axes.get(value.name, 0), alone=alone)
    for tensor in graph.initializer:
        importer.initializer(tensor.name, array_of(tensor, detached))
    importer.run(graph.node)
    return importer


def parse(given: Fetched, detached: Detached | None = None) -> tuple[Any, list[Path]]:
    """(ModelProto without functions and with all its data, the files of that data). Raises DamagedFileError."""
    model = decode_model(given.data, detached)
    if not model.graph.node and not model.graph.output:
        raise NotAPolicyError("the model has no nodes", fix="give the model that training exported")
    if model.graph.sparse_initializer:
        raise UnsupportedOpError(
            "the model has sparse weights", issues=[(model.graph.sparse_initializer[0].values.name, "Constant")]
        )
    model = inline_functions(model)
    return model, load_external([model.graph], given.path.parent, detached)


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


def _memories(graph: Any, declared: Sequence[Any]) -> FoundMemories:
    floats = frozenset(v.name for v in declared if v.type.tensor_type.elem_type == _FLOAT)
    return separate_memories(
        graph, {v.name: dims_of(v) for v in declared}, {v.name: dims_of(v) for v in graph.output}, floats
    )


def _joint(
    reading: ModelReading, memories: Sequence[OnnxMemory], outputs: Mapping[str, str]
) -> tuple[SeparateMemory, ...]:
    """The memories by nodes; empty where one of them could not be made."""
    if any(m.output not in outputs for m in memories):
        return ()
    found = []
    for memory in memories:
        node = reading.importer.values[memory.input]
        shape = tuple(None if isinstance(d, str) else d for d in reading.types[node].shape or ())
        found.append(SeparateMemory(node, outputs[memory.output], shape, shape, memory.part))
    return tuple(found)


def _input(importer: Importer, value: Any, batch: int | None, axis: int, *, alone: bool) -> None:
    kind = value.type.tensor_type
    if not value.type.HasField("tensor_type") or kind.elem_type not in DTYPES:
        raise NotAPolicyError(
            f"the input {value.name!r} must be a tensor of floats, integers or booleans",
            why=f"its data type is {kind.elem_type}; policies take tensors",
        )
    dtype, dims = DTYPES[kind.elem_type], dims_of(value)
    if alone and dims is not None:
        dims = tuple(1 if d is None else d for d in dims)
    assumed = None
    if value.name.split(":")[0].rpartition("/")[2] == _SEQUENCE_LENGTH and dtype.kind in "iu" and not dims:
        assumed, dims = np.ones((), dtype), ()
    elif batch is not None and dims and (len(dims) > 1 or dtype.kind in "iu") and dims[axis] == batch:
        dims = (*dims[:axis], None, *dims[axis + 1 :])
    node = importer.placeholder(value.name, dtype, TensorShape(dims), assumed)
    if axis and dims is not None and not alone:
        importer.types[node] = TensorType(dtype, tuple(BATCH if i == axis else d or 0 for i, d in enumerate(dims)))


def _outputs(importer: Importer, names: Sequence[str]) -> tuple[dict[str, str], dict[str, str]]:
    """(output → node, output that could not be made → why). An action that cannot be made is an error."""
    outputs: dict[str, str] = {}
    broken: dict[str, UnsupportedOpError] = {}
    missing: dict[str, str] = {}
    for name in dict.fromkeys(names):
        if name in importer.values:
            outputs[name] = importer.values[name]
        elif name in importer.broken:
            broken[name] = importer.broken[name]
        elif name in CONSTANT_NAMES:  # Unity's own SoccerTwos
            missing[name] = "it is a constant of ML-Agents, and nothing in the file makes it"
        else:
            raise DamagedFileError(
                f"nothing makes the output {name!r}", why="the model was cut or edited", fix="export the model again"
            )
    needed = [n for n in broken if n.split(":")[0] in ACTION_NAMES]
    if broken and (needed or all(map(looks_like_state, _computed_outputs(outputs, importer)))):
        raise joined_errors([broken[n] for n in needed or broken])
    return outputs, {**missing, **{name: error.what for name, error in broken.items()}}


def _computed_outputs(outputs: Mapping[str, str], importer: Importer) -> Collection[str]:
    """The outputs that are no constants of the model."""
    return [name for name, node in outputs.items() if importer.constant(node) is None]
