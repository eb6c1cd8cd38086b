"""One spelling for everything: ops, attributes and layouts of all TensorFlow generations to those of TF 1.4.

Precondition: a pruned graph as the reader gave it. Postcondition: every op stands in the op table (or is control
flow), attributes are complete with their defaults, no attribute that TF 1.4 lacks differs from its default but
``dilations`` and ``output_dtype``, images are NHWC, and no op is left that TF 1.4 cannot express in others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from converters.graph.editor import Editor
from converters.graph.nodes import Graph, Node, TensorShape, normal_ref, ref
from converters.graph.ops.base import REQUIRED
from converters.graph.ops.table import CONTROL_FLOW, TABLE, op_of, unsupported
from converters.graph.types import BOOL, FLOAT32, INT64
from signatures.errors import GraphError, UnsupportedOpError

#: Ops that later versions renamed; the meaning is the same for the inputs that policies give them.
RENAMED = {
    "AddV2": "Add",
    "Div": "RealDiv",
    "Inv": "Reciprocal",
    "BatchMatMulV2": "BatchMatMul",
    "BatchMatMulV3": "BatchMatMul",
    "Unstack": "Unpack",
    "PlaceholderV2": "Placeholder",
    "ConcatV1": "Concat",
}
_TO_NCHW, _TO_NHWC = np.array([0, 3, 1, 2], np.int32), np.array([0, 2, 3, 1], np.int32)
_WINDOW_OPS = ("Conv2D", "DepthwiseConv2dNative", "MaxPool", "AvgPool", "BiasAdd")

Rewrite = Callable[[Editor, Node], str]


def normalise(graph: Graph) -> Graph:
    """See the module. Raises UnsupportedOpError that names every node whose op is unknown."""
    renamed = [replace(n, op=RENAMED.get(n.op, n.op)) for n in graph.nodes]
    unknown = [n for n in renamed if n.op not in TABLE and n.op not in CONTROL_FLOW and n.op not in DECOMPOSED]
    if unknown:
        raise unsupported(unknown)
    editor = Editor(graph)
    for node in renamed:
        if node.op in CONTROL_FLOW:
            editor.keep(node)
        elif node.op in DECOMPOSED:
            editor.redirect(node.name, DECOMPOSED[node.op](editor, node))
        else:
            _take(editor, _completed(node))
    return editor.graph()


def _completed(node: Node) -> Node:
    """Attributes filled with defaults, derived ones dropped, unsupported ones refused."""
    attrs: dict[str, Any] = {}
    known = {a.name: a for a in op_of(node).attrs}
    for name, attr in known.items():
        given = node.attrs.get(name)
        if attr.derive is not None:
            continue
        if given is None:
            if attr.default is REQUIRED:
                raise GraphError(
                    f"node {node.name!r} ({node.op}) lacks the attribute {name!r}",
                    why="the op cannot be computed without it",
                    fix="the graph is damaged; freeze it again from its checkpoint",
                )
            given = attr.default
        if attr.kind == "type" and not isinstance(given, np.dtype):
            raise GraphError(
                f"node {node.name!r} ({node.op}) has {name}={given!r}, which is no dtype",
                fix="the graph is damaged; freeze it again from its checkpoint",
            )
        if not attr.supported and given != attr.default and not (name == "explicit_paddings" and not any(given)):
            if name == "explicit_paddings" and node.attrs.get("padding") == "EXPLICIT":
                attrs[name] = given
                continue
            raise UnsupportedOpError(
                f"cannot convert {node.op} (node {node.name!r}) with {name}={given!r}",
                issues=[(node.name, node.op)],
                why="no kernel here computes that variant, and the older runtimes do not know the attribute",
                fix="please open an issue with the graph",
            )
        attrs[name] = given if attr.supported else attr.default
    return replace(node, attrs=attrs)


def _take(editor: Editor, node: Node) -> None:
    """Keep a node, its padding and layout brought to the one form that all targets share."""
    if node.op == "Multinomial" and node.attrs["output_dtype"] != INT64:
        _draw_int64(editor, node)
        return
    if node.attrs.get("padding") == "EXPLICIT":
        node = _split_padding(editor, node)
    if node.op in _WINDOW_OPS and node.attrs.get("data_format") == "NCHW":
        _turn_round(editor, node)
    elif node.op in _WINDOW_OPS and node.attrs.get("data_format") != "NHWC":
        raise UnsupportedOpError(
            f"cannot convert {node.op} (node {node.name!r}) with data_format={node.attrs.get('data_format')!r}",
            issues=[(node.name, node.op)],
            why="only NHWC and NCHW images occur in policies",
        )
    else:
        editor.keep(node)


def _draw_int64(editor: Editor, node: Node) -> None:
    """A draw of int32 as a Cast of one of int64: TF 1.4 has no output_dtype."""
    wide = {**node.attrs, "output_dtype": INT64}
    drawn = editor.add("Multinomial", node.inputs, f"{node.name}/int64", node.origin, **wide)
    narrow = editor.add("Cast", [drawn], f"{node.name}/narrow", node.origin, DstT=node.attrs["output_dtype"])
    editor.redirect(node.name, narrow)


def _split_padding(editor: Editor, node: Node) -> Node:
    """padding=EXPLICIT as a Pad before a VALID window (TF 1.x has no explicit padding)."""
    if node.op == "MaxPool":
        raise UnsupportedOpError(
            f"cannot convert MaxPool (node {node.name!r}) with explicit padding", issues=[(node.name, node.op)]
        )
    pads = np.array(node.attrs["explicit_paddings"], np.int32).reshape(-1, 2)
    padded = editor.add("Pad", [node.inputs[0], editor.const(pads, f"{node.name}/pads")], f"{node.name}/pad")
    attrs = {**node.attrs, "padding": "VALID", "explicit_paddings": ()}
    return replace(node, inputs=(padded, *node.inputs[1:]), attrs=attrs)


def _turn_round(editor: Editor, node: Node) -> None:
    """An NCHW window op (graphs trained on GPUs) as NHWC between two transposes."""
    attrs = {**node.attrs, "data_format": "NHWC"}
    for key in ("strides", "ksize", "dilations"):
        if key in attrs:
            n, c, h, w = attrs[key]
            attrs[key] = (n, h, w, c)
    before = editor.add(
        "Transpose", [node.inputs[0], editor.const(_TO_NHWC, f"{node.name}/nhwc/perm")], f"{node.name}/nhwc"
    )
    inner = editor.add(node.op, [before, *node.inputs[1:]], f"{node.name}/inner", **attrs)
    after = editor.add(
        "Transpose", [inner, editor.const(_TO_NCHW, f"{node.name}/nchw/perm")], f"{node.name}/nchw", node.origin
    )
    editor.redirect(node.name, after)


# ------------------------------------------------------------------ ops that are written as others


def _dtype(node: Node) -> np.dtype:
    """The dtype of a node's operands, as GraphDefs say it."""
    given = node.attrs.get("T")
    return given if isinstance(given, np.dtype) else FLOAT32


def _clip(editor: Editor, node: Node) -> str:
    """ClipByValue (TF 1.8) = Maximum(Minimum(x, high), low), the order that tf.clip_by_value had before."""
    x, low, high = node.inputs
    upper = editor.add("Minimum", [x, high], f"{node.name}/Minimum")
    return editor.add("Maximum", [upper, low], f"{node.name}/Maximum", node.origin)


def _leaky_relu(editor: Editor, node: Node) -> str:
    """LeakyRelu (TF 1.8) = Maximum(x, alpha·x) for alpha ≤ 1, Minimum above."""
    alpha = float(node.attrs.get("alpha", 0.2))
    slope = editor.const(np.array(alpha, _dtype(node)), f"{node.name}/alpha")
    scaled = editor.add("Mul", [node.inputs[0], slope], f"{node.name}/mul")
    return editor.add(
        "Maximum" if alpha <= 1 else "Minimum", [node.inputs[0], scaled], f"{node.name}/leaky", node.origin
    )


def _div_no_nan(editor: Editor, node: Node) -> str:
    """DivNoNan: x / y, and where y is 0 the zeros of ZerosLike, whatever x is; y is broadcast by adding them."""
    x, y = node.inputs
    dtype = _dtype(node)
    quotient = editor.add("RealDiv", [x, y], f"{node.name}/quotient")
    zeros = editor.add("ZerosLike", [quotient], f"{node.name}/zeros")
    equal = editor.add("Equal", [y, editor.const(np.zeros((), dtype), f"{node.name}/0")], f"{node.name}/equal")
    as_number = editor.add("Cast", [equal], f"{node.name}/number", DstT=dtype)
    wide = editor.add("Add", [as_number, zeros], f"{node.name}/wide")
    is_zero = editor.add("Cast", [wide], f"{node.name}/is_zero", DstT=BOOL)
    return editor.add("Select", [is_zero, zeros, quotient], f"{node.name}/no_nan", node.origin)


def _select_v2(editor: Editor, node: Node) -> str:
    """SelectV2 (TF 1.14) as Select of operands broadcast by adding zeros; ZerosLike of NaN is zero."""
    condition, a, b = node.inputs
    dtype = _dtype(node)

    def cast(tensor: str, to: np.dtype, name: str) -> str:
        return editor.add("Cast", [tensor], f"{node.name}/{name}", DstT=to)

    as_float = cast(condition, FLOAT32, "float")
    zeros = editor.add("ZerosLike", [as_float], f"{node.name}/zeros")
    for side, tensor in (("a", a), ("b", b)):
        like = editor.add("ZerosLike", [tensor], f"{node.name}/zeros_{side}")
        like = like if dtype == FLOAT32 else cast(like, FLOAT32, f"zeros_{side}_float")
        zeros = editor.add("Add", [zeros, like], f"{node.name}/zeros_{side}_sum")
    wide = cast(editor.add("Add", [as_float, zeros], f"{node.name}/wide"), BOOL, "c")
    if dtype == BOOL:  # which Add does not take
        a, b = cast(a, FLOAT32, "a_float"), cast(b, FLOAT32, "b_float")
    elif dtype != FLOAT32:
        zeros = cast(zeros, dtype, "zeros_cast")
    left, right = (editor.add("Add", [t, zeros], f"{node.name}/{side}") for side, t in (("a", a), ("b", b)))
    if dtype == BOOL:
        left, right = cast(left, BOOL, "a_bool"), cast(right, BOOL, "b_bool")
    return editor.add("Select", [wide, left, right], f"{node.name}/select", node.origin)


def _batch_norm(editor: Editor, node: Node) -> str:
    """FusedBatchNorm at inference: (x − mean)·(scale/√(variance + ε)) + offset."""
    if node.attrs.get("is_training", True):
        raise UnsupportedOpError(
            f"cannot convert {node.op} (node {node.name!r}) in training mode",
            issues=[(node.name, node.op)],
            why="its statistics would come from the batch, so an agent's action would depend on the other agents",
            fix="freeze the graph with is_training=False",
        )
    x, scale, offset, mean, variance = node.inputs[:5]
    epsilon = editor.const(np.array(node.attrs.get("epsilon", 1e-4), np.float32), f"{node.name}/epsilon")
    deviation = editor.add("Sqrt", [editor.add("Add", [variance, epsilon], f"{node.name}/var_eps")], f"{node.name}/std")
    factor = editor.add("RealDiv", [scale, deviation], f"{node.name}/factor")
    nchw = node.attrs.get("data_format") == "NCHW"
    if nchw:
        x = editor.add("Transpose", [x, editor.const(_TO_NHWC, f"{node.name}/nhwc/perm")], f"{node.name}/nhwc")
    centred = editor.add("Sub", [x, mean], f"{node.name}/centred")
    scaled = editor.add("Mul", [centred, factor], f"{node.name}/scaled")
    result = editor.add("Add", [scaled, offset], f"{node.name}/y", node.origin)
    if nchw:
        perm = editor.const(_TO_NCHW, f"{node.name}/nchw/perm")
        result = editor.add("Transpose", [result, perm], f"{node.name}/nchw", node.origin)
    return result


def _concat_v1(editor: Editor, node: Node) -> str:
    """Concat (axis first) as ConcatV2 (axis last)."""
    return editor.add("ConcatV2", [*node.inputs[1:], node.inputs[0]], f"{node.name}/v2", node.origin)


def _identity_n(editor: Editor, node: Node) -> str:
    """IdentityN (TF 1.6), which custom gradients (tf.nn.swish) leave: each output is the input of its number."""
    first, *rest = (normal_ref(r) for r in node.inputs)
    for index, reference in enumerate(rest, 1):
        editor.redirect(ref(node.name, index), editor.resolve(reference))
    return editor.resolve(first)


def _default(editor: Editor, node: Node) -> str:
    """A PlaceholderWithDefault that is no input of the policy: its default."""
    return editor.resolve(normal_ref(node.inputs[0]))


DECOMPOSED: dict[str, Rewrite] = {
    "ClipByValue": _clip,
    "LeakyRelu": _leaky_relu,
    "DivNoNan": _div_no_nan,
    "SelectV2": _select_v2,
    "FusedBatchNorm": _batch_norm,
    "FusedBatchNormV2": _batch_norm,
    "FusedBatchNormV3": _batch_norm,
    "Concat": _concat_v1,
    "IdentityN": _identity_n,
    "PlaceholderWithDefault": _default,
}


def as_placeholder(node: Node) -> Node:
    """A PlaceholderWithDefault that the policy's signature names, as a plain Placeholder."""
    return Node(
        node.name,
        "Placeholder",
        (),
        {"dtype": node.attrs.get("dtype", FLOAT32), "shape": node.attrs.get("shape", TensorShape(None))},
        origin=node.origin,
    )
