"""An ONNX node as the translating functions see it: inputs as tensors of the new graph, attributes as Python values."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from export_model.converters.graph.types import FLOAT32
from export_model.signatures.dtypes import DATA_TYPES
from export_model.signatures.errors import UnsupportedOpError

if TYPE_CHECKING:
    from export_model.converters.formats.onnx.importer.importer import Importer

#: Domains that mean ONNX's own operators.
STANDARD = ("", "ai.onnx")

#: TensorProto.DataType → dtype, for what a policy computes in. Doubles are computed as float32: TensorFlow.js has no
#: float64, and no trainer's weights need it (verification judges the difference).
DTYPES: Mapping[int, np.dtype] = {
    t.onnx: FLOAT32 if t.name == "DT_DOUBLE" else t.dtype
    for t in DATA_TYPES
    if t.name not in ("DT_HALF", "DT_UINT32", "DT_UINT64")
}
#: What TensorProto calls the types that are not read.
_UNREAD = {0: "undefined", 8: "string", 12: "uint32", 13: "uint64", 14: "complex64", 15: "complex128"}


class Op(Struct, frozen=True):
    """One ONNX node. ``inputs`` are references into the new graph, None for one that is left out.

    ``opset`` is the version of the node's own domain; ``outputs`` are the values' names, empty for one left out.
    """

    kind: str
    domain: str
    name: str
    opset: int
    inputs: tuple[str | None, ...]
    attrs: Mapping[str, Any]
    outputs: tuple[str, ...]

    def get(self, position: int) -> str | None:
        """An optional input."""
        return self.inputs[position] if position < len(self.inputs) else None

    def need(self, position: int) -> str:
        """A required input; raises UnsupportedOpError."""
        found = self.get(position)
        if found is None:
            raise self.op_error(f"input {position} is missing", "the op cannot be computed without it")
        return found

    def integer(self, name: str, default: int) -> int:
        """An integer attribute."""
        return int(self._attribute(name, default, int))

    def integer_or_none(self, name: str) -> int | None:
        """An integer attribute that may be left out."""
        return self.integer(name, 0) if name in self.attrs else None

    def number(self, name: str, default: float) -> float:
        """A float attribute."""
        return float(self._attribute(name, default, (int, float)))

    def text(self, name: str, default: str) -> str:
        """A string attribute."""
        return str(self._attribute(name, default, str))

    def body(self, name: str) -> Any:
        """A subgraph."""
        found = self.attrs.get(name)
        if not hasattr(found, "initializer"):
            raise self.op_error(f"its attribute {name} must be a graph", "the op cannot be computed without it")
        return found

    def _attribute(self, name: str, default: Any, kind: type | tuple[type, ...]) -> Any:
        """An attribute as the file has it; raises UnsupportedOpError where it is of another kind than ``kind``."""
        value = self.attrs.get(name, default)
        if not isinstance(value, kind):
            raise self.op_error(f"its attribute {name} is {str(value)[:80]!r}", "the operator has it of another kind")
        return value

    def integers(self, name: str, default: Sequence[int] | None = None) -> tuple[int, ...] | None:
        """A list of integers, ``default`` where the attribute is left out."""
        value = self.attrs.get(name, default)
        if value is None:
            return None
        if not isinstance(value, Sequence) or not all(isinstance(v, int) for v in value):
            raise self.op_error(f"its attribute {name} is {str(value)[:80]!r}", "the operator has it of another kind")
        return tuple(value)

    def dtype(self, name: str, default: int) -> np.dtype:
        """A data type attribute; raises UnsupportedOpError for types that no target has."""
        number = self.integer(name, default)
        if number not in DTYPES:
            kind = _UNREAD.get(number, number)
            raise self.op_error(f"{name} {kind} is a data type that is not converted", "policies compute in float32")
        return DTYPES[number]

    def op_error(self, what: str, why: str | None = None, fix: str | None = None) -> UnsupportedOpError:
        """The error that this node cannot be converted."""
        domain = f" of {self.domain}" if self.domain not in STANDARD else ""
        return UnsupportedOpError(
            f"cannot convert {self.kind}{domain} (node {self.name!r}): {what}",
            issues=[(self.name, self.kind)],
            why=why,
            fix=fix
            or "if the node is not part of the policy, name the outputs you need with --output; else please "
            "open an issue with the model",
        )


#: Makes the op's outputs in the new graph: the reference of the only one, or one per output (None where not made).
Translate = Callable[[Op, "Importer"], "str | Sequence[str | None]"]
