"""Ops that TensorFlow 1.4 lacks, or spelt otherwise, as nodes of ops that it has: the normalise pass asks for them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from export_model.converters.graph.nn.choosing import cumulate, last, moved_back, top_k
from export_model.converters.graph.nodes import Node, TensorShape, normal_ref, ref
from export_model.converters.graph.ops.base import Attr, OpDef, written_as_older
from export_model.converters.graph.ops.einsum import einsum
from export_model.converters.graph.ops.rewriting import GraphBuilder, Older, Shape
from export_model.converters.graph.types import BOOL, FLOAT32, INT32
from export_model.signatures.errors import UnsupportedOpError

if TYPE_CHECKING:  # it asks the table of ops
    from export_model.converters.graph.builder import Builder

_MAX_AXIS = 7
TO_NCHW, TO_NHWC = np.array([0, 3, 1, 2], INT32), np.array([0, 2, 3, 1], INT32)


def _dtype(node: Node) -> np.dtype:
    """The dtype of a node's operands, as GraphDefs say it."""
    given = node.attrs.get("T")
    return given if isinstance(given, np.dtype) else FLOAT32


def clip(builder: GraphBuilder, node: Node) -> str:
    """ClipByValue (TF 1.8) = Maximum(Minimum(x, high), low), the order that tf.clip_by_value had before."""
    x, low, high = node.inputs
    upper = builder.add("Minimum", [x, high], "Minimum")
    return builder.add("Maximum", [upper, low], "Maximum", node.origin)


def leaky_relu(builder: GraphBuilder, node: Node) -> str:
    """LeakyRelu (TF 1.8) = Maximum(x, alpha·x) for alpha ≤ 1, Minimum above."""
    alpha = float(node.attrs.get("alpha", 0.2))
    slope = builder.const(np.array(alpha, _dtype(node)), "alpha")
    scaled = builder.add("Mul", [node.inputs[0], slope], "mul")
    return builder.add("Maximum" if alpha <= 1 else "Minimum", [node.inputs[0], scaled], "leaky", node.origin)


def _div_no_nan(builder: GraphBuilder, node: Node) -> str:
    """DivNoNan: x / y, and where y is 0 the zeros of ZerosLike, whatever x is; y is broadcast by adding them."""
    x, y = node.inputs
    dtype = _dtype(node)
    quotient = builder.add("RealDiv", [x, y], "quotient")
    zeros = builder.add("ZerosLike", [quotient], "zeros")
    equal = builder.add("Equal", [y, builder.const(np.zeros((), dtype), "0")], "equal")
    as_number = builder.add("Cast", [equal], "number", DstT=dtype)
    wide = builder.add("Add", [as_number, zeros], "wide")
    is_zero = builder.add("Cast", [wide], "is_zero", DstT=BOOL)
    return builder.add("Select", [is_zero, zeros, quotient], "no_nan", node.origin)


def select_v2(builder: GraphBuilder, node: Node) -> str:
    """SelectV2 (TF 1.14) as Select of operands broadcast by adding zeros; ZerosLike of NaN is zero."""
    condition, a, b = node.inputs
    dtype = _dtype(node)

    def cast(tensor: str, to: np.dtype, name: str) -> str:
        return builder.add("Cast", [tensor], name, DstT=to)

    as_float = cast(condition, FLOAT32, "float")
    zeros = builder.add("ZerosLike", [as_float], "zeros")
    for side, tensor in (("a", a), ("b", b)):
        like = builder.add("ZerosLike", [tensor], f"zeros_{side}")
        like = like if dtype == FLOAT32 else cast(like, FLOAT32, f"zeros_{side}_float")
        zeros = builder.add("Add", [zeros, like], f"zeros_{side}_sum")
    wide = cast(builder.add("Add", [as_float, zeros], "wide"), BOOL, "c")
    if dtype == BOOL:  # which Add does not take
        a, b = cast(a, FLOAT32, "a_float"), cast(b, FLOAT32, "b_float")
    elif dtype != FLOAT32:
        zeros = cast(zeros, dtype, "zeros_cast")
    left, right = (builder.add("Add", [t, zeros], side) for side, t in (("a", a), ("b", b)))
    if dtype == BOOL:
        left, right = cast(left, BOOL, "a_bool"), cast(right, BOOL, "b_bool")
    return builder.add("Select", [wide, left, right], "select", node.origin)


def _batch_norm(builder: GraphBuilder, node: Node) -> str:
    """FusedBatchNorm at inference: (x − mean)·(scale/√(variance + ε)) + offset."""
    if node.attrs.get("is_training", True):
        if _is_layer_norm(builder, node):
            return _layer_norm(builder, node)
        raise UnsupportedOpError(
            f"cannot convert {node.op} (node {node.name!r}) in training mode",
            issues=[(node.name, node.op)],
            why="its statistics would come from the batch, so an agent's action would depend on the other agents",
            fix="freeze the graph with is_training=False",
        )
    x, scale, offset, mean, variance = node.inputs[:5]
    epsilon = builder.const(np.array(node.attrs.get("epsilon", 1e-4), np.float32), "epsilon")
    positive = builder.add("Add", [variance, epsilon], "var_eps")
    deviation = builder.add("Sqrt", [positive], "std")
    factor = builder.add("RealDiv", [scale, deviation], "factor")
    nchw = node.attrs.get("data_format") == "NCHW"
    if nchw:
        x = builder.add("Transpose", [x, builder.const(TO_NHWC, "nhwc/perm")], "nhwc")
    centred = builder.add("Sub", [x, mean], "centred")
    scaled = builder.add("Mul", [centred, factor], "scaled")
    result = builder.add("Add", [scaled, offset], "y", node.origin)
    if nchw:
        perm = builder.const(TO_NCHW, "nchw/perm")
        result = builder.add("Transpose", [result, perm], "nchw", node.origin)
    return result


def _is_layer_norm(builder: GraphBuilder, node: Node) -> bool:
    """Whether a training FusedBatchNorm is Keras 2's LayerNormalization.

    That has rows as channels of one image [1, B, n, 1], scaled by ones and moved by zeros. No row hangs on another
    then.
    """
    image, scale, offset = (builder.producer(normal_ref(r)) for r in node.inputs[:3])
    if node.attrs.get("data_format") != "NCHW" or image.op != "Reshape":
        return False
    target = builder.producer(normal_ref(image.inputs[1]))
    if target.op != "Pack" or len(target.inputs) != 4:
        return False
    known = [
        *((target.inputs[i], 1) for i in (0, 3)),
        *((fill.inputs[1], value) for fill, value in ((scale, 1), (offset, 0)) if fill.op == "Fill"),
    ]
    constants = [(builder.constant_of(normal_ref(r)), value) for r, value in known]
    ones = len(known) == 4 and all(c is not None and c.size == 1 and c.item() == value for c, value in constants)
    return ones and _channels_are_rows(builder, normal_ref(node.inputs[0]), normal_ref(image.inputs[0]))


def _channels_are_rows(builder: GraphBuilder, image: str, tensor: str) -> bool:
    """Whether an image [1, B, n, 1] of a tensor has no numbers of two agents in one channel.

    So it is where n is a number, and what lies behind the axis of the agents (the last that is free) is one such row,
    or several. [1, n, B, 1] of the tensor turned round is a batch norm over the agents.
    """
    shown, dims = builder.shape_of(image), builder.shape_of(tensor)
    if shown is None or dims is None or len(shown) != 4 or not isinstance(shown[2], int):
        return False
    free = [i for i, d in enumerate(dims) if isinstance(d, str)]
    if not free:
        return True  # made for one agent, or so many that only a trial tells (passes/vmap_trial.py)
    behind = math.prod(d for d in dims[free[-1] + 1 :] if isinstance(d, int))
    return shown[2] > 0 and behind % shown[2] == 0


def _layer_norm(builder: GraphBuilder, node: Node) -> str:
    """(x − mean)/√(variance + ε) over what a row [1, B, n, 1] has."""
    axes = builder.ints([2, 3], "axes")
    epsilon = builder.const(np.array(node.attrs.get("epsilon", 1e-4), FLOAT32), "epsilon")
    mean = builder.add("Mean", [node.inputs[0], axes], "mean", keep_dims=True)
    centred = builder.add("Sub", [node.inputs[0], mean], "centred")
    square = builder.add("Square", [centred], "square")
    variance = builder.add("Mean", [square, axes], "variance", keep_dims=True)
    positive = builder.add("Add", [variance, epsilon], "var_eps")
    deviation = builder.add("Sqrt", [positive], "std")
    return builder.add("RealDiv", [centred, deviation], "y", node.origin)


def _concat_v1(builder: GraphBuilder, node: Node) -> str:
    """Concat (axis first) as ConcatV2 (axis last)."""
    return builder.add("ConcatV2", [*node.inputs[1:], node.inputs[0]], "v2", node.origin)


def _identity_n(builder: GraphBuilder, node: Node) -> str:
    """IdentityN (TF 1.6), which custom gradients (tf.nn.swish) leave: each output is the input of its number."""
    first, *rest = (normal_ref(r) for r in node.inputs)
    for index, reference in enumerate(rest, 1):
        builder.redirect(ref(node.name, index), builder.resolve(reference))
    return builder.resolve(first)


def _default(builder: GraphBuilder, node: Node) -> str:
    """A PlaceholderWithDefault that is no input of the policy: its default."""
    return builder.resolve(normal_ref(node.inputs[0]))


def broadcast_to(builder: GraphBuilder, node: Node) -> str:
    """BroadcastTo (TF 1.12): the operand times as many ones."""
    x, shape = node.inputs
    dtype = _dtype(node)
    number = INT32 if dtype == BOOL else dtype
    if dtype == BOOL:
        x = builder.add("Cast", [x], "number", DstT=number)
    ones = builder.add("Fill", [shape, builder.const(np.ones((), number), "one")], "ones")
    wide = builder.add("Mul", [x, ones], "wide", node.origin)
    return wide if dtype != BOOL else builder.add("Cast", [wide], "bool", node.origin, DstT=BOOL)


def _einsum(builder: GraphBuilder, node: Node) -> str:
    """Einsum (TF 1.15)."""

    def shape(reference: str) -> Shape:
        return builder.shape_of(normal_ref(reference))

    try:
        return einsum(builder, str(node.attrs.get("equation", "")), node.inputs, "einsum", shape_of=shape)
    except UnsupportedOpError as error:
        what = f"cannot convert Einsum (node {node.name!r}): {error.what}"
        raise UnsupportedOpError(what, issues=[(node.name, node.op)], why=error.why) from error


def _erfc(builder: GraphBuilder, node: Node) -> str:
    """Erfc, which Keras' gelu is made of, as 1 − erf(x)."""
    one = builder.const(np.ones((), _dtype(node)), "one")
    return builder.add("Sub", [one, builder.add("Erf", node.inputs, "Erf")], "rest")


def _is_nan(builder: GraphBuilder, node: Node) -> str:
    """IsNan, which TensorFlow.js and older Barracudas lack: a NaN alone is not what it is."""
    return builder.add("NotEqual", [node.inputs[0], node.inputs[0]], "is_nan", node.origin)


def _compared_with_largest(comparison: str) -> Older:
    """IsFinite and IsInf: the absolute value against the largest number; of a NaN every comparison is false."""

    def older(builder: GraphBuilder, node: Node) -> str:
        dtype = _dtype(node)
        size = builder.add("Abs", [node.inputs[0]], "abs")
        largest = builder.const(np.array(np.finfo(dtype).max, dtype), "largest")
        return builder.add(comparison, [size, largest], "compared", node.origin)

    return older


def _top_k(builder: GraphBuilder, node: Node) -> str:
    """TopKV2, which not all targets have: each compared with each, in order whether that is asked for or not."""
    tensor, *count = (normal_ref(r) for r in node.inputs)
    try:
        k = int(builder.known_value(count[0], "k").reshape(())) if count else int(node.attrs["k"])
        best, places = builder.write([tensor], lambda b, x: top_k(b, x, k), node.name)
    except UnsupportedOpError as error:
        what = f"cannot convert {node.op} (node {node.name!r}): {error.what}"
        raise UnsupportedOpError(what, issues=[(node.name, node.op)], why=error.why) from error
    wanted = node.attrs.get("index_type", INT32)
    builder.redirect(ref(node.name, 1), builder.add("Cast", [places], "places", node.origin, DstT=wanted))
    return best


def _cumulate(builder: GraphBuilder, node: Node) -> str:
    """Cumsum, which not all targets have: each element with those before it, summed up."""
    tensor, operand = (normal_ref(r) for r in node.inputs)
    exclusive, reverse = (bool(node.attrs.get(key, False)) for key in ("exclusive", "reverse"))
    try:
        axis = int(builder.known_value(operand, "its axis").reshape(()))

        def layer(b: Builder, x: str) -> list[str]:
            made = cumulate(b, last(b, x, b.axis(x, axis)), exclusive=exclusive, reverse=reverse)
            return [moved_back(b, made, b.axis(x, axis))]

        (result,) = builder.write([tensor], layer, node.name)
    except UnsupportedOpError as error:
        what = f"cannot convert {node.op} (node {node.name!r}): {error.what}"
        raise UnsupportedOpError(what, issues=[(node.name, node.op)], why=error.why) from error
    return result


def _reverse(builder: GraphBuilder, node: Node) -> str:
    """ReverseV2 of given axes, which no ONNX op is: a StridedSlice that goes backwards."""
    tensor, operand = node.inputs
    constant = builder.constant_of(operand)
    axes = [] if constant is None else [int(a) for a in constant.reshape(-1)]
    if constant is None or min(axes, default=0) < 0 or max(axes, default=0) > _MAX_AXIS:
        raise UnsupportedOpError(
            f"cannot convert ReverseV2 (node {node.name!r}) along {axes or 'axes that are computed'}",
            issues=[(node.name, node.op)],
        )
    if not axes:
        return tensor
    count, mask = max(axes) + 1, (1 << (max(axes) + 1)) - 1
    steps = np.array([-1 if i in axes else 1 for i in range(count)], INT32)
    zeros = np.zeros(count, INT32)
    bounds = [builder.const(a, k) for a, k in ((zeros, "begin"), (zeros, "end"), (steps, "steps"))]
    return builder.add("StridedSlice", [tensor, *bounds], "reversed", node.origin, begin_mask=mask, end_mask=mask)


def _broadcast_args(builder: GraphBuilder, node: Node) -> str:
    """BroadcastArgs, the shape that two broadcast to: the larger lengths, ones before the shorter shape."""
    shapes = list(node.inputs)
    counts = [builder.add("Size", [s], "count", out_type=INT32) for s in shapes]
    longer = builder.add("Maximum", counts, "longer")
    wide = []
    for shape, count in zip(shapes, counts, strict=True):
        missing = builder.add("Sub", [longer, count], "missing")
        vector = builder.add("Pack", [missing], "vector", axis=0)
        one = builder.const(np.ones((), _dtype(node) if "T" in node.attrs else INT32), "one")
        ones = builder.add("Fill", [vector, one], "ones")
        axis = builder.ints(0, "axis")
        wide.append(builder.add("ConcatV2", [ones, shape, axis], "wide"))
    return builder.add("Maximum", wide, "shape", node.origin)


def _uniform_int(builder: GraphBuilder, node: Node) -> str:
    """RandomUniformInt of low to high - 1, as the floor of a uniform number; up to high - low = 2^24 none is missed."""
    shape, low, high = node.inputs
    dtype = node.attrs.get("Tout", INT32)
    count = builder.add("Sub", [high, low], "count")
    drawn = builder.add("RandomUniform", [shape], "RandomUniform", seed=0, seed2=0, dtype=FLOAT32)
    scale = builder.add("Cast", [count], "scale", DstT=FLOAT32)
    whole = builder.add("Floor", [builder.add("Mul", [drawn, scale], "scaled")], "floor")
    return builder.add("Add", [builder.add("Cast", [whole], "number", DstT=dtype), low], "drawn", node.origin)


def _op_written_older(name: str, older: Older, *spellings: str) -> OpDef:
    return OpDef(name, written_as_older, older=older, spellings=spellings)


OPS = (
    _op_written_older("DivNoNan", _div_no_nan),
    _op_written_older("FusedBatchNorm", _batch_norm, "FusedBatchNormV2", "FusedBatchNormV3"),
    _op_written_older("Concat", _concat_v1, "ConcatV1"),
    _op_written_older("IdentityN", _identity_n),
    _op_written_older("Einsum", _einsum),
    _op_written_older("Erfc", _erfc),
    _op_written_older("IsNan", _is_nan),
    _op_written_older("IsFinite", _compared_with_largest("LessEqual")),
    _op_written_older("IsInf", _compared_with_largest("Greater")),
    _op_written_older("TopKV2", _top_k, "TopK"),
    _op_written_older("Cumsum", _cumulate),
    _op_written_older("ReverseV2", _reverse),
    _op_written_older("BroadcastArgs", _broadcast_args),
    _op_written_older("RandomUniformInt", _uniform_int),
    OpDef(
        "PlaceholderWithDefault",
        written_as_older,
        attrs=(Attr("dtype", "type", derive="in:0"), Attr("shape", "shape", TensorShape(None))),
        older=_default,
        start="fed",
    ),
)
