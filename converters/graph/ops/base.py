"""What an entry of the op table is made of, and the helpers that entries share.

One entry holds everything the compiler knows of an op: its numpy *kernel* (the oracle, and what folds constants), its
*infer* rule (result dtype and shape), its *lowering* for each target that needs one, the attributes it has in a
GraphDef, how other versions of TensorFlow spell it, and the *traits* that passes ask for. No other file lists ops.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, Protocol

import numpy as np
from msgspec import Struct

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.barracuda.base import Nn
from export_model.converters.graph.ops.litert.base import Litert
from export_model.converters.graph.ops.loops.base import Loops
from export_model.converters.graph.ops.rewriting import Decomposition, Older, Shape, Tfjs
from export_model.converters.graph.types import INT64, Dim, Symbols, TensorType, broadcast
from export_model.signatures.errors import GraphError, UnsupportedOpError

Kernel = Callable[..., Any]
Infer = Callable[[Node, Sequence[TensorType], Symbols], Sequence[TensorType]]
AttrKind = Literal["type", "int", "float", "bool", "str", "shape"]

#: Marks an attribute that a GraphDef must carry.
REQUIRED: Any = object()


class OnnxBuilder(Protocol):
    """What a lowering may use. Values are ONNX names; ``value`` gives the one that stands for a tensor of the graph."""

    opset: int

    def value(self, reference: str) -> str:
        """The ONNX value of a tensor of the graph."""

    def type_of(self, reference: str) -> TensorType:
        """What is known of a tensor of the graph."""

    def emit(self, op: str, inputs: Sequence[str], **attributes: Any) -> str:
        """Append an ONNX node; returns the name of its output."""

    def emit_several(self, op: str, inputs: Sequence[str], outputs: int, **attributes: Any) -> tuple[str, ...]:
        """Append an ONNX node of so many outputs; returns their names."""

    def const(self, array: np.ndarray, hint: str = "const") -> str:
        """An initializer; equal arrays share one."""

    def producer(self, reference: str) -> Node:
        """The node of the graph that makes a tensor."""

    def holds(self, value: str, reference: str, axes: Sequence[int]) -> None:
        """Note that ``value`` is a tensor of the graph with its axes in another order (numpy's ``transpose``)."""


Lower = Callable[[Node, OnnxBuilder], Any]
#: How many rows the table has that an op looks up, by the types of its operands; None where that is not known.
TableSize = Callable[[Node, Sequence[TensorType]], int | None]
#: How a result is rounded: not at all; once, as IEEE says; by an approximation of each runtime's own (Eigen's tanh is 3
#: to 4 units in the last place off); or a sum of many products, added in an order of each runtime's own.
Precision = Literal["exact", "rounded", "approximate", "summed"]
#: What an op that computes nothing does with elements: pass them on, show them under another shape, pick some, join
#: several operands', repeat them, change the order of axes.
Moves = Literal["", "same", "view", "pick", "join", "repeat", "turn"]
#: The layer of a network that an op computes.
Layer = Literal["", "dense", "convolution", "pool"]
#: What a graph starts from: what is fed, what stands in the file.
Start = Literal["", "fed", "constant"]
#: The distribution that is drawn from.
Sampler = Literal["", "normal", "truncated normal", "uniform", "categorical"]
#: In arithmetic of two: what the second operand is to the first.
Operand = Literal["", "factor", "divisor", "summand", "subtrahend"]
Finite = Literal["", "always", "as its operands"]


class Attr(Struct, frozen=True):
    """An attribute as a GraphDef has it.

    ``derive`` says how the writers compute it (``"in:0"``: the dtype of input 0; ``"out:0"``; ``"count"``: the number
    of inputs less the other ones); such attributes are not kept in nodes. ``since`` is the first TensorFlow that knows
    the attribute when that is later than 1.4: it is then written only where it differs from its default.
    """

    name: str
    kind: AttrKind
    default: Any = REQUIRED
    derive: str | None = None
    since: str | None = None
    #: False: any value but the default changes the result in a way no kernel here has, so the reader refuses it.
    supported: bool = True


class _Entry(Struct, frozen=True):
    """What an entry says in the order in which it says it; all else of an ``OpDef`` is named."""

    name: str
    infer: Infer
    kernel: Kernel | None = None
    onnx: Lower | None = None
    attrs: tuple[Attr, ...] = ()


class OpDef(_Entry, frozen=True, kw_only=True):
    """One op of the table; see the module's docstring."""

    #: -1: as many as the node says.
    outputs: int = 1
    #: Folding is wrong for samplers and for matrix products (whose rounding depends on the processor).
    foldable: bool = True
    #: Where TensorFlow.js computes it otherwise, or not at all.
    tfjs: Tfjs | None = None
    #: Where a Barracuda lacks it, or computes it otherwise.
    barracuda: Decomposition | None = None
    #: Which layers of a Barracuda ``.nn`` it becomes; None: none that every Barracuda has compute it.
    nn: Nn | None = None
    #: How it is written in LiteRT's operators; None: LiteRT has none that compute it.
    litert: Litert | None = None
    #: How each element is computed: what source code is printed from; None: it is not printed.
    loops: Loops | None = None
    #: Names under which the same op stands in graphs of other TensorFlow versions.
    spellings: tuple[str, ...] = ()
    #: Where TensorFlow 1.4 lacks it: how it is written with what that has. The normalise pass leaves none of these.
    older: Older | None = None
    #: The first TensorFlow that has it, where that is later than 1.4 and a writer may make one.
    since: str | None = None

    start: Start = ""
    moves: Moves = ""
    #: The operands whose elements are moved, from and to; the others say how.
    data: tuple[int | None, int | None] = (0, 1)
    precision: Precision = "rounded"
    #: The result at an index depends on the operands at that index only.
    elementwise: bool = False
    #: What a second operand is to the first.
    operand: Operand = ""
    #: Whether the result is finite: whatever the operands are, or where they are (as long as it fits into float32).
    finite: Finite = ""
    #: The result depends on the shapes of the operands, not on their elements.
    of_shape: bool = False
    #: The number that every element of the result is, whatever the operand holds.
    full_of: int | None = None
    layer: Layer = ""
    sampler: Sampler = ""
    #: What papers call the activation that it is.
    activation: str = ""
    #: TensorFlow.js computes the activation as a part of a fused product, on every backend (tfjs-core ops/fused_util).
    tfjs_fuses: bool = False
    #: The layer with which TensorFlow's remapper (2.21) joins it, where TensorFlow.js lacks the kernel: right behind
    #: the bias, or behind a factor or summand after it (the GELU, the hard swish).
    remapped: Layer = ""
    remapped_behind: Layer = ""
    #: The operand whose integers are looked up, and how many rows there are to find.
    looks_up: int | None = None
    table_size: TableSize | None = None
    #: The result is the remainder of the first operand by the second.
    remainder: bool = False
    #: The operand whose truths choose between the other two, number by number or row by row.
    condition: int | None = None
    #: The result is where the largest or the smallest number is along an axis.
    chooses: Literal["", "largest", "smallest"] = ""
    #: What the result is of two operands' elements, or of those along an axis.
    takes: Literal["", "largest", "smallest", "mean"] = ""
    #: The result says which elements of two operands are equal.
    compares_equal: bool = False
    #: The op that computes this one, a bias and an activation in one.
    fused: str = ""

    def data_operands(self, operands: Sequence[Any]) -> Sequence[Any]:
        """Those of ``operands`` whose elements are moved."""
        return operands[slice(*self.data)]

    @property
    def exact(self) -> bool:
        """Whether it rounds nothing."""
        return bool(self.moves) or self.precision == "exact"


def written_as_older(node: Node, args: Sequence[TensorType], symbols: Symbols) -> Sequence[TensorType]:
    """The infer rule of an op that the normalise pass leaves nowhere."""
    raise GraphError(
        f"node {node.name!r} ({node.op}) is not written in the spelling of TensorFlow 1.4",
        why="its type is known once the normalise pass has run",
        fix="this is a fault of export-model; please open an issue with the source",
    )


def type_attr(name: str = "T", derive: str = "in:0") -> Attr:
    """A dtype attribute that follows from an input or output."""
    return Attr(name, "type", derive=derive)


# ------------------------------------------------------------------ helpers for infer rules


def by_shape(rule: Callable[[Node, Sequence[TensorType], tuple[Dim, ...], Symbols], Sequence[Dim]]) -> Infer:
    """Result has the dtype of input 0, and the shape that ``rule`` makes of its shape; of no known shape none."""

    def infer(node: Node, args: Sequence[TensorType], symbols: Symbols) -> Sequence[TensorType]:
        shape = args[0].shape
        return [TensorType(args[0].dtype, None if shape is None else tuple(rule(node, args, shape, symbols)))]

    return infer


def same_as(position: int = 0, *, count: int | None = None) -> Infer:
    """Result has the dtype and shape of input ``position`` (of ``count``)."""

    def infer(node: Node, args: Sequence[TensorType], symbols: Symbols) -> Sequence[TensorType]:
        if count is not None and len(args) != count:
            raise shape_error(node, args, f"it takes {count} inputs")
        return [TensorType(args[position].dtype, args[position].shape)]

    return infer


def broadcast_of(dtype: np.dtype | None = None, *, count: int | None = None) -> Infer:
    """Result has the broadcast shape of all inputs (``count`` of them), and ``dtype`` or the first input's."""

    def infer(node: Node, args: Sequence[TensorType], symbols: Symbols) -> Sequence[TensorType]:
        if count is not None and len(args) != count:
            raise shape_error(node, args, f"it takes {count} inputs")
        require_one_dtype(node, args)
        shape: tuple[Dim, ...] | None = ()
        for arg in args:
            try:
                shape = broadcast(shape, arg.shape, symbols)
            except ValueError as error:
                raise shape_error(node, args, str(error)) from error
        return [TensorType(dtype or args[0].dtype, shape)]

    return infer


def require_one_dtype(node: Node, args: Sequence[TensorType]) -> None:
    """Raise GraphError where inputs are of several dtypes, which TensorFlow does not run."""
    if len(found := {a.dtype.name: None for a in args}) > 1:
        raise shape_error(node, args, f"they are of {' and '.join(found)}, and must be of one dtype")


def shape_error(node: Node, args: Sequence[TensorType], why: str) -> GraphError:
    """A GraphError that names the node and the shapes that do not fit."""
    shapes = ", ".join("?" if a.shape is None else str(list(a.shape)) for a in args)
    return GraphError(
        f"node {node.name!r} ({node.op}) cannot take inputs of shape {shapes}",
        why=why,
        fix="the graph is damaged or its placeholders have other shapes than the file says",
    )


#: What Python and numpy raise where a node has fewer inputs, other ranks or other attributes than its op.
MISFIT = (IndexError, KeyError, TypeError, ValueError, AttributeError, ArithmeticError, AssertionError)


def misfit(node: Node, error: Exception) -> GraphError:
    """The GraphError of a node that one of ``MISFIT`` came of."""
    return GraphError(
        f"node {node.name!r} ({node.op}) has inputs or attributes that its op does not allow",
        why=f"{type(error).__name__}: {error}",
        fix="the graph is damaged; freeze it again from its checkpoint",
    )


def require_constant(node: Node, args: Sequence[TensorType], position: int, meaning: str) -> np.ndarray:
    """The constant value of an input, or UnsupportedOpError."""
    value = args[position].constant
    if value is None:
        raise not_constant(node, meaning)
    return value


def not_constant(node: Node, meaning: str) -> UnsupportedOpError:
    """The error for an operand that must be known before the graph runs."""
    return UnsupportedOpError(
        f"node {node.name!r} ({node.op}) has {meaning} that is computed while the graph runs",
        issues=[(node.name, node.op)],
        why=f"{meaning} must be a constant in every target",
        fix="if it comes from a placeholder, give it a value with --set NAME=VALUE",
    )


# ------------------------------------------------------------------ helpers for kernels and lowerings


def plain(function: Callable[..., np.ndarray]) -> Kernel:
    """A kernel whose result IEEE rounds once anyway (add, multiply, divide, compare) or is an integer's."""

    def kernel(node: Node, *arrays: np.ndarray) -> np.ndarray:
        with np.errstate(all="ignore"):
            return np.asarray(function(*arrays))

    return kernel


def as_int64(node: Node, builder: OnnxBuilder, position: int) -> str:
    """Input ``position`` as the int64 vector that ONNX wants for shapes and indices."""
    reference = node.inputs[position]
    kind = builder.type_of(reference)
    constant = kind.constant
    if constant is not None:
        return builder.const(np.atleast_1d(constant).astype(np.int64), "shape")
    value = builder.value(reference)
    if kind.dtype != INT64:
        value = builder.emit("Cast", [value], to=INT64)
    if kind.rank == 0:
        value = builder.emit("Reshape", [value, builder.const(np.array([1], np.int64), "shape")])
    return value


def constant_input(node: Node, builder: OnnxBuilder, position: int, meaning: str) -> np.ndarray:
    """The constant value of an input during lowering."""
    value = builder.type_of(node.inputs[position]).constant
    if value is None:
        raise not_constant(node, meaning)
    return value


def direct(onnx_op: str, *positions: int, shape_at: int | None = None, **attributes: Any) -> Lower:
    """A lowering to one ONNX node of all inputs, or of those at ``positions``; the one at ``shape_at`` is a shape."""

    def lower(node: Node, builder: OnnxBuilder) -> str:
        operands = [
            as_int64(node, builder, i) if i == shape_at else builder.value(node.inputs[i])
            for i in positions or range(len(node.inputs))
        ]
        return builder.emit(onnx_op, operands, **attributes)

    return lower


def scalar(builder: OnnxBuilder, node: Node, number: float) -> str:
    """A scalar constant of the dtype of the node's first input."""
    return builder.const(np.array(number, builder.type_of(node.inputs[0]).dtype), "scalar")


def chain(*steps: tuple[str, float | None]) -> Lower:
    """ONNX ops one after the other, the first of the node's inputs; a number is the last operand of its op."""

    def lower(node: Node, builder: OnnxBuilder) -> str:
        values = [builder.value(r) for r in node.inputs]
        for op, number in steps:
            operands = values if number is None else [*values, scalar(builder, node, number)]
            values = [builder.emit(op, operands)]
        return values[0]

    return lower


def emit_squeeze(builder: OnnxBuilder, value: str, axes: Sequence[int], result: Shape) -> str:
    """``value`` without ``axes`` of length 1; ``result`` is the shape that comes of it."""
    return value if not axes else emit_reshape(builder, value, result) or _with_axes(builder, "Squeeze", value, axes)


def emit_unsqueeze(builder: OnnxBuilder, value: str, axes: Sequence[int], result: Shape) -> str:
    """``value`` with ``axes`` of length 1 put in; ``result`` is the shape that comes of it."""
    return value if not axes else emit_reshape(builder, value, result) or _with_axes(builder, "Unsqueeze", value, axes)


def emit_reshape(builder: OnnxBuilder, value: str, result: Shape) -> str:
    """A Reshape to ``result``, or nothing where that shape is not known well enough for one.

    Barracuda reads it in every version. The axes of Squeeze and Unsqueeze are an input since opset 13, which it reads
    from 2.3.1 on.
    """
    if not result or 0 in result or sum(isinstance(d, str) for d in result) > 1:
        return ""
    target = np.array([d if isinstance(d, int) else -1 for d in result], np.int64)
    return builder.emit("Reshape", [value, builder.const(target, "shape")])


def _with_axes(builder: OnnxBuilder, onnx_op: str, value: str, axes: Sequence[int]) -> str:
    if builder.opset < 13:
        return builder.emit(onnx_op, [value], axes=[int(a) for a in axes])
    return builder.emit(onnx_op, [value, builder.const(np.array(axes, np.int64), "axes")])


def axis_within(axis: int, rank: int) -> int:
    """An axis counted from the front. Raises IndexError, one of ``MISFIT``, where ``rank`` axes do not have it.

    Whatever a file says is held to the rank here, before a shape or a list is made of it.
    """
    if not -rank <= axis < rank:
        raise IndexError(f"axis {axis} must be one of {rank} axes, {-rank} to {rank - 1}")
    return axis % rank


def axes_within(axes: Iterable[int], rank: int) -> tuple[int, ...]:
    """Axes counted from the front, sorted, each once. Raises IndexError, one of ``MISFIT``."""
    return tuple(sorted({axis_within(int(axis), rank) for axis in axes}))


def insert_axis(shape: Shape, axis: int, length: Dim = 1) -> tuple[Dim, ...] | None:
    """A shape with one axis more at ``axis``, which may be counted from the end of the result. Raises IndexError."""
    if shape is None:
        return None
    at = axis_within(axis, len(shape) + 1)
    return (*shape[:at], length, *shape[at:])
