"""How many agents an ONNX model decides for at a time: any number, or the one (or few) that it was exported for.

torch.onnx.export fixes every length that ``dynamic_axes`` does not name, and what it traced may hold the number of rows
inside, too. Three readings are tried, and each is held to what it says: the model's own free axis; its fixed number of
rows, left free (``importer/fixed_batch.py``); the model for one agent, computed for each (``compiler/passes/vmap.py``).
What only says that it takes any number is tried (``compiler/passes/vmap_trial.py``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.converters.compiler.passes.vmap import for_every_row
from export_model.converters.compiler.passes.vmap_trial import ROWS, check_rows, too_large
from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import DTYPES
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.shapes import Types, infer_types
from export_model.converters.graph.size_limits import MAX_COMPUTED
from export_model.signatures.errors import ExportModelError, NotAPolicyError, SignatureError

#: Numbers that a model with a fixed batch may take at a time (32 MiB).
_MAX_FED = 1 << 23

Dims = tuple[int | None, ...] | None


class ModelReading(Struct, frozen=True):
    """A model as it is read.

    ``batch`` is the number of rows that the file itself takes, None: any; ``alone``: it was made for one agent, and the
    graph computes each agent's row by itself.
    """

    importer: Importer
    graph: Graph
    types: Types
    batch: int | None = None
    alone: bool = False


#: (the fixed number of rows that is left free, whether free lengths are 1) → the nodes imported
Import = Callable[[int | None, bool], Importer]


def read_rows(
    imported: Import,
    declared: Sequence[Any],
    outputs: Sequence[Any],
    axes: Mapping[str, int],
    ends: Mapping[str, int],
    nodes: Sequence[Any],
) -> ModelReading:
    """Return the reading that is right of a model with ``nodes``.

    ``axes`` and ``ends`` are the batch axes of memories, by input and by output. Inputs that are handed on as they came
    say nothing of rows: godot_rl's exporter may fix ``state_ins`` alone to one number. Raises what ``_import_nodes``
    raises, SignatureError where the model gives one row only and no reading gives more.
    """
    asked, judged = _without_echoes(declared, outputs, nodes)
    batch = _fixed_batch(asked, axes)
    importer = imported(batch, False)
    if batch is None and not _static(asked):
        if not _has_baked_batch(importer, judged):
            return ModelReading(importer, importer.graph(), importer.types)
        importer, batch = imported(1, False), 1
        fault = _fault(importer, judged)
        if fault is None:
            return ModelReading(importer, importer.graph(), importer.types, batch)
        try:
            return _alone(imported, declared, outputs, axes, ends, leading=True)
        except ExportModelError:
            raise fault from None
    has_rows = batch is not None and _has_rows(importer, judged)
    fault = _fault(importer, judged, said=True) if has_rows else None
    plain = ModelReading(importer, importer.graph(), importer.types, batch)
    if has_rows and fault is None and not _broken_count(importer, outputs):
        return plain
    try:
        alone = _alone(imported, declared, outputs, axes, ends, leading=batch == 1)
    except ExportModelError:
        if fault is not None:
            raise fault from None
        if has_rows or _broken_count(importer, outputs):
            return plain
        raise
    same = has_rows and fault is None and _broken_count(alone.importer, outputs) == _broken_count(importer, outputs)
    return plain if same else alone


def _without_echoes(
    declared: Sequence[Any], outputs: Sequence[Any], nodes: Sequence[Any]
) -> tuple[Sequence[Any], Sequence[Any]]:
    """Return the inputs and outputs but for those that Identities alone connect, where any others are there."""
    given = {v.name: v.name for v in declared}
    for node in nodes:
        if node.op_type == "Identity" and node.output and given.keys() & {*node.input[:1]}:
            given[node.output[0]] = given[node.input[0]]
    judged = [v for v in outputs if v.name not in given]
    read = {given[name] for n in nodes if n.op_type != "Identity" for name in n.input if name in given}
    echoed = {given[v.name] for v in outputs if v.name in given} - read
    asked = [v for v in declared if v.name not in echoed]
    return (asked, judged) if asked and judged else (declared, outputs)


# ------------------------------------------------------------------ one agent at a time


def _alone(
    imported: Import,
    declared: Sequence[Any],
    outputs: Sequence[Any],
    axes: Mapping[str, int],
    ends: Mapping[str, int],
    *,
    leading: bool,
) -> ModelReading:
    """The model for one agent, computed for each.

    ``leading``: a first axis of 1 is that of the agents. Raises UnsupportedOpError where it cannot be.
    """
    importer = imported(None, True)
    made = _imported_outputs(importer, outputs)
    inputs: dict[str, int | None] = {}
    for value in declared:
        node, axis = importer.values[value.name], axes.get(value.name, 0 if leading else None)
        shape = importer.type_of(node).shape or ()
        if importer.constant_of(node) is None and (shape or (len(declared) == 1 and importer.dtype(node).kind in "iu")):
            inputs[node] = axis if axis is not None and shape[axis : axis + 1] == (1,) else None
    last = {importer.values[name]: axis for name, axis in ends.items() if name in made}
    graph = for_every_row(importer.graph(), [importer.values[name] for name in made], inputs, last)
    unread = [n for n in importer.nodes if n.op == "Placeholder" and n.name not in graph]
    graph = Graph((*graph.nodes, *unread))
    return ModelReading(importer, graph, infer_types(graph), 1, alone=True)


def _imported_outputs(importer: Importer, outputs: Sequence[Any]) -> list[str]:
    return [v.name for v in outputs if v.name in importer.values]


def _broken_count(importer: Importer, outputs: Sequence[Any]) -> int:
    return sum(v.name in importer.broken for v in outputs)


def _has_rows(importer: Importer, outputs: Sequence[Any]) -> bool:
    """Whether any output has the free axis in front."""
    shapes = [importer.type_of(importer.values[name]).shape for name in _imported_outputs(importer, outputs)]
    return any(shape and isinstance(shape[0], str) for shape in shapes)


# ------------------------------------------------------------------ a fixed number of rows


def _fixed_batch(declared: Sequence[Any], axes: Mapping[str, int]) -> int | None:
    """The number of rows that all inputs were exported with, None where an input leaves any length free.

    torch.onnx.export fixes every length that ``dynamic_axes`` does not name; Stable-Baselines3's and rsl_rl's recipes
    name none. ``axes`` are the batch axes of memories; one that is fixed fixes the model, whatever else is left free.
    """
    memories = {dims[axes[v.name]] for v in declared if v.name in axes and (dims := dims_of(v)) is not None}
    if memories:
        return memories.pop() if len(memories) == 1 else None
    shapes = [dims_of(v) for v in declared]
    if any(dims is None or None in dims for dims in shapes):
        return None
    leading = {dims[0] for dims in shapes if dims is not None and len(dims) > 1}
    if not leading:  # a discrete state: one number a row
        numbers = (v for v in declared if DTYPES.get(v.type.tensor_type.elem_type, np.dtype("f4")).kind in "iu")
        leading = {dims[0] for v in numbers if (dims := dims_of(v)) is not None and len(dims) == 1}
    batch = leading.pop() if len(leading) == 1 else None
    return None if batch is None else _bearable(batch, shapes)


def _static(declared: Sequence[Any]) -> bool:
    """Whether every length of every input is fixed, and there is one."""
    shapes = [dims_of(v) for v in declared]
    return any(shapes) and all(dims is not None and None not in dims for dims in shapes)


def _bearable(batch: int, shapes: Sequence[Dims]) -> int:
    """A number of rows, if a run of the model with so many is no more than a runtime can bear."""
    numbers = sum(math.prod(d or 1 for d in dims) for dims in shapes if dims is not None)
    if numbers > _MAX_FED:
        raise NotAPolicyError(
            f"was exported for {batch} rows at a time, which are {numbers} numbers",
            why=f"it can be run with as many only, and no more than {_MAX_FED} are given to a runtime",
            fix="export it with a free batch axis (dynamic_axes), or for one row",
        )
    return batch


def _has_baked_batch(importer: Importer, outputs: Sequence[Any]) -> bool:
    """Whether a model that says it takes any number of rows takes one: a Reshape inside kept the 1 of its export."""
    made = {v.name: importer.type_of(importer.values[v.name]).shape for v in outputs if v.name in importer.values}
    free = [v.name for v in outputs if (dims_of(v) or (0,))[0] is None]
    return any((made.get(name) or (0,))[0] == 1 for name in free)


def dims_of(value: Any) -> Dims:
    """The declared shape; a length of 0 or below, and a named one, is free."""
    kind = value.type.tensor_type
    if not kind.HasField("shape"):
        return None
    return tuple(int(d.dim_value) if d.HasField("dim_value") and d.dim_value > 0 else None for d in kind.shape.dim)


# ------------------------------------------------------------------ tried with several rows


def _fault(importer: Importer, outputs: Sequence[Any], *, said: bool = False) -> SignatureError | None:
    """The error that names the first output which is wrong for more rows than one, or the first draw that rows share.

    ``said``: the file says that it takes one row, so that one too large to be tried is believed. Else SignatureError is
    raised for it.
    """
    if too_large(importer.graph()):
        if said:
            return None
        raise SignatureError(
            "the model was exported for one row, and is too large to be tried with more",
            why=f"its tensors hold more than {MAX_COMPUTED} numbers for {ROWS} rows",
            fix="export it again with the batch left free everywhere",
        )
    try:
        check_rows(importer.graph(), [importer.values[name] for name in _imported_outputs(importer, outputs)])
    except SignatureError as error:
        return error
    return None
