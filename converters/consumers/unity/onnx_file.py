"""An ONNX file as an importer meets it: its messages untouched (nothing inlined or converted), constants and shapes.

An importer folds constants before it looks at them, so ``version_number`` may be an initializer, a Constant, the cast
of one, a sum; where a run is looked at, it may hang on the inputs too. They are computed node by node from what is
stored. Untrusted files: whatever would grow beyond ``_LIMIT`` elements is not computed.

Shapes are those of a run in which every free length of an input is 1, as Sentis' trial run has it, by ONNX's own shape
inference, asked node by node: asked for a whole graph it aborts the process where a length comes out negative (Slice,
onnx 1.23). What cannot be told is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.files.fetch import read_bytes
from export_model.converters.formats.onnx.messages import as_onnx_message
from export_model.converters.formats.onnx.proto import array_of, decode_model, load_external
from export_model.signatures.errors import DamagedFileError, ExportModelError

#: TensorProto.DataType that Sentis holds as floats; everything else is held as int.
_FLOATS = frozenset({1, 10, 11, 16})
#: TensorProto.DataLocation of numbers in another file.
_EXTERNAL = 1
#: Inputs of more elements are not made for a trial run.
_LARGEST_ZEROS = 1 << 16

Dims = tuple[int | None, ...]


class DeclaredInput(Struct, frozen=True):
    """An input that is no initializer. ``dims`` is None without a shape; in it, None is a free or named length."""

    name: str
    dims: Dims | None
    is_float: bool


class OnnxFile(Struct, frozen=True, dict=True):
    """A model with what is asked of it again and again; ``model`` is the ModelProto.

    ``beside`` is the name of a tensor whose numbers lie in a file of their own, empty where there is none.
    """

    model: Any
    beside: str = ""
    _values: dict[str, np.ndarray | None] = field(default_factory=dict)

    @cached_property
    def initializers(self) -> Mapping[str, Any]:
        """Name → TensorProto."""
        return {t.name: t for t in self.model.graph.initializer}

    @cached_property
    def inputs(self) -> tuple[DeclaredInput, ...]:
        """The inputs, in the file's order."""
        return tuple(
            DeclaredInput(value.name, _dims(value.type), value.type.tensor_type.elem_type in _FLOATS)
            for value in self.model.graph.input
            if value.name not in self.initializers
        )

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs, in the file's order."""
        return tuple(value.name for value in self.model.graph.output)

    @cached_property
    def producers(self) -> Mapping[str, Any]:
        """Value → the node that makes it."""
        return {name: node for node in self.model.graph.node for name in node.output if name}

    @cached_property
    def fed_values(self) -> frozenset[str]:
        """Values that hang on an input or on a draw: all that is no constant."""
        found = {i.name for i in self.inputs}
        for node in self.model.graph.node:
            if node.op_type in RANDOM_OPS or any(name in found for name in node.input):
                found.update(node.output)
        return frozenset(found)

    @property
    def opset(self) -> int:
        """The version of ONNX's own operators."""
        return next((int(o.version) for o in self.model.opset_import if o.domain in ("", "ai.onnx")), 1)

    def readers(self, name: str) -> Iterator[Any]:
        """The nodes that read a value."""
        return (node for node in self.model.graph.node if name in node.input)

    def is_constant(self, name: str) -> bool:
        """Whether a value is the same whatever is fed."""
        return name not in self.fed_values and (name in self.initializers or name in self.producers)

    def is_stored(self, name: str) -> bool:
        """Whether Barracuda has a value when it imports: it looks through Identity and Transpose, and computes none."""
        while name not in self.initializers:
            node = self.producers.get(name)
            if node is None or node.op_type not in ("Constant", "Identity", "Transpose"):
                return False
            if not node.input:
                return True
            name = node.input[0]
        return True

    def value(self, name: str) -> np.ndarray | None:
        """A constant's value; None for what hangs on an input, or is not small."""
        if name not in self._values:
            self._values[name] = value_of(self, name, {}) if self.is_constant(name) else None
        return self._values[name]

    def trial_value(self, name: str) -> np.ndarray | None:
        """A value in a run on zeros in which every free length is 1; None where it is not small, or drawn."""
        if self.is_constant(name):
            return self.value(name)
        shapes = {i.name: [d if d is not None and d >= 0 else 1 for d in i.dims or ()] for i in self.inputs}
        zeros = {
            i.name: np.zeros(shapes[i.name], np.float32 if i.is_float else np.int64)
            for i in self.inputs
            if np.prod(shapes[i.name], dtype=np.float64) <= _LARGEST_ZEROS
        }
        return value_of(self, name, zeros)

    @cached_property
    def shapes(self) -> Mapping[str, tuple[int | None, ...]]:
        """Value → shape, of a run in which every free length of an input is 1."""
        return self._inferred_shapes[0]

    @cached_property
    def _inferred_shapes(self) -> tuple[Mapping[str, tuple[int | None, ...]], bool]:
        return inferred_shapes(self)

    @property
    def has_negative_lengths(self) -> bool:
        """Whether something is declared with a length below 0, or comes out with one."""
        graph = self.model.graph
        declared = (*graph.input, *graph.output, *graph.value_info)
        said = any(d.dim_value < 0 for value in declared for d in value.type.tensor_type.shape.dim)
        return said or self._inferred_shapes[1]


def parsed_onnx(data: bytes) -> OnnxFile:
    """The model of an ONNX that we wrote: its weights are where they are, and not looked at."""
    return OnnxFile(as_onnx_message(decode_model(data)))


def read_onnx_file(path: Path) -> OnnxFile:
    """Read the messages of a model. Raises SourceError, DamagedFileError."""
    try:
        model = decode_model(read_bytes(path))
    except DamagedFileError as error:
        raise error.at(str(path)) from error.__cause__
    beside = next((t.name for t in model.graph.initializer if t.data_location == _EXTERNAL), "")
    load_external([model.graph], path.parent)
    for tensor in model.graph.initializer:
        if min(tensor.dims, default=0) < 0:
            raise DamagedFileError(
                f"the tensor {tensor.name!r} has the shape {list(tensor.dims)}",
                where=str(path),
                why="no length is negative",
                fix="export or download it again",
            )
    return OnnxFile(as_onnx_message(model), beside)


def attributes(node: Any) -> Mapping[str, Any]:
    """Attribute name → AttributeProto."""
    return {a.name: a for a in node.attribute}


def _dims(kind: Any) -> Dims | None:
    """The lengths that a TypeProto says, None where it says no shape."""
    if not kind.tensor_type.HasField("shape"):
        return None
    return tuple(int(d.dim_value) if d.HasField("dim_value") else None for d in kind.tensor_type.shape.dim)


#: Ops that draw: what hangs on them is never a constant.
RANDOM_OPS = frozenset(
    {"RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike", "Multinomial", "Bernoulli"}
)
_LIMIT = 1 << 16
_DEPTH = 200
#: TensorProto.DataType of float16 and bfloat16.
_NARROW = (10, 16)
#: Ops whose result may be of any size whatever goes in, and the input that says which.
_GROWING = {"Expand": 1, "ConstantOfShape": 0, "Tile": 1}
_NOT_COMPUTED = frozenset({"Loop", "Scan", "If", "Range", "Resize", "Upsample", "Pad", "EyeLike", "OneHot", "Einsum"})


def value_of(file: OnnxFile, name: str, fed: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """A value under what is fed to the inputs, None where it is large, drawn, or cannot be computed here."""
    wanted, order = [name], []
    seen: set[str] = set()
    while wanted:
        value = wanted.pop()
        if value in seen or value in file.initializers or value in fed or not value:
            continue
        seen.add(value)
        node = file.producers.get(value)
        if node is None or node.op_type in RANDOM_OPS or len(seen) > _DEPTH:
            return None
        order.append(node)
        wanted.extend(node.input)
    needed = {id(node) for node in order}
    values: dict[str, np.ndarray | None] = dict(fed)
    for node in file.model.graph.node:
        if id(node) in needed:
            inputs = [
                _read_initializer(file, n) if n in file.initializers else values.get(n) if n else None
                for n in node.input
            ]
            made = _compute(node, inputs, file.opset)
            if made is None:
                return None
            values.update(zip(node.output, made, strict=False))
    return _read_initializer(file, name) if name in file.initializers else values.get(name)


def _read_initializer(file: OnnxFile, name: str) -> np.ndarray | None:
    return _read(file.initializers[name])


def _read(tensor: Any) -> np.ndarray | None:
    if np.prod(tensor.dims, dtype=np.float64) > _LIMIT:
        return None
    try:
        return array_of(tensor, None) if tensor.data_type not in _NARROW else _narrow(tensor)
    except (ExportModelError, ValueError):
        return None


def _narrow(tensor: Any) -> np.ndarray:
    """Half precision, which no policy is converted from but a constant may be stored in."""
    import onnx

    return np.asarray(onnx.numpy_helper.to_array(tensor)).astype(np.float32)


def _compute(node: Any, inputs: list[np.ndarray | None], opset: int) -> list[np.ndarray] | None:
    """A node's results, None where it is not computed."""
    if any(value is None and name for value, name in zip(inputs, node.input, strict=True)):
        return None
    if node.op_type == "Identity" and len(inputs) == 1 and inputs[0] is not None:
        return [inputs[0]]
    if node.op_type == "Constant" and len(node.attribute) == 1 and node.attribute[0].name == "value":
        value = _read(node.attribute[0].t)
        return None if value is None else [value]
    return None if _may_grow(node.op_type, inputs) else _run(node, inputs, opset)


def _may_grow(kind: str, inputs: list[np.ndarray | None]) -> bool:
    sizes = [float(value.size) for value in inputs if value is not None]
    if kind in _NOT_COMPUTED or float(np.prod(sizes)) > _LIMIT:
        return True
    if kind in _GROWING:
        asked = inputs[_GROWING[kind]] if len(inputs) > _GROWING[kind] else None
        return asked is None or float(np.prod(np.abs(asked.astype(np.float64)))) * float(np.prod(sizes)) > _LIMIT
    return False


def _run(node: Any, inputs: list[np.ndarray | None], opset: int) -> list[np.ndarray] | None:
    """By ONNX's reference implementation; a node that it does not take has no value here."""
    import onnx
    from onnx.reference import ReferenceEvaluator

    graph = onnx.GraphProto(name="constant")
    graph.node.append(node)
    for name in dict.fromkeys(n for n in node.input if n):
        graph.input.append(onnx.ValueInfoProto(name=name))
    for name in node.output:
        graph.output.append(onnx.ValueInfoProto(name=name))
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", opset)])
    try:
        with np.errstate(all="ignore"):
            made = ReferenceEvaluator(model).run(None, dict(zip(node.input, inputs, strict=True)))
    except (RuntimeError, ValueError, TypeError, LookupError, NotImplementedError, AttributeError, ArithmeticError):
        return None
    return [np.asarray(value) for value in made]


#: Operands that say a shape, axes or bounds, by operator: their values are needed too.
_SECOND = "Reshape Expand Tile Squeeze Unsqueeze Split Pad ReduceSum ReduceMean OneHot TopK"
_SAYING = {**dict.fromkeys(_SECOND.split(), (1,)), "ConstantOfShape": (0,), "Slice": (1, 2, 3, 4)}


def inferred_shapes(file: OnnxFile) -> tuple[Mapping[str, tuple[int | None, ...]], bool]:
    """(value → shape, of inputs, initializers and results; whether a length came out negative)."""
    types, negative = _given_types(file), False
    for node in file.model.graph.node:
        if any(name and name not in types for name in node.input) or any(a.HasField("g") for a in node.attribute):
            continue
        for name, kind in _results(file, node, types).items():
            if any(d.HasField("dim_value") and d.dim_value < 0 for d in kind.tensor_type.shape.dim):
                negative = True
            elif name:
                types[name] = kind
    return {name: dims for name, kind in types.items() if (dims := _dims(kind)) is not None}, negative


def _given_types(file: OnnxFile) -> dict[str, Any]:
    import onnx

    types = {}
    for tensor in file.initializers.values():
        if min(tensor.dims, default=0) >= 0:
            types[tensor.name] = onnx.helper.make_tensor_type_proto(tensor.data_type, list(tensor.dims))
    for value in file.model.graph.input:
        if value.name not in types and value.type.HasField("tensor_type"):
            kind = onnx.TypeProto()
            kind.CopyFrom(value.type)
            for dim in kind.tensor_type.shape.dim:
                if not dim.HasField("dim_value") or dim.dim_value < 0:
                    dim.dim_value = 1
            types[value.name] = kind
    return types


def _results(file: OnnxFile, node: Any, types: Mapping[str, Any]) -> dict[str, Any]:
    import onnx
    import onnx.checker
    import onnx.shape_inference

    refused = (onnx.defs.SchemaError, onnx.shape_inference.InferenceError, onnx.checker.ValidationError)
    data = {}
    for index in _SAYING.get(node.op_type, ()):
        name = node.input[index] if index < len(node.input) else ""
        value = file.trial_value(name) if name else None
        if value is not None:
            data[name] = onnx.numpy_helper.from_array(value)
    try:
        schema = onnx.defs.get_schema(node.op_type, file.opset, "")
        known = {name: types[name] for name in node.input if name}
        made: dict[str, Any] = onnx.shape_inference.infer_node_outputs(schema, node, known, data)
    except (*refused, RuntimeError, ValueError):
        return {}
    return made
