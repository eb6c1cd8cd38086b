"""An ONNX file as an importer meets it: its messages untouched (nothing inlined, nothing converted), and its shapes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from converters.fetch import read_bytes
from converters.onnx.messages import packaged
from converters.onnx.proto import decoded, load_external
from converters.targets.unity.onnx_constants import RANDOM_OPS, value_of
from converters.targets.unity.onnx_shapes import inferred_shapes
from signatures.errors import DamagedFileError
from signatures.records import dataclass

#: TensorProto.DataType that Sentis holds as floats; everything else is held as int.
_FLOATS = frozenset({1, 10, 11, 16})
#: Inputs of more elements are not made for a trial run.
_LARGEST_ZEROS = 1 << 16

Dims = tuple[int | None, ...]


@dataclass(frozen=True, slots=True)
class DeclaredInput:
    """An input that is no initializer. ``dims`` is None without a shape; in it, None is a free or named length."""

    name: str
    dims: Dims | None
    is_float: bool


@dataclass(frozen=True)
class OnnxFile:
    """A model with what is asked of it again and again; ``model`` is the ModelProto."""

    model: Any
    _values: dict[str, np.ndarray | None] = field(default_factory=dict, repr=False)

    @cached_property
    def initializers(self) -> Mapping[str, Any]:
        """Name → TensorProto."""
        return {t.name: t for t in self.model.graph.initializer}

    @cached_property
    def inputs(self) -> tuple[DeclaredInput, ...]:
        """The inputs, in the file's order."""
        return tuple(
            DeclaredInput(value.name, _dims(value), value.type.tensor_type.elem_type in _FLOATS)
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
    def fed(self) -> frozenset[str]:
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
        return name not in self.fed and (name in self.initializers or name in self.producers)

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
        return self._inferred[0]

    @cached_property
    def _inferred(self) -> tuple[Mapping[str, tuple[int | None, ...]], bool]:
        return inferred_shapes(self)

    @property
    def has_negative_lengths(self) -> bool:
        """Whether something is declared with a length below 0, or comes out with one."""
        graph = self.model.graph
        declared = (*graph.input, *graph.output, *graph.value_info)
        said = any(d.dim_value < 0 for value in declared for d in value.type.tensor_type.shape.dim)
        return said or self._inferred[1]


def read_onnx_file(path: Path) -> OnnxFile:
    """Read the messages of a model. Raises SourceError, DamagedFileError."""
    try:
        model = decoded(read_bytes(path))
    except DamagedFileError as error:
        raise error.at(str(path)) from error.__cause__
    load_external([model.graph], path.parent)
    for tensor in model.graph.initializer:
        if min(tensor.dims, default=0) < 0:
            raise DamagedFileError(
                f"the tensor {tensor.name!r} has the shape {list(tensor.dims)}",
                where=str(path),
                why="no length is negative",
                fix="export or download it again",
            )
    return OnnxFile(packaged(model))


def attributes(node: Any) -> Mapping[str, Any]:
    """Attribute name → AttributeProto."""
    return {a.name: a for a in node.attribute}


def _dims(value: Any) -> Dims | None:
    kind = value.type.tensor_type
    if not kind.HasField("shape"):
        return None
    return tuple(int(d.dim_value) if d.HasField("dim_value") else None for d in kind.shape.dim)
