"""The constructs of an ONNX model: each node with what an importer may trip over.

Unity's importers do not refuse what they do not know: they read some forms of an operator rightly, some wrongly, some
not at all. What decides is which operands are constants, their shapes, and what stands before and behind a node; all of
that is a ``Construct``. ``converters/consumers/unity/readings.py`` says what each importer makes of one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.signatures.errors import DamagedFileError

#: The pseudo-operators that an output and an input of the model are listed as.
OUTPUT, INPUT = "(output)", "(input)"
#: Axes of a tensor that an importer of Barracuda was seen to read.
MOST_AXES = 4
_STANDARD = ("", "ai.onnx")


class OperandSource(StrEnum):
    """Where an operand comes from, as an importer sees it (nothing folded)."""

    CONSTANT = "constant"  # an initializer or a Constant node
    TURNED = "turned"  # a Transpose of a constant
    COPIED = "copied"  # an Identity of a constant
    INPUT = "input"
    COMPUTED = "computed"
    ABSENT = "absent"


class Operand(Struct, frozen=True):
    """One operand: ``shape`` with None for a free length, None where it is not known; ``value`` of constants."""

    name: str
    source: OperandSource
    shape: tuple[int | None, ...] | None = None
    dtype: np.dtype | None = None
    value: np.ndarray | None = None

    @property
    def rank(self) -> int | None:
        """Number of axes, None if unknown."""
        return None if self.shape is None else len(self.shape)

    @property
    def is_constant(self) -> bool:
        """Whether it is a constant, turned or not."""
        return self.source in (OperandSource.CONSTANT, OperandSource.TURNED)


class Construct(Struct, frozen=True):
    """A node: its operator and operands, and where in the model it stands."""

    name: str
    op: str
    opset: int
    operands: tuple[Operand, ...]
    attributes: Mapping[str, Any]
    outputs: tuple[str, ...]
    model: ConstructModel

    def operand(self, index: int) -> Operand:
        """The operand at ``index``; one of source ABSENT where there is none."""
        return self.operands[index] if index < len(self.operands) else Operand("", OperandSource.ABSENT)

    def attribute(self, name: str, default: Any = None) -> Any:
        """An attribute as a Python value."""
        return self.attributes.get(name, default)

    @property
    def axes(self) -> int:
        """The most axes of its first operand, and of the shape that a Reshape gives it."""
        target = self.operand(1).value if self.op == "Reshape" else None
        return max(self.operand(0).rank or 0, 0 if target is None else target.size)

    @property
    def given_out(self) -> bool:
        """Whether an output of the model is made here."""
        return any(name in self.model.outputs for name in self.outputs)

    def maker(self, index: int = 0) -> Construct | None:
        """The node that makes an operand."""
        return self.model.makers.get(self.operand(index).name)

    def readers(self) -> tuple[Construct, ...]:
        """The nodes that read a result of this one."""
        return tuple(c for name in self.outputs for c in self.model.readers.get(name, ()))


class ConstructModel:
    """The constructs of a model in its order, with the values that connect them."""

    def __init__(self) -> None:
        self.constructs: list[Construct] = []
        self.makers: dict[str, Construct] = {}
        self.readers: dict[str, list[Construct]] = {}
        self.inputs: dict[str, Operand] = {}
        self.outputs: dict[str, Operand] = {}

    def __iter__(self) -> Iterator[Construct]:
        return iter(self.constructs)

    def add(self, construct: Construct) -> None:
        """Append a construct; its operands' makers come before it."""
        self.constructs.append(construct)
        self.makers.update(dict.fromkeys(construct.outputs, construct))
        for operand in construct.operands:
            self.readers.setdefault(operand.name, []).append(construct)


def constructs(proto: Any) -> ConstructModel:
    """The constructs of a ModelProto with all its data, inputs first, outputs last.

    Raises DamagedFileError where ONNX's shape inference refuses the model.
    """
    import onnx
    import onnx.helper
    import onnx.numpy_helper
    import onnx.shape_inference

    try:
        graph = onnx.shape_inference.infer_shapes(proto, data_prop=True).graph
    except (onnx.shape_inference.InferenceError, ValueError) as error:
        raise DamagedFileError(
            "the shapes of an ONNX model contradict each other",
            why=str(error).strip().splitlines()[0],
            fix="export the model again",
        ) from error
    opset = next((int(o.version) for o in proto.opset_import if o.domain in _STANDARD), 1)
    values = {t.name: onnx.numpy_helper.to_array(t) for t in graph.initializer}
    types = {v.name: v.type.tensor_type for v in (*graph.value_info, *graph.input, *graph.output)}
    model = ConstructModel()

    def operand(name: str) -> Operand:
        if not name:
            return Operand("", OperandSource.ABSENT)
        if name in values:
            value = values[name]
            return Operand(name, OperandSource.CONSTANT, value.shape, value.dtype, value)
        shape, dtype = _type_of(onnx, types.get(name))
        if name in model.inputs:
            return Operand(name, OperandSource.INPUT, shape, dtype)
        maker = model.makers.get(name)
        if (
            maker is not None
            and maker.op in ("Transpose", "Identity")
            and maker.operand(0).source is OperandSource.CONSTANT
        ):
            source = OperandSource.TURNED if maker.op == "Transpose" else OperandSource.COPIED
            return Operand(name, source, shape, dtype, maker.operand(0).value)
        return Operand(name, OperandSource.COMPUTED, shape, dtype)

    for value in graph.input:
        if value.name not in values:
            model.inputs[value.name] = Operand(value.name, OperandSource.INPUT, *_type_of(onnx, value.type.tensor_type))
            model.add(
                Construct(value.name, INPUT, opset, operands=(), attributes={}, outputs=(value.name,), model=model)
            )
    model.outputs = {
        v.name: Operand(v.name, OperandSource.COMPUTED, *_type_of(onnx, v.type.tensor_type)) for v in graph.output
    }
    for node in graph.node:
        attributes = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
        if node.op_type == "Constant" and "value" in attributes:
            values[node.output[0]] = onnx.numpy_helper.to_array(attributes["value"])
        operands = tuple(operand(name) for name in node.input)
        op = node.op_type if node.domain in _STANDARD else f"{node.domain}.{node.op_type}"
        name = node.name or node.output[0]
        given = tuple(n for n in node.output if n)
        model.add(Construct(name, op, opset, operands, attributes, given, model=model))
    for name in model.outputs:
        model.add(Construct(name, OUTPUT, opset, (operand(name),), attributes={}, outputs=(), model=model))
    return model


def _type_of(onnx: Any, kind: Any) -> tuple[tuple[int | None, ...] | None, np.dtype | None]:
    if kind is None:
        return None, None
    shape = None
    if kind.HasField("shape"):
        shape = tuple(
            int(d.dim_value) if d.HasField("dim_value") and d.dim_value >= 0 else None for d in kind.shape.dim
        )
    dtype = onnx.helper.tensor_dtype_to_np_dtype(kind.elem_type) if kind.elem_type else None
    return shape, dtype
