"""Ops as all TensorFlow generations spell them: graphs, what they are fed, and what TensorFlow runs in their place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.graph.nodes import TensorShape
from export_model.converters.graph.types import BOOL, FLOAT32, INT64
from tests.graph.harness import Array
from tests.graph.samples import INF, NAN, bools, f32, floats, ints
from tests.handmade import constant, node, placeholder

#: What is read, what is fed, and what TensorFlow runs if that is not the same; the result is called "y".
Case = tuple[Sequence[Any], Mapping[str, Array], Sequence[Any] | None]

F32 = np.float32
IMAGE, TURNED = floats(2, 7, 6, 3), np.ascontiguousarray(floats(2, 7, 6, 3).transpose(0, 3, 1, 2))
KERNEL = floats(3, 2, 3, 4, seed=1)
ODD = f32(NAN, INF, -INF, 0.5, 3, -3).reshape(2, 3)


def layer_norm(scale: float = 1.0) -> Case:
    """LayerNormalization as Keras 2 writes it: rows as the channels of one image."""
    x = floats(5, 6)
    nodes = [
        placeholder("x", (None, 6)),
        *(constant("one", 1), constant("rows", 5), constant("n", 6), constant("empty", np.zeros(0, F32))),
        *(constant("f1", scale), constant("f0", 0.0), constant("back", [5, 6])),
        node("shape", "Pack", "one", "rows", "n", "one", T=np.int32, N=4, axis=0),
        node("image", "Reshape", "x", "shape", T=F32, Tshape=np.int32),
        node("count", "Pack", "rows", T=np.int32, N=1, axis=0),
        *(node(n, "Fill", "count", v, T=F32, index_type=np.int32) for n, v in (("scale", "f1"), ("offset", "f0"))),
        node("normal", "FusedBatchNormV3", "image", "scale", "offset", "empty", "empty", T=F32, U=F32, epsilon=0.001,
             data_format="NCHW", is_training=True, exponential_avg_factor=1.0),
        node("y", "Reshape", "normal", "back", T=F32, Tshape=np.int32),
    ]  # fmt: skip
    return nodes, {"x": x}, None


def unary(op: str, x: Array = ODD, **attrs: Any) -> Case:
    return [placeholder("x", (None, *x.shape[1:]), x.dtype), node("y", op, "x", T=x.dtype, **attrs)], {"x": x}, None


def binary(op: str, x: Array, second: Array, **attrs: Any) -> Case:
    nodes = [placeholder("x", (None, *x.shape[1:]), x.dtype), constant("c", second, second.dtype)]
    return [*nodes, node("y", op, "x", "c", **{"T": x.dtype, **attrs})], {"x": x}, None


def select(condition: Array, a: Array, b: Array) -> Case:
    nodes = [placeholder("c", (None, *condition.shape[1:]), np.bool_), placeholder("a", (None, *a.shape[1:]), a.dtype)]
    made = node("y", "SelectV2", "c", "a", "b", T=a.dtype)
    return [*nodes, constant("b", b, b.dtype), made], {"c": condition, "a": a}, None


def batch_norm(op: str, image: Array, **attrs: Any) -> Case:
    statistics = [constant(n, floats(3, seed=i, low=0.5)) for i, n in enumerate(("scale", "offset", "mean", "var"))]
    if op != "FusedBatchNorm":
        attrs["U"] = F32
    made = node("y", op, "x", "scale", "offset", "mean", "var", **{"T": F32, "is_training": False, **attrs})
    return [placeholder("x", (None, *image.shape[1:])), *statistics, made], {"x": image}, None


def window(op: str, layout: str, *, kernel: Array | None = None, **attrs: Any) -> Case:
    """NCHW, judged by the NHWC op between two transposes: TensorFlow's CPU kernels know no other."""
    sizes = {key: value for key, value in attrs.items() if key in ("strides", "ksize", "dilations")}
    attrs |= {"T": F32, "data_format": layout}
    extra = [] if kernel is None else [constant("kernel", kernel)]
    inputs = [n.name for n in extra]
    fed = placeholder("x", (None, 3, 7, 6))
    nchw = {key: (n, c, h, w) for key, (n, h, w, c) in sizes.items()}
    read = [fed, *extra, node("y", op, "x", *inputs, **{**attrs, **nchw})]
    oracle = [
        fed,
        *extra,
        constant("to", np.array([0, 2, 3, 1], np.int32)),
        constant("back", np.array([0, 3, 1, 2], np.int32)),
        node("turned", "Transpose", "x", "to", T=F32, Tperm=np.int32),
        node("inner", op, "turned", *inputs, **{**attrs, "data_format": "NHWC"}),
        node("y", "Transpose", "inner", "back", T=F32, Tperm=np.int32),
    ]
    return read, {"x": TURNED}, oracle


def in_groups(kernel: Array, **attrs: Any) -> Case:
    nodes = [placeholder("x", (None, 7, 6, 4)), constant("k", kernel)]
    made = node("y", "Conv2D", "x", "k", T=F32, **{"strides": (1, 1, 1, 1), "padding": "SAME", **attrs})
    return [*nodes, made], {"x": floats(2, 7, 6, 4)}, None


def dilated(op: str, kernel: Array, pads: Sequence[Any], crops: Sequence[Any], block: Sequence[int] = (2, 3)) -> Case:
    """A dilated convolution as TensorFlow writes it."""
    operands = {"block": block, "pads": pads, "crops": crops}
    nodes = [placeholder("x", (None, 7, 6, 3)), constant("k", kernel)]
    nodes += [constant(name, np.array(value, np.int32)) for name, value in operands.items()]
    types = {"T": F32, "Tblock_shape": np.int32}
    return (
        [
            *nodes,
            node("rows", "SpaceToBatchND", "x", "block", "pads", Tpaddings=np.int32, **types),
            node("made", op, "rows", "k", T=F32, strides=(1, 1, 1, 1), padding="VALID"),
            node("y", "BatchToSpaceND", "made", "block", "crops", Tcrops=np.int32, **types),
        ],
        {"x": IMAGE},
        None,
    )


def cut_into_blocks() -> Case:
    operands = {"block": [2, 3], "pads": [[0, 1], [3, 0]]}
    nodes = [placeholder("x", (None, 7, 6, 3)), *(constant(k, np.array(v, np.int32)) for k, v in operands.items())]
    types = {"T": F32, "Tblock_shape": np.int32, "Tpaddings": np.int32}
    return [*nodes, node("y", "SpaceToBatchND", "x", "block", "pads", **types)], {"x": IMAGE}, None


def put_together() -> Case:
    operands = {"block": [2, 3], "crops": [[0, 1], [3, 0]]}
    nodes = [placeholder("x", (None, 3, 2, 3)), *(constant(k, np.array(v, np.int32)) for k, v in operands.items())]
    types = {"T": F32, "Tblock_shape": np.int32, "Tcrops": np.int32}
    return [*nodes, node("y", "BatchToSpaceND", "x", "block", "crops", **types)], {"x": floats(12, 3, 2, 3)}, None


def dilated_sequence() -> Case:
    nodes = [placeholder("x", (None, 9, 3)), constant("k", floats(1, 3, 3, 4)), constant("b", f32(1, 2, 3, 4))]
    nodes += [constant("axis", -3), constant("block", np.array([2], np.int32))]
    nodes += [constant("pads", np.array([[2, 3]], np.int32)), constant("crops", np.array([[0, 1]], np.int32))]
    types = {"T": F32, "Tblock_shape": np.int32}
    return (
        [
            *nodes,
            node("rows", "SpaceToBatchND", "x", "block", "pads", Tpaddings=np.int32, **types),
            node("image", "ExpandDims", "rows", "axis", T=F32, Tdim=np.int32),
            node("made", "Conv2D", "image", "k", T=F32, strides=(1, 1, 1, 1), padding="VALID"),
            node("biased", "BiasAdd", "made", "b", T=F32),
            node("flat", "Squeeze", "biased", T=F32, squeeze_dims=(1,)),
            node("y", "BatchToSpaceND", "flat", "block", "crops", Tcrops=np.int32, **types),
        ],
        {"x": floats(2, 9, 3)},
        None,
    )


def transposed(result: Sequence[int], **attrs: Any) -> Case:
    """The batch is computed, as Keras does."""
    nodes = [placeholder("x", (None, 5, 4, 3)), constant("k", floats(3, 4, 2, 3)), constant("axis", 0)]
    nodes += [constant(f"n{i}", n) for i, n in enumerate((*result, 2))]
    nodes += [constant(name, np.array([n], np.int32)) for name, n in (("begin", 0), ("end", 1), ("step", 1))]
    numbers = {"T": np.int32, "Index": np.int32}
    nodes += [
        node("shape", "Shape", "x", T=F32, out_type=np.int32),
        node("rows", "StridedSlice", "shape", "begin", "end", "step", shrink_axis_mask=1, **numbers),
        node("sizes", "Pack", "rows", "n0", "n1", "n2", T=np.int32, N=4, axis=0),
    ]
    made = node("y", "Conv2DBackpropInput", "sizes", "k", "x", T=F32, **{"padding": "SAME", **attrs})
    return [*nodes, made], {"x": floats(2, 5, 4, 3)}, None


def explicit(op: str) -> Case:
    attrs = {"strides": (1, 2, 2, 1), "padding": "EXPLICIT", "explicit_paddings": (0, 0, 1, 2, 0, 3, 0, 0)}
    nodes = [placeholder("x", (None, 7, 6, 3)), constant("k", KERNEL)]
    return [*nodes, node("y", op, "x", "k", T=F32, **attrs)], {"x": IMAGE}, None


def concat() -> Case:
    nodes = [placeholder("a", (None, 2)), placeholder("b", (None, 3)), constant("axis", 1)]
    made = node("y", "Concat", "axis", "a", "b", T=F32, N=2)
    return [*nodes, made], {"a": floats(2, 2), "b": floats(2, 3, seed=1)}, None


def with_default() -> Case:
    default = node("p", "PlaceholderWithDefault", "d", dtype=F32, shape=TensorShape((2,)))
    made = node("y", "Mul", "p", "x", T=F32)
    return [constant("d", f32(2, 3)), default, placeholder("x", (None, 2)), made], {"x": floats(3, 2)}, None


def bundled() -> Case:
    """tf.nn.swish as frozen graphs have it (an IdentityN with its custom gradient), and one behind its outputs."""
    fed = placeholder("x", (None, 3))
    nodes = [fed, node("s", "Sigmoid", "x", T=F32), node("m", "Mul", "x", "s", T=F32)]
    swish = node("swish", "IdentityN", "m", "x", T=(F32, F32))
    count = node("count", "Shape", "x", T=F32, out_type=np.int32)
    both = node("both", "IdentityN", "swish:1", "count", "swish", T=(F32, np.int32, F32))
    sized = node("size", "Cast", "both:1", SrcT=np.int32, DstT=F32)
    difference = node("d", "Sub", "both", "both:2", T=F32)
    extra = [constant("axis", 0), node("sum", "Sum", "size", "axis", T=F32, Tidx=np.int32)]
    return (
        [*nodes, swish, count, both, sized, difference, *extra, node("y", "Add", "d", "sum", T=F32)],
        {"x": floats(2, 3)},
        None,
    )


def broadcast(rows: Array, dtype: np.dtype) -> Case:
    nodes = [placeholder("x", (None, 3), dtype), placeholder("like", (None, 3))]
    wide = node("shape", "Shape", "like", T=F32, out_type=np.int32)
    return (
        [*nodes, wide, node("y", "BroadcastTo", "x", "shape", T=dtype)],
        {"x": rows[None], "like": floats(4, 3)},
        None,
    )


def divided(x: Array, y: Array) -> Case:
    nodes = [placeholder("a", (None, *x.shape[1:])), placeholder("b", (None, *y.shape[1:]))]
    return [*nodes, node("y", "DivNoNan", "a", "b", T=F32)], {"a": x, "b": y}, None


def summed(equation: str, *operands: Array) -> Case:
    names = "ab"[: len(operands)]
    nodes = [placeholder(n, (None, *a.shape[1:])) for n, a in zip(names, operands, strict=True)]
    made = node("y", "Einsum", *names, equation=equation, N=len(operands), T=F32)
    return [*nodes, made], dict(zip(names, operands, strict=True)), None


def largest(x: Array, k: int, **attrs: Any) -> Case:
    """Both results of TopKV2 in one: the values, and under them the places."""
    made = node("top", "TopKV2", "x", "k", T=x.dtype, sorted=True, **attrs)
    places = node("places", "Cast", "top:1", SrcT=attrs.get("index_type", np.int32), DstT=x.dtype)
    joined = node("y", "ConcatV2", "top", "places", "axis", T=x.dtype, N=2, Tidx=np.int32)
    fed = placeholder("x", (None, *x.shape[1:]), x.dtype)
    return [fed, constant("k", k), made, places, constant("axis", -1), joined], {"x": x}, None


def largest_of_old(x: Array, k: int) -> Case:
    read, feeds, _ = largest(x, k)
    old = [node("top", "TopK", "x", T=x.dtype, sorted=True, k=k) if n.name == "top" else n for n in read]
    return [n for n in old if n.name != "k"], feeds, read


def shape_of_both(a: Array, b: Array) -> Case:
    nodes = [placeholder(n, (None, *x.shape[1:])) for n, x in (("a", a), ("b", b))]
    shapes = [node(f"s{n}", "Shape", n, T=F32, out_type=np.int32) for n in "ab"]
    return [*nodes, *shapes, node("y", "BroadcastArgs", "sa", "sb", T=np.int32)], {"a": a, "b": b}, None


def added_up(axis: int, **attrs: Any) -> Case:
    nodes = [placeholder("x", (None, 3, 4)), constant("axis", axis)]
    return [*nodes, node("y", "Cumsum", "x", "axis", T=F32, Tidx=np.int32, **attrs)], {"x": floats(2, 3, 4)}, None


def turned(*axes: int) -> Case:
    nodes = [placeholder("x", (None, 3, 4)), constant("axes", np.array(axes, np.int32))]
    return [*nodes, node("y", "ReverseV2", "x", "axes", T=F32, Tidx=np.int32)], {"x": floats(2, 3, 4)}, None


STRIDED = {"strides": (1, 1, 2, 1), "padding": "SAME"}
POOLED = {**STRIDED, "ksize": (1, 3, 2, 1)}
CASES: Mapping[str, Case] = {
    "AddV2": binary("AddV2", floats(3, 4), floats(4, seed=1)),
    "Div": binary("Div", floats(3, 4), f32(1, -2, 3, 0)),
    "Inv": unary("Inv", floats(3, 4)),
    "BatchMatMulV2": binary("BatchMatMulV2", floats(1, 3, 4), floats(1, 5, 4), adj_x=False, adj_y=True),
    "BatchMatMulV3": binary("BatchMatMulV3", floats(1, 3, 4), floats(1, 4, 5), Ta=F32, Tb=F32, Tout=F32),
    "ClipByValue": (
        [placeholder("x", (None, 3)), constant("l", -1.0), constant("h", 1.0), node("y", "ClipByValue", *"xlh", T=F32)],
        {"x": ODD},
        None,
    ),
    "BroadcastTo": broadcast(f32(-0.0, 1, NAN), FLOAT32),
    "BroadcastTo, bool": broadcast(np.array([True, False, True]), BOOL),
    "BroadcastTo, int64": broadcast(ints(3, dtype=np.int64), INT64),
    "LeakyRelu": unary("LeakyRelu"),
    "LeakyRelu, slope 0.01": unary("LeakyRelu", alpha=0.01),
    "LeakyRelu, slope above 1": unary("LeakyRelu", alpha=1.5),
    "LeakyRelu, negative slope": unary("LeakyRelu", floats(2, 3), alpha=-0.5),
    "LeakyRelu, float64": unary("LeakyRelu", floats(2, 3).astype(np.float64)),
    "SelectV2, column": select(bools(2, 1), ODD, f32(1, NAN, INF)),
    "SelectV2, wider condition": select(bools(2, 3), floats(2, 1), floats(3)),
    "SelectV2, int32": select(bools(2, 1), ints(2, 3), ints(3, seed=1)),
    "SelectV2, int64": select(bools(2, 3), ints(2, 1, dtype=np.int64), ints(3, dtype=np.int64)),
    "SelectV2, bool": select(bools(2, 1, seed=1), bools(2, 3), np.array([True, False, True])),
    "SelectV2, float64": select(bools(2, 1), floats(2, 3).astype(np.float64), floats(3).astype(np.float64)),
    "DivNoNan": divided(f32(1, 2, 0, -3).reshape(2, 2), f32(0, -4, 0, -0.0).reshape(2, 2)),
    "DivNoNan, odd": divided(ODD, f32(0, 0, 0, NAN, INF, 2).reshape(2, 3)),
    "DivNoNan, column": divided(floats(2, 3), f32(0, 2).reshape(2, 1)),
    "DivNoNan, row": divided(floats(2, 1), f32(0, 2, 0, -1).reshape(2, 2)),
    "FusedBatchNorm": batch_norm("FusedBatchNorm", IMAGE),
    "FusedBatchNormV2": batch_norm("FusedBatchNormV2", IMAGE, epsilon=0.1),
    "FusedBatchNormV3": batch_norm("FusedBatchNormV3", IMAGE, epsilon=0.01),
    "FusedBatchNormV3, Keras' LayerNormalization": layer_norm(),
    "FusedBatchNormV3, NCHW": batch_norm("FusedBatchNormV3", TURNED, epsilon=0.01, data_format="NCHW"),
    "Einsum": summed("abc,cde->abde", floats(2, 3, 4), floats(4, 2, 3)),
    "Einsum, of attention": summed("aecd,abcd->acbe", floats(2, 3, 2, 4), floats(2, 5, 2, 4)),
    "Einsum, no result but a sum": summed("ab,ab->", floats(2, 3), floats(2, 3, seed=1)),
    "Einsum, one operand": summed("abc->ca", floats(2, 3, 4)),
    "Einsum, all axes before": summed("...ij,...jk->...ik", floats(2, 3, 4, 2), floats(2, 3, 2, 5, seed=1)),
    "Einsum, axes of one operand": summed("...i,ij->...j", floats(2, 3, 4), floats(4, 5, seed=1)),
    "Einsum, axes behind": summed("ij...->...ji", floats(2, 3, 4, 5)),
    "Einsum, no axes": summed("...ij,...jk->...ik", floats(2, 3), floats(3, 4, seed=1)),
    "Einsum, fewer axes and one of length 1": summed("i...,i...->i...", floats(2, 3, 4), floats(2, 1, seed=1)),
    "IsNan": unary("IsNan"),
    "IsInf": unary("IsInf"),
    "IsFinite": unary("IsFinite", np.append(ODD, f32(3.4028235e38, -3.4028235e38, 1e-45)[None], axis=0)),
    "IsFinite, float64": unary("IsFinite", np.array([[1e300, np.inf, np.nan]])),
    "IsInf, float64": unary("IsInf", np.array([[1e300, -np.inf, np.nan]])),
    "TopKV2": largest(floats(3, 6), 4),
    "TopKV2, one": largest(floats(3, 6), 1),
    "TopKV2, equal ones": largest(f32(1, 3, 3, 2, 3, 1).reshape(1, 6), 5),
    "TopKV2, int32": largest(ints(2, 3, 5), 2),
    "TopKV2, float64": largest(floats(2, 5).astype(np.float64), 2),
    "TopKV2, int64 places": largest(floats(2, 5), 3, Tk=np.int32, index_type=np.int64),
    "Cumsum": added_up(1),
    "Cumsum, exclusive": added_up(-1, exclusive=True),
    "Cumsum, in reverse": added_up(2, reverse=True, exclusive=True),
    "TopK": largest_of_old(floats(3, 6), 2),
    "Erfc": unary("Erfc"),
    "ReverseV2": turned(1),
    "ReverseV2, two axes": turned(2, 0),
    "ReverseV2, none": turned(),
    "BroadcastArgs": shape_of_both(floats(2, 1, 4), floats(1, 3, 1)),
    "BroadcastArgs, unlike ranks": shape_of_both(floats(3), floats(2, 3)),
    "Concat": concat(),
    "IdentityN": bundled(),
    "Conv2D, NCHW": window("Conv2D", "NCHW", kernel=KERNEL, **STRIDED),
    "Conv2D, NCHW, dilated": window(
        "Conv2D", "NCHW", kernel=KERNEL, strides=(1, 1, 1, 1), dilations=(1, 1, 2, 1), padding="VALID"
    ),
    "DepthwiseConv2dNative, NCHW": window(
        "DepthwiseConv2dNative", "NCHW", kernel=KERNEL, strides=(1, 2, 2, 1), padding="SAME"
    ),
    "MaxPool, NCHW": window("MaxPool", "NCHW", **POOLED),
    "AvgPool, NCHW": window("AvgPool", "NCHW", **POOLED),
    "BiasAdd, NCHW": binary("BiasAdd", TURNED, f32(1, 2, 3), data_format="NCHW"),
    "Conv2D, two groups": in_groups(floats(3, 2, 2, 6), strides=(1, 2, 1, 1)),
    "Conv2D, a group for each channel": in_groups(floats(2, 2, 1, 8), padding="VALID"),
    "Conv2DBackpropInput": transposed((10, 8), strides=(1, 2, 2, 1)),
    "Conv2DBackpropInput, an odd size": transposed((9, 7), strides=(1, 2, 2, 1)),
    "Conv2DBackpropInput, VALID": transposed((11, 10), strides=(1, 2, 2, 1), padding="VALID"),
    "Conv2DBackpropInput, VALID and more": transposed((12, 11), strides=(1, 2, 2, 1), padding="VALID"),
    "Conv2DBackpropInput, wide strides": transposed((20, 12), strides=(1, 4, 3, 1)),
    "SpaceToBatchND": cut_into_blocks(),
    "BatchToSpaceND, alone": put_together(),
    "BatchToSpaceND": dilated("Conv2D", KERNEL, [[0, 1], [0, 0]], [[0, 1], [0, 0]]),
    "BatchToSpaceND, SAME": dilated("Conv2D", KERNEL, [[2, 3], [3, 3]], [[0, 1], [0, 0]]),
    "BatchToSpaceND, more cut off than was added": dilated("Conv2D", KERNEL, [[0, 1], [3, 3]], [[1, 1], [4, 0]]),
    "BatchToSpaceND, each channel": dilated("DepthwiseConv2dNative", KERNEL, [[0, 1], [0, 0]], [[0, 1], [0, 0]]),
    "BatchToSpaceND, a sequence": dilated_sequence(),
    "Conv2D, EXPLICIT": explicit("Conv2D"),
    "DepthwiseConv2dNative, EXPLICIT": explicit("DepthwiseConv2dNative"),
    "PlaceholderWithDefault": with_default(),
}
