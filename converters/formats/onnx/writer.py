"""Policy to ONNX: each node through its lowering in the op table.

Canonical names for inputs and outputs, the batch axis symbolic, the contract in ``metadata_props``, checked by
``onnx.checker`` with full shape inference before anything is written, unless nothing is to be verified. Values are
called as the tensors of the graph that they are; where that cannot be, ``metadata_props`` says so
(converters/formats/onnx/tensor_map.py), so that verification can point at a tensor inside.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.compiler.passes.weights import Storage, compact
from export_model.converters.compiler.targets import ONNX, consumer_onnx, prepare
from export_model.converters.files.chunks import Pieces, equal
from export_model.converters.files.external_data import LARGE, Detached
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.intermediate_tensors import View
from export_model.converters.formats.onnx import messages
from export_model.converters.formats.onnx.artifact import stated_metadata
from export_model.converters.formats.onnx.messages import files_of
from export_model.converters.formats.onnx.peephole import pooled_first, simplify_nodes
from export_model.converters.formats.onnx.tensor_map import TENSORS_KEY, TensorMap
from export_model.converters.graph.nodes import Graph, NameScope, Node, ref
from export_model.converters.graph.ops.table import op_of, unsupported_error
from export_model.converters.graph.shapes import Types, infer_types
from export_model.converters.graph.types import FLOAT32, TensorType
from export_model.converters.policy.policy import Policy
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.errors import GraphError, UsageError
from export_model.signatures.spec import TensorSpec

#: Opset → the IR version of the same ONNX release (onnx/helper.py, OP_SET_ID_VERSION_MAP).
IR_VERSIONS = {11: 6, 12: 7, 13: 7, 14: 7, 15: 8, 16: 8, 17: 8, 18: 8, 19: 9, 20: 9, 21: 10}
#: What people may ask for; profiles of old importers ask for less.
ASKED_FOR = range(13, 22)
#: What works element by element, so that a Transpose may as well come behind it.
_ELEMENTWISE = frozenset(
    (
        *("Abs", "Add", "Div", "Elu", "Exp", "LeakyRelu", "Max", "Min"),
        *("Mul", "Neg", "Relu", "Selu", "Sigmoid", "Sub", "Tanh"),
    )
)
PRODUCER = "export-model"


class _Builder:
    """Nodes and initializers of a model in the making (implements ``OnnxBuilder`` of converters/graph/ops/base.py)."""

    def __init__(self, graph: Graph, opset: int, outputs: Collection[str]) -> None:
        self.opset = opset
        self._transposed: dict[str, tuple[str, tuple[int, ...]]] = {}
        self._scalars: set[str] = set()
        self.types: Types = infer_types(graph)
        self._graph = graph
        self.outputs = frozenset(outputs)
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []
        self.turned: dict[str, View] = {}
        self._values: dict[str, str] = {}
        self._constants: dict[tuple[Any, ...], list[tuple[np.ndarray, str]]] = {}
        self.detached = Detached.of(graph.values())
        self._names = NameScope(())
        self._prefix = ""

    def value(self, reference: str) -> str:
        return self._values[reference]

    def type_of(self, reference: str) -> TensorType:
        return self.types[reference]

    def producer(self, reference: str) -> Node:
        return self._graph.producer(reference)

    def holds(self, value: str, reference: str, axes: Sequence[int]) -> None:
        self.turned[reference] = View(value, tuple(axes))

    def bind(self, reference: str, value: str) -> None:
        """Let ``value`` stand for a tensor of the graph."""
        self._values[reference] = value
        self._names.take(value)

    def fresh(self, wish: str) -> str:
        return self._names.fresh(wish)

    def emit(self, op: str, inputs: Sequence[str], **attributes: Any) -> str:
        sunk = self._sunk(op, inputs, attributes)
        if sunk:
            return sunk
        (name,) = self.emit_several(op, inputs, 1, **attributes)
        if op == "Transpose":
            self._transposed[name] = (inputs[0], tuple(attributes["perm"]))
        return name

    def emit_several(self, op: str, inputs: Sequence[str], outputs: int, **attributes: Any) -> tuple[str, ...]:
        names = [self.fresh(f"{self._prefix}/{op}" if self._prefix else op) for _ in range(outputs)]
        self.nodes.append(messages.node(op, inputs, names, names[0], **attributes))
        return tuple(names)

    def _sunk(self, op: str, inputs: Sequence[str], attributes: Mapping[str, Any]) -> str:
        """A node behind the transposes in front of it, which sink below it; empty where that is not to be done.

        Two that undo each other are none. Between the convolutions of a policy none is left; old importers lose their
        way in them.
        """
        turned = [self._transposed[i] for i in inputs if i in self._transposed]
        if op == "Transpose" and turned:
            source, first = turned[0]
            order = [first[axis] for axis in attributes["perm"]]
            return source if order == sorted(order) else ""
        if op not in _ELEMENTWISE or not turned or len({order for _, order in turned}) > 1:
            return ""
        if any(i not in self._transposed and i not in self._scalars for i in inputs):
            return ""
        moved = self.emit(op, [self._transposed[i][0] if i in self._transposed else i for i in inputs], **attributes)
        return self.emit("Transpose", [moved], perm=list(turned[0][1]))

    def const(self, array: np.ndarray, hint: str = "const") -> str:
        # Of a large one the first numbers tell it from nearly all others.
        beginning = array if array.nbytes < LARGE else array[(0,) * (array.ndim - 1)][:16]
        alike = self._constants.setdefault((array.dtype.str, array.shape, beginning.tobytes()), [])
        for known, name in alike:
            if array.nbytes < LARGE or equal(known, array):
                return name
        name = self.fresh("/".join(part for part in (self._prefix, hint) if part))
        alike.append((array, name))
        if array.size == 1 and array.ndim < 2:
            self._scalars.add(name)
        self.initializers.append(self._tensor(array, name))
        return name

    def _tensor(self, array: np.ndarray, name: str) -> Any:
        raw = self.detached.mark(array) if self.detached.takes(array) else None
        return messages.tensor(array if raw else np.asarray(array, order="C"), name, raw)

    def begin(self, prefix: str) -> None:
        """Let the names of what is made from here on begin with ``prefix``."""
        self._prefix = prefix

    def prune(self, wanted: Collection[str]) -> None:
        """Take out nodes that nothing reads (the pieces of a Split that are not used, a Shape for its dtype alone)."""
        needed, kept = set(wanted), []
        for node in reversed(self.nodes):
            if needed.intersection(node.output):
                needed.update(node.input)
                kept.append(node)
        self.nodes = kept[::-1]

    def shorten(self, wanted: Collection[str]) -> None:
        """One node for two, where ONNX has one."""
        constants = {name: array for alike in self._constants.values() for array, name in alike}
        ranks = {self._values.get(r, r): len(t.shape) for r, t in self.types.items() if t.shape is not None}
        self.nodes = pooled_first(simplify_nodes(self.nodes, constants, ranks, wanted), wanted, self.fresh)

    def store(self, storage: Storage) -> None:
        """Keep initializers in fewer bytes where each of their numbers comes back as it was."""
        arrays = {name: array for alike in self._constants.values() for array, name in alike}
        initializers, widened = [], []
        for initializer in self.initializers:
            name = initializer.name
            found = compact(arrays[name], storage)
            if found is None:
                initializers.append(initializer)
                continue
            narrow, step = found
            small, wide = self.fresh(f"{name}/{storage}"), name if step is None else self.fresh(f"{name}/steps")
            initializers.append(self._tensor(narrow, small))
            widened.append(messages.node("Cast", [small], [wide], wide, to=FLOAT32))
            if step is not None:
                scale = self.fresh(f"{name}/step")
                initializers.append(self._tensor(step, scale))
                widened.append(messages.node("Mul", [wide, scale], [name], name))
        self.initializers, self.nodes = initializers, [*widened, *self.nodes]

    def lower(self, node: Node) -> None:
        """Append what a node of the graph becomes, its result under the node's own name."""
        self.begin(node.name)
        if node.op == "Const":
            assert node.value is not None
            # An initializer that is an output is no valid model: that one gets another name, and an Identity.
            self.bind(node.name, self.const(node.value, "value" if node.name in self.outputs else ""))
            return
        entry = op_of(node)
        if entry.onnx is None:
            raise unsupported_error([node])
        before = len(self.nodes)
        result = entry.onnx(node, self)
        made = {name for n in self.nodes[before:] for name in n.output}
        renamed: dict[str, str] = {}
        for index, value in enumerate(result if isinstance(result, tuple) else (result,)):
            reference = ref(node.name, index)
            if value in made and value not in renamed and reference not in self._names:
                renamed[value] = reference
                self._names.release(value)
            self.bind(reference, renamed.get(value, value))
        self._rename(before, renamed)
        for index, value in enumerate(result if isinstance(result, tuple) else (result,)):
            if (turned := self._transposed.get(renamed.get(value, value))) is not None:
                source, order = turned
                back = tuple(sorted(range(len(order)), key=order.__getitem__))
                self.turned.setdefault(ref(node.name, index), View(source, back))

    def give(self, output: str) -> None:
        """Let an output be made: what is an input, a constant or another output as well is so by a node of its own.

        The Inference Engine (2.4.0) does not import an Identity of an output that a Reshape makes: that is made again.
        """
        value = self.value(output)
        if value == output:
            return
        maker = next((n for n in self.nodes if value in n.output), None)
        inputs = list(maker.input) if maker is not None and maker.op_type == "Reshape" else [value]
        self.nodes.append(messages.node("Reshape" if len(inputs) == 2 else "Identity", inputs, [output]))

    def _rename(self, start: int, renamed: Mapping[str, str]) -> None:
        """Call the results of the nodes from ``start`` on otherwise."""
        for node in self.nodes[start:]:
            if node.op_type == "Transpose" and (turned := self._transposed.pop(node.output[0], None)) is not None:
                source, order = turned
                value = renamed.get(node.output[0], node.output[0])
                self._transposed[value] = (renamed.get(source, source), order)
            for names in (node.input, node.output):
                for i, name in enumerate(names):
                    if name in renamed:
                        names[i] = renamed[name]
            node.name = renamed.get(node.name, node.name)

    def tensors(self, graph: Graph, present: Collection[str]) -> TensorMap:
        """What of ``graph``, as it was before anything was fused, is in the model under another name or not at all."""
        views: dict[str, View | None] = {}
        references = dict.fromkeys([*(n.name for n in graph.nodes), *(r for n in graph.nodes for r in n.inputs)])
        for reference in references:
            value = self._values.get(reference)
            if value is not None and value in present:
                if value != reference:
                    views[reference] = View(value)
            elif self.turned.get(reference, View("")).name in present:
                views[reference] = self.turned[reference]
            elif reference in present:
                views[reference] = None
        sources = {
            n.name: n.origin
            for n in graph.nodes
            if isinstance(n.origin, str) and n.origin not in (n.name, f"{n.name}:0")
        }
        return TensorMap(views, sources)


def _value_info(spec: TensorSpec, batch: int | None) -> Any:
    dims = [
        (batch or "batch" if i == 0 else f"{spec.name}_dim_{i}") if size is None else size
        for i, size in enumerate(spec.shape)
    ]
    return messages.value_info(spec.name, np.dtype(spec.dtype), dims)


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The ONNX artefact.

    Raises UsageError on an opset outside 13–21, UnsupportedOpError on ops without a lowering, GraphError when the
    checker refuses the result (a fault of this tool).
    """
    if options.opset not in (IR_VERSIONS if options.profile else ASKED_FOR):
        raise UsageError(
            f"opset {options.opset} is not written",
            why=f"the lowerings are made for opsets {min(ASKED_FOR)} to {max(ASKED_FOR)}",
            fix="leave --opset out: 15 is what onnxruntime, onnxruntime-web and Unity take",
        )
    graph = prepare(policy, consumer_onnx(options.misread) if options.profile else ONNX)
    builder = _Builder(graph, options.opset, [s.name for s in policy.signature.outputs])
    for spec in policy.signature.inputs:
        builder.bind(spec.name, spec.name)
    for node in graph.nodes:
        if node.op != "Placeholder":
            builder.lower(node)
    for spec in policy.signature.outputs:
        builder.give(spec.name)
    builder.begin("")
    for name, value in policy.constants.items():
        source = builder.const(value, f"{name}/value")
        builder.nodes.append(messages.node("Identity", [source], [name]))
    wanted = [*(s.name for s in policy.signature.outputs), *policy.constants]
    builder.prune(wanted)
    if options.profile is None:
        builder.shorten(wanted)
    if options.weights != "float32":
        builder.store(options.weights)
        builder.prune(wanted)
    used = {name for node in builder.nodes for name in node.input}
    present = used.union(*(node.output for node in builder.nodes), (s.name for s in policy.signature.inputs))
    tensors = builder.tensors(policy.graph, present).dumps()
    model = messages.model(
        policy.name,
        builder.nodes,
        [i for i in builder.initializers if i.name in used],
        [_value_info(s, options.batch) for s in policy.signature.inputs],
        [
            *(_value_info(s, options.batch) for s in policy.signature.outputs),
            *(messages.value_info(name, value.dtype, value.shape) for name, value in policy.constants.items()),
        ],
        producer=PRODUCER,
        ir_version=IR_VERSIONS[options.opset],
        opset=options.opset,
        props={
            **stated_metadata(policy.signature),
            EMBEDDED: options.contract,
            **({TENSORS_KEY: tensors} if tensors else {}),
        },
    )
    if options.checked:
        _check(model, builder.detached, policy.name)
    return files_of(model, builder.detached, f"{policy.name}.onnx")


def _check(model: Any, detached: Detached, name: str) -> None:
    """Raise GraphError where the checker refuses a model; weights that are detached are inputs for it."""
    import onnx.checker
    import onnx.shape_inference

    plain = type(model)()
    plain.CopyFrom(model)
    del plain.graph.initializer[:]
    for tensor in model.graph.initializer:
        array = detached.array(tensor.raw_data)
        if array is None:
            plain.graph.initializer.append(tensor)
        else:
            plain.graph.input.append(messages.value_info(tensor.name, array.dtype, tensor.dims))
    try:
        onnx.checker.check_model(plain.SerializeToString(), full_check=True)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError) as error:
        raise GraphError(
            f"the ONNX model made of {name!r} is not valid",
            why=str(error).strip().splitlines()[0],
            fix="this is a fault of export-model; please open an issue with the source",
        ) from error
