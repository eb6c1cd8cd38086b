"""A ``.nn`` as a graph in the TensorFlow vocabulary, with the names that ML-Agents' TensorFlow graphs have.

Inputs and outputs keep their names, constants are Const nodes called like their dataset, and the memories are joined in
file order to ``recurrent_in`` [B, ΣM] and ``recurrent_out`` (the file's own ``recurrent_out`` is but a copy of the cell
state). ``Node.origin`` is the layer's or memory's name in the file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from functools import partial

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.formats.barracuda.format import (
    EIGHT_AXES,
    Layer,
    NnInput,
    NnModel,
    draws_in_model,
    four_axes,
)
from export_model.converters.formats.barracuda.layer_builder import MAX_NN_ELEMENTS, LayerBuilder, NnValue, node_name
from export_model.converters.formats.barracuda.layers import check_bypassed, translate
from export_model.converters.formats.barracuda.slices import upstream
from export_model.converters.graph.nodes import Graph, NameScope, joined_name
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType
from export_model.converters.graph.types import FLOAT32, INT32, INT64
from export_model.signatures.errors import DamagedFileError, ExportModelError, SignatureError
from export_model.signatures.roles import ACTION_NAMES, ACTION_SHAPE, OUTPUT_NAMES, VERSION_NUMBER, Role

MEMORY_IN, MEMORY_OUT = "recurrent_in", "recurrent_out"
_INTEGER_INPUTS = ("prev_action",)
_CLASSES = ("discrete_actions", "deterministic_discrete_actions")
_INTEGER_ROLES = (Role.ACTION, Role.DETERMINISTIC)


class GraphReading(Struct, frozen=True):
    """The graph of a file, and what was noticed on the way."""

    graph: Graph
    notes: tuple[str, ...]


def to_graph(model: NnModel) -> GraphReading:
    """Translate a parsed file.

    Raises UnsupportedOpError or GraphError for a layer that the policy's outputs depend on; one that they do not
    depend on is left out with what reads it. Raises DamagedFileError where the layers do not fit together.
    """
    return _Reader(model).read()


class _Reader:
    def __init__(self, model: NnModel) -> None:
        self.model = model
        self.layers = _by_name(model)
        names = NameScope((MEMORY_IN, MEMORY_OUT) if model.memories else ())
        #: name in the file → node
        self.nodes: dict[str, str] = {}
        for name in _names(model):
            self.nodes[name] = names.fresh(node_name(name))
        reserved = [*self.nodes.values(), MEMORY_IN, MEMORY_OUT]
        self.builder = LayerBuilder(reserved, model.version)
        self.values: dict[str, NnValue] = {}
        #: what could not be translated, and is read by nothing that is needed so far
        self.failed: dict[str, ExportModelError] = {}
        self.needed = _upstream(model, self.layers)
        self.draws = draws_in_model(model.number(VERSION_NUMBER) or 0)

    def read(self) -> GraphReading:
        memories = {m.input for m in self.model.memories}
        for given in self.model.inputs:
            if given.name not in memories:
                self._attempt(given.name, partial(self._input, given))
        self._memory_in()
        for layer in self.model.layers:
            if layer.type == LayerType.LOAD:
                self._load(layer)
            else:
                self._attempt(layer.name, partial(self._layer, layer))
        self._memory_out()
        self._check_action()
        return GraphReading(self.builder.graph(), tuple(self.builder.notes))

    def _attempt(self, name: str, make: Callable[[], NnValue]) -> None:
        """Make a tensor; an error counts at once only if the policy depends on it."""
        try:
            self.values[name] = make()
        except ExportModelError as error:
            if name in self.needed:
                raise
            self.failed[name] = error

    def _check_action(self) -> None:
        """Raise DamagedFileError where the action is not as wide as the file says that it is.

        The converter of some 0.7 previews bypassed slices: every branch then holds the numbers of all branches. Where
        they could be put back (``slices.py``), it is.
        """
        wanted, action = self.model.number(ACTION_SHAPE), self.values.get("action")
        if not self.model.from_python or wanted is None or action is None or action.size == wanted:
            return
        raise DamagedFileError(
            f"'action' has {action.size} numbers, and the file's own action_output_shape says {wanted:g}",
            why="the converter of a preview of ML-Agents 0.7 left out the slices that cut the action into branches, so "
            "this .nn computes something else than was trained, in Unity too",
            fix="export the frozen_graph_def.pb from the same run",
        )

    # ------------------------------------------------------------------ inputs

    def _input(self, given: NnInput) -> NnValue:
        _, h, w, c = four_axes(given.shape, f"input {given.name!r}")
        if min(h, w, c) < 1:
            raise SignatureError(
                f"input {given.name!r} has the shape {list(given.shape)}",
                why="the file does not say how long it is",
                fix="export the frozen_graph_def.pb from the same run",
            )
        self.builder.start(Layer(given.name, LayerType.NOP), self.nodes[given.name])
        self.builder.check_size(h, w, c)
        shape = (None, h, w, c)
        name = self.nodes[given.name]
        sensor = (self.draws or self.model.version >= EIGHT_AXES) and re.fullmatch(r"obs_\d+", given.name)
        if sensor and h == 1 < w:
            return self._entities(given, w, c)
        integer = given.name in _INTEGER_INPUTS
        state = self.draws and given.name == MEMORY_IN
        dims = (None, 1, w) if state else (None, c) if (h, w) == (1, 1) else shape
        self.builder.named_input(name, INT32 if integer else FLOAT32, dims, given.name)
        if state:
            return self.builder.as_shape(name, shape)
        if not integer:
            return NnValue(name, shape)
        return NnValue(self.builder.add("Cast", [name], name="float", DstT=FLOAT32), shape, integer=name)

    def _entities(self, given: NnInput, count: int, size: int) -> NnValue:
        """A sensor of rank 2: [N, 1, W, C] in Unity, whose first dimension is C and second W; [B, C, W] here."""
        b, name = self.builder, self.nodes[given.name]
        b.named_input(name, FLOAT32, (None, size, count), given.name)
        turned = b.add("Transpose", [name, b.ints([0, 2, 1], "order")])
        return b.as_shape(turned, (None, 1, count, size))

    # ------------------------------------------------------------------ memories

    def _memory_in(self) -> None:
        memories = self.model.memories
        if not memories:
            return
        shapes = [four_axes(m.shape, f"memory {m.input!r}")[1:] for m in memories]
        sizes = [math.prod(s) for s in shapes]
        if min(min(s) for s in shapes) < 1 or sum(sizes) > MAX_NN_ELEMENTS:
            raise DamagedFileError(
                f"the memories have {sizes} elements",
                why=f"a memory has at least one, and all together have at most {MAX_NN_ELEMENTS}",
                fix="copy or download the .nn again",
            )
        self.builder.named_input(MEMORY_IN, FLOAT32, (None, sum(sizes)), joined_name([m.input for m in memories]))
        start = 0
        for memory, (h, w, c), size in zip(memories, shapes, sizes, strict=True):
            part, name = MEMORY_IN, self.nodes[memory.input]
            if len(memories) > 1:
                begun = self.builder.start(Layer(memory.input, LayerType.NOP), name)
                part = self.builder.slice(MEMORY_IN, 1, start, start + size)
                part = self.builder.finish(part, begun, name, memory.input)
            start += size
            value = NnValue(part, (None, 1, 1, size))
            self.values[memory.input] = value if (h, w) == (1, 1) else self.builder.as_shape(part, (None, h, w, c))

    def _memory_out(self) -> None:
        memories = self.model.memories
        if not memories:
            return
        b = self.builder
        begun = b.start(Layer(MEMORY_OUT, LayerType.CONCAT), MEMORY_OUT)
        parts = []
        for memory in memories:
            value = self._value(memory.output, f"memory {memory.input!r}")
            if value.size != self.values[memory.input].size or value.shape[0] is not None:
                raise DamagedFileError(
                    f"memory {memory.input!r} is fed {self.values[memory.input].size} numbers a row",
                    why=f"{memory.output!r} gives the shape {list(value.shape)}",
                    fix="convert the model again",
                )
            parts.append(b.as_matrix(value))
        joined = parts[0] if len(parts) == 1 else b.add("ConcatV2", [*parts, b.ints(1, "axis")])
        b.finish(joined, begun, MEMORY_OUT, joined_name([m.output for m in memories]))

    # ------------------------------------------------------------------ layers

    def _value(self, name: str, reader: str) -> NnValue:
        if name in self.failed:
            raise self.failed[name]
        if name not in self.values:
            raise DamagedFileError(
                f"{reader} reads {name!r}, which must be an input or made by a layer before it",
                why="the layers of a .nn must be in the order in which they run",
                fix="convert the model again: the frozen_graph_def.pb beside the .nn is exported in its place",
            )
        return self.values[name]

    def _load(self, layer: Layer) -> None:
        """Each dataset is a constant of its own name; a single one has the layer's name too."""
        for dataset in layer.datasets:
            if dataset.name not in self.values:
                array = self.model.array(dataset)
                self.values[dataset.name] = self.builder.dataset(dataset.name, array, self.nodes[dataset.name])
            if len(layer.datasets) == 1:
                self.values[layer.name] = self.values[dataset.name]

    def _layer(self, layer: Layer) -> NnValue:
        b, name = self.builder, self.nodes[layer.name]
        if self.model.from_python:
            check_bypassed(layer)
        b.start(layer, name)
        args = [self._value(i, b.location) for i in layer.inputs]
        args += [b.dataset(d.name, self.model.array(d)) for d in layer.datasets]
        begun = b.start(layer, name)
        result = translate(b, layer, args)
        if self.draws and layer.name in _CLASSES and result.integer is None:
            result = replace(result, integer=b.add("Cast", [b.as_matrix(result)], name="classes", DstT=INT64))
        if self.draws and layer.name == MEMORY_OUT:
            rows = b.add("Reshape", [result.reference, b.ints([-1, 1, result.size], "rows")])
            return replace(result, reference=b.finish(rows, begun, name, layer.name))
        if result.integer is not None and OUTPUT_NAMES.get(layer.name) in _INTEGER_ROLES:
            # An action that was drawn: Unity makes floats of the classes, a policy gives integers.
            return replace(result, integer=b.finish(result.integer, begun, name, layer.name))
        return replace(result, reference=b.finish(result.reference, begun, name, layer.name))


def _by_name(model: NnModel) -> dict[str, Layer]:
    """Layers by name; raises DamagedFileError where two have one name."""
    found: dict[str, Layer] = {}
    for layer in model.layers:
        if layer.name in found:
            raise DamagedFileError(
                f"two layers are called {layer.name!r}",
                why="the converters of ML-Agents 0.7 and 0.8 write that for a model with two LSTMs, whose weights they "
                "mix up as well",
                fix="export the frozen_graph_def.pb from the same run",
            )
        found[layer.name] = layer
    return found


def _names(model: NnModel) -> list[str]:
    """Everything in the file that gets a node of its own name, the outputs first."""
    layers = [layer.name for layer in model.layers if layer.type != LayerType.LOAD]
    loaded = [d.name for layer in model.layers if layer.type == LayerType.LOAD for d in layer.datasets]
    known = [name for name in layers if name in OUTPUT_NAMES]
    inputs = [*(i.name for i in model.inputs), *(m.input for m in model.memories)]
    return list(dict.fromkeys((*known, *inputs, *loaded, *layers)))


def _upstream(model: NnModel, layers: Mapping[str, Layer]) -> set[str]:
    """What the policy depends on: upstream of its action, other known outputs and memories.

    Where nothing is called like an action, everything that the file calls an output counts.
    """
    roots = [name for name in layers if name in OUTPUT_NAMES]
    if not any(name in ACTION_NAMES for name in roots):
        roots = list(model.outputs)
    if model.memories:
        roots = [name for name in roots if name != MEMORY_OUT]
    return upstream([*roots, *(m.output for m in model.memories)], layers)
