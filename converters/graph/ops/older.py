"""Ops that TensorFlow 1.4 lacks, or spelt otherwise, as nodes of ops that it has: the normalise pass asks for them."""

from __future__ import annotations

import numpy as np

from converters.graph.nodes import Node, TensorShape, normal_ref, ref
from converters.graph.ops.base import Attr, GraphBuilder, Older, OpDef, written_as_older
from converters.graph.types import BOOL, FLOAT32, INT32
from signatures.errors import UnsupportedOpError

TO_NCHW, TO_NHWC = np.array([0, 3, 1, 2], INT32), np.array([0, 2, 3, 1], INT32)


def _dtype(node: Node) -> np.dtype:
    """The dtype of a node's operands, as GraphDefs say it."""
    given = node.attrs.get("T")
    return given if isinstance(given, np.dtype) else FLOAT32


def clip(builder: GraphBuilder, node: Node) -> str:
    """ClipByValue (TF 1.8) = Maximum(Minimum(x, high), low), the order that tf.clip_by_value had before."""
    x, low, high = node.inputs
    upper = builder.add("Minimum", [x, high], f"{node.name}/Minimum")
    return builder.add("Maximum", [upper, low], f"{node.name}/Maximum", node.origin)


def leaky_relu(builder: GraphBuilder, node: Node) -> str:
    """LeakyRelu (TF 1.8) = Maximum(x, alpha·x) for alpha ≤ 1, Minimum above."""
    alpha = float(node.attrs.get("alpha", 0.2))
    slope = builder.const(np.array(alpha, _dtype(node)), f"{node.name}/alpha")
    scaled = builder.add("Mul", [node.inputs[0], slope], f"{node.name}/mul")
    return builder.add(
        "Maximum" if alpha <= 1 else "Minimum", [node.inputs[0], scaled], f"{node.name}/leaky", node.origin
    )


def _div_no_nan(builder: GraphBuilder, node: Node) -> str:
    """DivNoNan: x / y, and where y is 0 the zeros of ZerosLike, whatever x is; y is broadcast by adding them."""
    x, y = node.inputs
    dtype = _dtype(node)
    quotient = builder.add("RealDiv", [x, y], f"{node.name}/quotient")
    zeros = builder.add("ZerosLike", [quotient], f"{node.name}/zeros")
    equal = builder.add("Equal", [y, builder.const(np.zeros((), dtype), f"{node.name}/0")], f"{node.name}/equal")
    as_number = builder.add("Cast", [equal], f"{node.name}/number", DstT=dtype)
    wide = builder.add("Add", [as_number, zeros], f"{node.name}/wide")
    is_zero = builder.add("Cast", [wide], f"{node.name}/is_zero", DstT=BOOL)
    return builder.add("Select", [is_zero, zeros, quotient], f"{node.name}/no_nan", node.origin)


def select_v2(builder: GraphBuilder, node: Node) -> str:
    """SelectV2 (TF 1.14) as Select of operands broadcast by adding zeros; ZerosLike of NaN is zero."""
    condition, a, b = node.inputs
    dtype = _dtype(node)

    def cast(tensor: str, to: np.dtype, name: str) -> str:
        return builder.add("Cast", [tensor], f"{node.name}/{name}", DstT=to)

    as_float = cast(condition, FLOAT32, "float")
    zeros = builder.add("ZerosLike", [as_float], f"{node.name}/zeros")
    for side, tensor in (("a", a), ("b", b)):
        like = builder.add("ZerosLike", [tensor], f"{node.name}/zeros_{side}")
        like = like if dtype == FLOAT32 else cast(like, FLOAT32, f"zeros_{side}_float")
        zeros = builder.add("Add", [zeros, like], f"{node.name}/zeros_{side}_sum")
    wide = cast(builder.add("Add", [as_float, zeros], f"{node.name}/wide"), BOOL, "c")
    if dtype == BOOL:  # which Add does not take
        a, b = cast(a, FLOAT32, "a_float"), cast(b, FLOAT32, "b_float")
    elif dtype != FLOAT32:
        zeros = cast(zeros, dtype, "zeros_cast")
    left, right = (builder.add("Add", [t, zeros], f"{node.name}/{side}") for side, t in (("a", a), ("b", b)))
    if dtype == BOOL:
        left, right = cast(left, BOOL, "a_bool"), cast(right, BOOL, "b_bool")
    return builder.add("Select", [wide, left, right], f"{node.name}/select", node.origin)


def _batch_norm(builder: GraphBuilder, node: Node) -> str:
    """FusedBatchNorm at inference: (x − mean)·(scale/√(variance + ε)) + offset."""
    if node.attrs.get("is_training", True):
        raise UnsupportedOpError(
            f"cannot convert {node.op} (node {node.name!r}) in training mode",
            issues=[(node.name, node.op)],
            why="its statistics would come from the batch, so an agent's action would depend on the other agents",
            fix="freeze the graph with is_training=False",
        )
    x, scale, offset, mean, variance = node.inputs[:5]
    epsilon = builder.const(np.array(node.attrs.get("epsilon", 1e-4), np.float32), f"{node.name}/epsilon")
    positive = builder.add("Add", [variance, epsilon], f"{node.name}/var_eps")
    deviation = builder.add("Sqrt", [positive], f"{node.name}/std")
    factor = builder.add("RealDiv", [scale, deviation], f"{node.name}/factor")
    nchw = node.attrs.get("data_format") == "NCHW"
    if nchw:
        x = builder.add("Transpose", [x, builder.const(TO_NHWC, f"{node.name}/nhwc/perm")], f"{node.name}/nhwc")
    centred = builder.add("Sub", [x, mean], f"{node.name}/centred")
    scaled = builder.add("Mul", [centred, factor], f"{node.name}/scaled")
    result = builder.add("Add", [scaled, offset], f"{node.name}/y", node.origin)
    if nchw:
        perm = builder.const(TO_NCHW, f"{node.name}/nchw/perm")
        result = builder.add("Transpose", [result, perm], f"{node.name}/nchw", node.origin)
    return result


def _concat_v1(builder: GraphBuilder, node: Node) -> str:
    """Concat (axis first) as ConcatV2 (axis last)."""
    return builder.add("ConcatV2", [*node.inputs[1:], node.inputs[0]], f"{node.name}/v2", node.origin)


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
        x = builder.add("Cast", [x], f"{node.name}/number", DstT=number)
    ones = builder.add("Fill", [shape, builder.const(np.ones((), number), f"{node.name}/one")], f"{node.name}/ones")
    wide = builder.add("Mul", [x, ones], f"{node.name}/wide", node.origin)
    return wide if dtype != BOOL else builder.add("Cast", [wide], f"{node.name}/bool", node.origin, DstT=BOOL)


def _spelt(name: str, older: Older, *spellings: str) -> OpDef:
    return OpDef(name, written_as_older, older=older, spellings=spellings)


OPS = (
    _spelt("DivNoNan", _div_no_nan),
    _spelt("FusedBatchNorm", _batch_norm, "FusedBatchNormV2", "FusedBatchNormV3"),
    _spelt("Concat", _concat_v1, "ConcatV1"),
    _spelt("IdentityN", _identity_n),
    OpDef(
        "PlaceholderWithDefault",
        written_as_older,
        attrs=(Attr("dtype", "type", derive="in:0"), Attr("shape", "shape", TensorShape(None))),
        older=_default,
        start="fed",
    ),
)
