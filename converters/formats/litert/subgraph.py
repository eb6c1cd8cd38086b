"""The operators and tensors of a LiteRT model in the making."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.passes.weights import compact
from export_model.converters.files.chunks import equal
from export_model.converters.files.external_data import LARGE
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.intermediate_tensors import View
from export_model.converters.formats.litert.flatbuffer import Table
from export_model.converters.formats.litert.schema import ACTIVATIONS, BUILTINS, OPTIONS, PADDINGS, TABLES, TYPES
from export_model.converters.formats.litert.tensors import UNNAMED
from export_model.converters.graph.nodes import Graph, NameScope, Node, ref
from export_model.converters.graph.ops.litert.base import NONE, Value, emit_reshape, litert_error
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import BATCH, INT32, INT64, TensorType, of_array
from export_model.signatures.spec import TensorSpec


class Shared:
    """What all subgraphs of a model have in common: the bytes of constants, the list of operators."""

    def __init__(self) -> None:
        #: the first is empty: the buffer of what is computed
        self.buffers: list[Table] = [{}]
        self.operators: dict[tuple[str, int], int] = {}
        #: whether a subgraph has left out what was to be read
        self.left_out = False
        self._known: dict[tuple[Any, ...], list[tuple[np.ndarray, int]]] = {}

    def buffer(self, array: np.ndarray) -> int:
        """The number of the buffer that holds an array; of what has no bytes there is none."""
        if not array.size:
            return 0
        beginning = array if array.nbytes < LARGE else array[(0,) * (array.ndim - 1)][:16]
        alike = self._known.setdefault((array.dtype.str, array.shape, beginning.tobytes()), [])
        for known, number in alike:
            if array.nbytes < LARGE or equal(known, array):
                return number
        alike.append((array, len(self.buffers)))
        self.buffers.append({"data": array})
        return len(self.buffers) - 1

    def text(self, text: str) -> int:
        """The number of a buffer that holds a text."""
        self.buffers.append({"data": text.encode()})
        return len(self.buffers) - 1

    def drop_unread(self, tensors: Iterable[Table]) -> None:
        """Leave out the buffers of no tensor, and tell the tensors the others' new numbers."""
        tensors = list(tensors)
        used = list(dict.fromkeys((0, *(tensor["buffer"] for tensor in tensors))))
        if not self.left_out:
            return
        numbers = {old: new for new, old in enumerate(used)}
        self.buffers = [self.buffers[number] for number in used]
        for tensor in tensors:
            tensor["buffer"] = numbers[tensor["buffer"]]

    def operator(self, name: str, version: int) -> int:
        """The number of an operator in a version."""
        return self.operators.setdefault((name, version), len(self.operators))

    def codes(self) -> list[Table]:
        """The list of operators; a reader from before 2.4 has the numbers up to 127 alone, in a field of their own."""
        rows = ((BUILTINS[name].code, version) for name, version in self.operators)
        return [{"deprecated_builtin_code": min(c, 127), "builtin_code": c, "version": v} for c, v in rows]


class Subgraph:
    """One function of a model (implements ``LitertBuilder`` of converters/graph/ops/litert/base.py)."""

    def __init__(self, graph: Graph, outputs: Iterable[str], shared: Shared, options: WriteOptions) -> None:
        self.graph, self.shared, self.storage, self.batch = graph, shared, options.weights, options.batch
        self.types = infer_types(graph)
        self.tensors: list[Table] = []
        self.operators: list[Table] = []
        self.kinds: list[TensorType] = []
        #: constants that have their axes in another order
        self.turned: dict[str, View] = {}
        self.result = TensorType(np.dtype(np.float32), None)
        self._values: dict[str, Value] = {}
        self._constants: dict[tuple[int, str, tuple[int, ...]], Value] = {}
        self._made: dict[Value, Table] = {}
        #: result of a RESHAPE → what it shows; and what stands for such results, too, so that it stays as it is
        self._shown: dict[Value, Value] = {}
        self._kept: set[Value] = set()
        self._names = NameScope(())
        self._node = Node("", "")
        wanted = list(outputs)
        self._outputs = frozenset(wanted)
        self._reads = Counter([*wanted, *(r for n in graph.nodes for r in n.inputs)])

    def value(self, reference: str) -> Value:
        """The tensor that stands for one of the graph."""
        if reference not in self._values:  # a constant is put in for who reads it
            node = self.graph.producer(reference)
            assert node.value is not None
            self._bound(reference, self.const(np.asarray(node.value)))
        return self._values[reference]

    def type_of(self, reference: str) -> TensorType:
        """What is known of a tensor of the graph."""
        return self.types[reference]

    def emit(self, op: str, inputs: Sequence[Value], of: TensorType | None = None, **options: Any) -> Value:
        """An operator more; returns its result. A shape of what has another shape is one of what that shows."""
        kind = self.result if of is None else of
        known = self._shown.get(inputs[0]) if op == "RESHAPE" else None
        if known is not None and _is_same_shape(self.kinds[known], kind):
            self._kept.add(known)
            return known
        (value,) = self.emit_several(op, inputs if known is None else [known, *inputs[1:]], [kind], **options)
        if op == "RESHAPE":
            self._shown[value] = inputs[0] if known is None else known
        return value

    def drop_unread(self, given: Sequence[Value], fed: Sequence[Value]) -> dict[Value, Value]:
        """Leave out the shapes that nothing reads, and tensors of nothing; returns the others' new numbers."""
        read = {v for o in self.operators for v in o["inputs"]} | set(given)
        gone = {id(o) for v, o in self._made.items() if v in self._shown and v not in read}
        self.operators = [o for o in self.operators if id(o) not in gone]
        read_by_each = (v for o in self.operators for v in (*sorted(o["inputs"]), *o["outputs"]))
        used = dict.fromkeys((*fed, *read_by_each, *given))
        if not gone:
            return {value: value for value in used}
        self.shared.left_out = True
        numbers = {old: new for new, old in enumerate(v for v in used if v != NONE)}
        self.tensors = [self.tensors[v] for v in numbers]
        for entry in self.operators:
            for side in ("inputs", "outputs"):
                entry[side] = [numbers.get(v, v) for v in entry[side]]
        return numbers

    def emit_several(
        self, op: str, inputs: Sequence[Value], of: Sequence[TensorType], **options: Any
    ) -> tuple[Value, ...]:
        """An operator more; returns its results, of the types ``of``."""
        values = tuple(self._tensor(kind) for kind in of)
        entry = {"opcode_index": self._version(op, inputs, options), "inputs": list(inputs), "outputs": list(values)}
        told = BUILTINS[op].options
        if told:
            entry |= {"builtin_options_type": OPTIONS[told], "builtin_options": _encode_options(options)}
        self.operators.append({k: v for k, v in entry.items() if v != 0})
        self._made.update(dict.fromkeys(values, self.operators[-1]))
        return values

    def _version(self, op: str, inputs: Sequence[Value], options: dict[str, Any]) -> int:
        builtin = BUILTINS[op]
        kinds = [self.kinds[value] for value in inputs if value != NONE]
        dtype = kinds[builtin.operand].dtype
        alike = len({k.shape for k in kinds}) == 1 and len(kinds) > 1
        axes = 0 if alike else max((k.rank or 0 for k in kinds), default=0)
        version = builtin.version(TYPES[dtype][1], axes) if dtype in TYPES else None
        if version is None:
            wide = f" that is broadcast over {axes} axes" if axes > 4 else ""
            raise litert_error(self._node, f"its {op} does not take {dtype}{wide}")
        if op == "DEPTHWISE_CONV_2D" and (options["dilation_h_factor"], options["dilation_w_factor"]) != (1, 1):
            version = 2
        return self.shared.operator(op, version)

    def const(self, array: np.ndarray, holds: str = "", axes: Sequence[int] = (), *, own: bool = False) -> Value:
        """A constant; equal ones are one tensor, unless it is to be its ``own``."""
        if own:
            return self._tensor(of_array(array), self.shared.buffer(array))
        found = None if self.storage == "float32" else compact(array, self.storage)
        value = self._stored(array) if found is None else self._widened(array, *found)
        if holds and not UNNAMED.fullmatch(holds):
            if "name" not in self.tensors[value]:
                self.tensors[value]["name"] = self._names.fresh(holds)
            self.turned[holds] = View(self.tensors[value]["name"], tuple(axes))
        return value

    def _stored(self, array: np.ndarray) -> Value:
        buffer = self.shared.buffer(array)
        key = (buffer, array.dtype.str, array.shape)
        if key not in self._constants:
            self._constants[key] = self._tensor(of_array(array), buffer)
        return self._constants[key]

    def _widened(self, array: np.ndarray, narrow: np.ndarray, step: np.ndarray | None) -> Value:
        """A constant that is kept in fewer bytes: float16, or int8 with the length of a step for each channel."""
        key = (self.shared.buffer(narrow), "" if step is None else str(step.tobytes()), array.shape)
        if key not in self._constants:
            small = self._tensor(of_array(narrow), key[0])
            if step is not None:
                axis = max(range(step.ndim), key=step.shape.__getitem__)
                zeros = np.zeros(step.size, np.int64)
                scales = {"scale": step.reshape(-1), "zero_point": zeros, "quantized_dimension": axis}
                self.tensors[small]["quantization"] = scales
            self._constants[key] = self.emit("DEQUANTIZE", [small], TensorType(array.dtype, array.shape))
        return self._constants[key]

    def _tensor(self, kind: TensorType, buffer: int = 0) -> Value:
        if kind.dtype not in TYPES:
            raise litert_error(self._node, f"LiteRT has no {kind.dtype}")
        if self.batch is not None and kind.shape is not None:
            kind = replace(kind, shape=tuple(self.batch if d == BATCH else d for d in kind.shape))
        entry: Table = {"type": TYPES[kind.dtype][0], "buffer": buffer}
        if kind.shape is not None:
            entry["has_rank"] = True
            if kind.shape:
                entry["shape"] = [d if isinstance(d, int) else 1 for d in kind.shape]
            if any(isinstance(d, str) for d in kind.shape):
                entry["shape_signature"] = [d if isinstance(d, int) else -1 for d in kind.shape]
        self.tensors.append(entry)
        self.kinds.append(kind)
        return len(self.tensors) - 1

    def activated(self, reference: str, function: str) -> Value | None:
        """A tensor whose operator now applies ``function``; None where it cannot, or its own result is read."""
        value = self.value(reference)
        made = self._made.get(value)
        if self._reads[reference] != 1 or reference in self._outputs or made is None or made["outputs"] != [value]:
            return None
        if value in self._kept:
            return None
        name = next(n for (n, _), i in self.shared.operators.items() if i == made.get("opcode_index", 0))
        told = {f.name for f in TABLES[BUILTINS[name].options]} if BUILTINS[name].options else set()
        # CONCATENATION has the field, and a kernel that takes none (concatenation.cc)
        if "activation" not in told or name == "CONCATENATION" or made["builtin_options"].get("activation"):
            return None
        made["builtin_options"]["activation"] = ACTIVATIONS[function]
        self.tensors[value].pop("name", None)
        return value

    def input(self, spec: TensorSpec, reference: str) -> Value:
        """A tensor that is fed."""
        self._node = self.graph.producer(reference)
        dims = tuple((f"?{i}" if i else BATCH) if d is None else d for i, d in enumerate(spec.shape))
        return self._bound(reference, self._tensor(TensorType(np.dtype(spec.dtype), dims)))

    def lower(self, node: Node) -> None:
        """Append what a node of the graph becomes, its result under the node's own name."""
        self._node = node
        if node.name in self._values or node.value is not None:
            return
        entry = op_of(node)
        if entry.litert is None:
            raise litert_error(node, "LiteRT has no operator that computes it")
        self.result = self.types[node.name]
        found = entry.litert(node, self)
        for index, value in enumerate(found if isinstance(found, tuple) else (found,)):
            self._bound(ref(node.name, index), value)

    def _bound(self, reference: str, value: Value) -> Value:
        self._values[reference] = value
        if "name" not in self.tensors[value] and reference not in self._names and not UNNAMED.fullmatch(reference):
            self.tensors[value]["name"] = self._names.fresh(reference)
        return value

    def output(self, spec: TensorSpec, reference: str, taken: Iterable[Value]) -> Value:
        """A tensor that is given, of its own: what is fed, a constant or another output as well is copied.

        int64 is given as int32: LiteRT.js takes and gives float32, int32 and uint8 alone.
        """
        value = self.value(reference)
        if self.types[reference].dtype == INT64:
            self._node = self.graph.producer(reference)
            narrow = TensorType(INT32, self.types[reference].shape)
            value = self.emit("CAST", [value], narrow, in_data_type=INT64, out_data_type=INT32)
            self.tensors[value]["name"] = self._names.fresh(spec.name)
            return value
        if value in self._made and value not in taken:
            return value
        self._node, self.result = self.graph.producer(reference), self.types[reference]
        copied = emit_reshape(self, value, self.result) if value not in self._shown else None
        if copied is None:
            copied = self.emit("CAST", [value], in_data_type=self.result.dtype, out_data_type=self.result.dtype)
        self.tensors[copied]["name"] = self._names.fresh(spec.name)
        return copied


def _is_same_shape(a: TensorType, b: TensorType) -> bool:
    """Of as many elements: then one free axis is as long as the other."""
    if a.shape is None or b.shape is None or sum(isinstance(d, str) for d in a.shape) > 1:
        return False
    return [d if isinstance(d, int) else -1 for d in a.shape] == [d if isinstance(d, int) else -1 for d in b.shape]


def _encode_options(options: dict[str, Any]) -> Table:
    found: Table = {}
    for name, value in options.items():
        if isinstance(value, np.dtype):
            found[name] = TYPES[value][0]
        elif isinstance(value, str):
            found[name] = PADDINGS[value] if name == "padding" else ACTIVATIONS[value]
        else:
            found[name] = value
    return found
