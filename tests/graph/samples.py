"""Small graphs of one op each, for every op of the table, with what is fed to them.

An operand of a sample is an array that is fed (its leading axis is the batch), ``fixed`` (fed, no axis is free),
``any_size`` (fed, all axes but the last are free), ``const`` (known before the graph runs), ``via`` (the result of
another op) or the name of an operand before it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from converters.graph.nodes import Graph, Node, TensorShape, ref
from converters.graph.ops.table import TABLE
from converters.graph.types import BOOL, FLOAT32, INT32, INT64
from tests.graph.making import defaults

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class Sample:
    """One node of ``op``, called ``"op"``, and what is upstream of it."""

    op: str
    title: str
    nodes: tuple[Node, ...]
    feeds: Mapping[str, Array]
    outputs: int = 1
    #: runtime → why it gives something else there, or refuses; the tests hold that it does
    differs: Mapping[str, str] = field(default_factory=dict)
    #: elements are drawn at random: only dtype, shape and distribution can agree
    drawn: bool = False
    #: what TensorFlow runs, where it cannot run the graph itself
    oracle: Graph | None = None

    @property
    def graph(self) -> Graph:
        return Graph(self.nodes)

    @property
    def fetches(self) -> list[str]:
        return [ref("op", i) for i in range(self.outputs)]

    def with_shapes(self, known: Callable[[TensorShape, Array], TensorShape]) -> Graph:
        """The graph with placeholders of other shapes, made of the ones they have and what is fed to them."""
        return Graph(
            tuple(
                replace(n, attrs={**n.attrs, "shape": known(n.attrs["shape"], self.feeds[n.name])})
                if n.op == "Placeholder"
                else n
                for n in self.nodes
            )
        )


# ------------------------------------------------------------------ what runtimes do differently


TFJS = ("tfjs-cpu", "tfjs-wasm")
#: TensorFlow.js 4.22; none of these ops is left in a policy's graph when it is written.
NO_SUCH_OP = dict.fromkeys(TFJS, "TensorFlow.js has no such op")
NAN_LOST = "a NaN comes out as a number"
UNKNOWN_BATCH = {"onnxruntime": "the length of the batch is not known when the model is written"}
NO_LOWERING = {"onnxruntime": "it has no lowering"}


# ------------------------------------------------------------------ operands


@dataclass(frozen=True)
class Operand:
    array: Array
    kind: str


@dataclass(frozen=True)
class Via:
    op: str
    operands: tuple[Any, ...]
    attrs: Mapping[str, Any]
    output: int = 0


def fixed(array: Array) -> Operand:
    return Operand(array, "fixed")


def any_size(array: Array) -> Operand:
    """Fed, with only the length of the last axis known."""
    return Operand(array, "any size")


def const(*values: Any, dtype: Any = np.int32) -> Operand:
    """A constant: an array as it is, else integers as an int32 scalar or vector."""
    if len(values) == 1:
        value = values[0]
        return Operand(value if isinstance(value, np.ndarray) else np.array(value, dtype), "const")
    return Operand(np.array(values, dtype), "const")


def via(op: str, *operands: Any, output: int = 0, **attrs: Any) -> Via:
    return Via(op, operands, attrs, output)


def shape_of(operand: Any) -> Via:
    return via("Shape", operand, out_type=INT32)


class _Builder:
    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self.feeds: dict[str, Array] = {}

    def operand(self, operand: Any) -> str:
        if isinstance(operand, str):
            return operand
        if isinstance(operand, Via):
            inputs = tuple(self.operand(o) for o in operand.operands)
            name = f"n{len(self.nodes)}"
            self.nodes.append(Node(name, operand.op, inputs, {**defaults(operand.op), **operand.attrs}))
            return ref(name, operand.output)
        if isinstance(operand, np.ndarray):
            operand = Operand(operand, "fed")
        if operand.kind == "const":
            name = f"c{len(self.nodes)}"
            self.nodes.append(Node(name, "Const", value=operand.array))
            return name
        name = f"x{len(self.feeds)}"
        dims: list[int | None] = list(operand.array.shape)
        if operand.kind != "fixed":
            dims[:1] = [None] * len(dims[:1])
        if operand.kind == "any size":
            dims[:-1] = [None] * len(dims[:-1])
        attrs = {"dtype": operand.array.dtype, "shape": TensorShape(tuple(dims))}
        self.nodes.append(Node(name, "Placeholder", attrs=attrs))
        self.feeds[name] = operand.array
        return name


def sample(
    op: str,
    title: str,
    *operands: Any,
    outputs: int = 1,
    differs: Mapping[str, str] | None = None,
    drawn: bool = False,
    **attrs: Any,
) -> Sample:
    builder = _Builder()
    inputs = tuple(builder.operand(o) for o in operands)
    builder.nodes.append(Node("op", op, inputs, {**defaults(op), **attrs}))
    return Sample(op, title, tuple(builder.nodes), builder.feeds, outputs, differs or {}, drawn)


# ------------------------------------------------------------------ data


def floats(*shape: int, seed: int = 0, low: float = -2.0, high: float = 2.0) -> Array:
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def ints(*shape: int, seed: int = 0, low: int = -9, high: int = 9, dtype: Any = np.int32) -> Array:
    return np.random.default_rng(seed).integers(low, high, shape, endpoint=True).astype(dtype)


def bools(*shape: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).random(shape) < 0.5


def f32(*values: float) -> Array:
    return np.array(values, np.float32)


INF, NAN = math.inf, math.nan
HALVES = f32(-2.5, -1.5, -0.5, -0.0, 0.0, 0.5, 1.5, 2.5, 3.49, -3.51).reshape(5, 2)
EXTREMES = f32(-INF, -3e38, -1e4, -90.0, -1e-20, 0.0, 1e-20, 90.0, 1e4, 3e38, INF, NAN).reshape(4, 3)


# ------------------------------------------------------------------ elementwise


def _unary() -> Iterator[Sample]:
    wide = {"Exp", "Expm1", "Sigmoid", "Tanh", "Relu", "Relu6", "Elu", "Selu", "Softplus", "Erf"}
    plain = {"Neg", "Abs", "Sign", "Square"}
    for op in ("Sin", "Cos", "Tan", *sorted(wide | plain)):
        yield sample(op, "matrix", floats(3, 5, low=-4, high=4))
        yield sample(op, "rank 4", floats(2, 2, 3, 2, seed=1))
    lost = {
        "Relu6": {"tfjs-wasm": NAN_LOST},
        "Sign": {"tfjs-cpu": NAN_LOST, "tfjs-wasm": "numbers up to 1e-7 count as zero"},
    }
    for op in sorted(wide | plain):
        yield sample(op, "extremes", EXTREMES, differs=lost.get(op))
    for op in sorted(plain):
        yield sample(op, "int32", ints(4, 3))
    for op in ("Floor", "Ceil", "Round"):
        yield sample(op, "halves", HALVES)
        yield sample(op, "rank 1", floats(7, low=-1e4, high=1e4))
    for op in ("Log", "Sqrt", "Rsqrt", "Reciprocal", "Log1p"):
        yield sample(op, "positive", floats(3, 4, low=1e-3, high=9))
        yield sample(op, "outside of its domain", f32(-2, -0.5, 0, 1e-30, INF, NAN).reshape(3, 2))
    yield sample("Softsign", "matrix", floats(3, 5, low=-4, high=4))
    yield sample("Softsign", "large", f32(-1e30, -100, 0, 100, 1e30))
    yield sample("Log1p", "near zero", f32(1e-8, -1e-8, 1e-4, -1e-4).reshape(2, 2))
    yield sample("Expm1", "near zero", f32(1e-8, -1e-8, 1e-4, -1e-4).reshape(2, 2))
    for op in ("ZerosLike", "OnesLike"):
        yield sample(op, "float32", EXTREMES)
        yield sample(op, "int32", ints(2, 3))
        yield sample(op, "bool", bools(2, 3))
    yield sample("LogicalNot", "matrix", bools(3, 4))
    yield sample("LogicalNot", "rank 1", bools(5))
    yield sample("LeakyRelu", "default slope", floats(3, 4))
    yield sample("LeakyRelu", "slope 0.01", EXTREMES, alpha=0.01)
    yield sample("LeakyRelu", "slope above 1", floats(3, 4), alpha=1.5)


def _casts() -> Iterator[Sample]:
    for source, target in itertools.permutations((FLOAT32, INT32, INT64, BOOL), 2):
        values = f32(-2.7, -1.0, -0.4, 0.0, 0.6, 3.9).reshape(3, 2)
        array = values.astype(source) if source != INT64 else ints(3, 2, dtype=np.int64)
        yield sample("Cast", f"{source} to {target}", array, DstT=target)


def _binary() -> Iterator[Sample]:
    for op in ("Add", "Sub", "Mul", "RealDiv", "Maximum", "Minimum", "SquaredDifference"):
        yield sample(op, "same shape", floats(3, 4), floats(3, 4, seed=1))
        yield sample(op, "row", floats(3, 4), const(floats(4, seed=1)))
        yield sample(op, "outer", floats(3, 1), const(floats(1, 4, seed=1)))
        yield sample(op, "scalar on the left", const(f32(1.5).reshape(())), floats(2, 3, 2))
        yield sample(op, "not finite", EXTREMES, const(f32(INF, 0.0, -1.0)))
    for op in ("Add", "Sub", "Mul", "Maximum", "Minimum", "SquaredDifference", "FloorDiv", "FloorMod"):
        yield sample(op, "int32", ints(4, 3), const(ints(3, seed=3, low=1)))
    for op in ("FloorDiv", "FloorMod"):
        yield sample(op, "int32, signs", const(7, -7, 7, -7, 6, -6), fixed(np.array([3, 3, -3, -3, 2, -2], np.int32)))
        differs = {"tfjs-cpu": "the quotient is int32"} if op == "FloorDiv" else None
        yield sample(op, "float32", f32(5.5, -5.5, 5.5, -5.5, 6, 0).reshape(3, 2), const(f32(2, -2)), differs=differs)
    # numpy's own floor_divide says 9 and -10 here
    near = f32(1, -1).reshape(2, 1)
    yield sample(
        "FloorDiv", "float32, near an integer", near, const(f32(0.1)), differs={"tfjs-cpu": "the quotient is int32"}
    )
    yield sample("Pow", "positive base", floats(3, 4, low=0.1, high=3), floats(3, 4, seed=1))
    yield sample("Pow", "negative base", floats(3, 4, low=-3, high=-0.1), const(f32(2, 3, -1, 0.5)))
    yield sample("Pow", "zero", f32(0, 0, 0, 1).reshape(2, 2), const(f32(0, 2)))
    for op in ("Less", "LessEqual", "Greater", "GreaterEqual", "Equal", "NotEqual"):
        yield sample(op, "float32", f32(0, 1, 2, NAN, INF, -INF).reshape(3, 2), const(f32(1, NAN)))
        yield sample(op, "int32", ints(4, 3, low=0, high=2), const(np.array([[0, 1, 2]], np.int32)))
        yield sample(op, "int64", ints(4, 3, low=0, high=2, dtype=np.int64), const(1, dtype=np.int64))
    for op in ("LogicalAnd", "LogicalOr"):
        yield sample(op, "same shape", bools(3, 4), bools(3, 4, seed=1))
        yield sample(op, "row", bools(3, 4), const(bools(4, seed=1)))


def _several() -> Iterator[Sample]:
    yield sample("AddN", "one", floats(3, 4))
    yield sample("AddN", "three", floats(3, 4), floats(3, 4, seed=1), floats(3, 4, seed=2))
    yield sample("ClipByValue", "scalars", floats(3, 4), const(f32(-1).reshape(())), const(f32(1).reshape(())))
    yield sample(
        "ClipByValue",
        "not finite",
        EXTREMES,
        const(f32(-5).reshape(())),
        const(f32(5).reshape(())),
        differs={"tfjs-wasm": NAN_LOST},
    )
    a, b = floats(3, 4), floats(3, 4, seed=1)
    yield sample("Select", "same shape", bools(3, 4), a, b)
    yield sample("Select", "rows", np.array([True, False, True]), a, b)
    yield sample("Select", "rows of rank 3", np.array([True, False]), floats(2, 2, 3), floats(2, 2, 3, seed=1))
    yield sample("Select", "square, rows", np.array([True, False]), floats(2, 2), floats(2, 2, seed=1))
    yield sample("Select", "scalar condition", const(np.array(False)), a, b)
    yield sample("Select", "rank 1", bools(5), floats(5), floats(5, seed=1))
    yield sample("Select", "int32", bools(3, 4), ints(3, 4), ints(3, 4, seed=1))
    yield sample("SelectV2", "same shape", bools(3, 4), a, b)
    yield sample("SelectV2", "column", bools(3, 1), a, b)
    yield sample("SelectV2", "row and scalar", const(bools(4)), a, const(f32(9).reshape(())))
    yield sample("SelectV2", "wider condition", bools(3, 4), const(floats(4)), const(ints(4).astype(np.float32)))


# ------------------------------------------------------------------ linear


def _products() -> Iterator[Sample]:
    yield sample("MatMul", "constant weights", floats(3, 5), const(floats(5, 4, seed=1)))
    yield sample("MatMul", "transpose_b", floats(3, 5), const(floats(4, 5, seed=1)), transpose_b=True)
    yield sample("MatMul", "transpose_a", fixed(floats(5, 3)), const(floats(5, 4, seed=1)), transpose_a=True)
    yield sample(
        "MatMul", "both, fed", fixed(floats(5, 3)), fixed(floats(4, 5, seed=1)), transpose_a=True, transpose_b=True
    )
    yield sample("BatchMatMul", "rank 3", floats(2, 3, 5), floats(2, 5, 4, seed=1))
    yield sample("BatchMatMul", "adj_x", floats(2, 5, 3), floats(2, 5, 4, seed=1), adj_x=True)
    yield sample("BatchMatMul", "adj_y, rank 4", floats(2, 2, 3, 5), floats(2, 2, 4, 5, seed=1), adj_y=True)
    weights, bias = const(floats(5, 4, seed=1)), const(floats(4, seed=2))
    for names in (("BiasAdd",), ("BiasAdd", "Relu"), ("BiasAdd", "Relu6"), ("BiasAdd", "Elu"), ("BiasAdd", "Sigmoid")):
        title = " + ".join(names)
        yield sample("_FusedMatMul", title, floats(3, 5), weights, bias, fused_ops=names)
    turned = const(floats(4, 5, seed=1))
    yield sample(
        "_FusedMatMul",
        "transpose_b",
        floats(3, 5),
        turned,
        bias,
        fused_ops=("BiasAdd", "Relu"),
        transpose_b=True,
        differs={"tfjs-wasm": "a transposed product loses its bias (passes/fuse.py makes none)"},
    )
    yield sample("BiasAdd", "matrix", floats(3, 4), const(floats(4, seed=1)))
    yield sample("BiasAdd", "image", floats(2, 3, 3, 4), const(floats(4, seed=1)))
    yield sample("BiasAdd", "sequence", floats(2, 3, 4), const(floats(4, seed=1)))


def _reductions() -> Iterator[Sample]:
    x = floats(3, 4, 2)
    for op in ("Sum", "Mean", "Prod", "Max", "Min"):
        yield sample(op, "vector of an axis", x, const(np.array([1], np.int32)))
        yield sample(op, "scalar axis, kept", x, const(1), keep_dims=True)
        yield sample(op, "negative axes", x, const(-1, -2))
        yield sample(op, "over the batch", x, const(np.array([0], np.int32)), keep_dims=True)
        yield sample(op, "all axes", x, const(0, 1, 2))
        yield sample(op, "no axis", x, const(np.zeros(0, np.int32)))
    for op in ("Sum", "Prod", "Max", "Min"):
        yield sample(op, "int32", ints(3, 4), const(1))
    for op in ("Max", "Min"):
        yield sample(op, "infinite", np.where(bools(3, 4), floats(3, 4), f32(-INF)).astype(np.float32), const(1))
    for op in ("All", "Any"):
        x = np.array([[True, True], [True, False], [False, False]])
        yield sample(op, "rows", x, const(np.array([1], np.int32)))
        yield sample(op, "rows, kept", x, const(-1), keep_dims=True)
        yield sample(op, "everything", x, const(0, 1))


def _choices() -> Iterator[Sample]:
    for op in ("ArgMax", "ArgMin"):
        yield sample(op, "last axis", floats(4, 5), const(1))
        yield sample(op, "negative axis, int32", floats(2, 3, 4), const(-2), output_type=INT32)
        yield sample(op, "batch axis", floats(4, 5), const(0))
        yield sample(op, "ties", np.array([[1, 3, 3, 1], [0, 0, 0, 0]], np.float32), const(1))
        yield sample(op, "int32 scores", ints(4, 5), const(1))
    for op in ("Softmax", "LogSoftmax"):
        yield sample(op, "matrix", floats(3, 4, low=-5, high=5))
        yield sample(op, "rank 3", floats(2, 3, 4))
        yield sample(op, "large", f32(1e4, 0, -1e4, 80, 80, 80).reshape(2, 3))
        yield sample(op, "one column", floats(3, 1))
        yield sample(op, "masked", f32(0, -INF, 1, -INF, -INF, 2).reshape(2, 3))


def unfused(sample: Sample) -> Graph:
    """The graph of a fused op in the ops that it is made of."""
    *before, node = sample.nodes
    product = node.op.removeprefix("_Fused")
    known = {a.name for a in TABLE[product].attrs}
    attrs = {name: value for name, value in node.attrs.items() if name in known}
    chain = [Node("product", product, node.inputs[:2], attrs)]
    for name in node.attrs["fused_ops"]:
        inputs = (chain[-1].name, node.inputs[2]) if name == "BiasAdd" else (chain[-1].name,)
        chain.append(Node(f"step_{len(chain)}", name, inputs, defaults(name)))
    return Graph((*before, *chain[:-1], replace(chain[-1], name="op")))


# ------------------------------------------------------------------ images


def _convolutions() -> Iterator[Sample]:
    image = floats(2, 7, 6, 3)
    kernel = const(floats(3, 2, 3, 4, seed=1))
    for padding, stride in itertools.product(("SAME", "VALID"), (1, 2, 3)):
        attrs: dict[str, Any] = {"padding": padding, "strides": (1, stride, stride, 1)}
        # the last column of the image is under no window
        yield sample("Conv2D", f"{padding}, stride {stride}", image, kernel, **attrs)
        yield sample("DepthwiseConv2dNative", f"{padding}, stride {stride}", image, kernel, **attrs)
        yield sample("Conv2D", f"{padding}, stride {stride}, any size", any_size(floats(2, 8, 7, 3)), kernel, **attrs)
    for padding in ("SAME", "VALID"):
        attrs = {"padding": padding, "strides": (1, 1, 1, 1), "dilations": (1, 2, 2, 1)}
        yield sample("Conv2D", f"{padding}, dilated", image, kernel, **attrs)
        refused = {"tensorflow": "its CPU kernel takes no dilations"}
        yield sample("DepthwiseConv2dNative", f"{padding}, dilated", image, kernel, differs=refused, **attrs)
    yield sample(
        "Conv2D", "strides differ", image, const(floats(4, 4, 3, 2, seed=1)), padding="SAME", strides=(1, 2, 1, 1)
    )
    yield sample("Conv2D", "1 x 1", image, const(floats(1, 1, 3, 2, seed=1)), padding="VALID", strides=(1, 1, 1, 1))
    bias = const(floats(4, seed=2))
    for names in (("BiasAdd",), ("BiasAdd", "Relu"), ("BiasAdd", "Relu6"), ("BiasAdd", "Elu")):
        attrs = {"padding": "SAME", "strides": (1, 2, 2, 1), "fused_ops": names}
        fused = sample("_FusedConv2D", " + ".join(names), image, kernel, bias, **attrs)
        # what TensorFlow 2.21 calls _FusedConv2D has more attributes
        yield replace(fused, oracle=unfused(fused))


def _pools() -> Iterator[Sample]:
    image = floats(2, 7, 6, 3)
    for op, padding, size, stride in itertools.product(("MaxPool", "AvgPool"), ("SAME", "VALID"), (2, 3), (1, 2)):
        yield sample(
            op,
            f"{padding}, {size} by {stride}",
            image,
            padding=padding,
            ksize=(1, size, size, 1),
            strides=(1, stride, stride, 1),
        )
    for op in ("MaxPool", "AvgPool"):
        negative = floats(2, 5, 5, 2, low=-3, high=-1)
        yield sample(
            op, "negative, window not square", negative, padding="SAME", ksize=(1, 3, 2, 1), strides=(1, 2, 3, 1)
        )


def _padding() -> Iterator[Sample]:
    one, image = (
        const(np.array([[0, 0], [1, 2]], np.int32)),
        const(np.array([[0, 0], [1, 0], [0, 2], [0, 0]], np.int32)),
    )
    yield sample("Pad", "matrix", floats(2, 3), one)
    yield sample("Pad", "image", floats(2, 3, 3, 2), image)
    yield sample("Pad", "int32", ints(2, 3), one)
    yield sample("PadV2", "value", floats(2, 3), one, const(f32(-7).reshape(())))
    yield sample("PadV2", "image", floats(2, 3, 3, 2), image, const(f32(1.5).reshape(())))


# ------------------------------------------------------------------ arrays


def _sources() -> Iterator[Sample]:
    for array in (floats(2, 3), ints(4), ints(2, 2, dtype=np.int64), bools(3), f32(2.5).reshape(())):
        title = f"{array.dtype}, rank {array.ndim}"
        yield Sample("Const", title, (Node("op", "Const", value=array),), {})
        attrs = {"dtype": array.dtype, "shape": TensorShape((None, *array.shape[1:]) if array.ndim else ())}
        node = Node("op", "Placeholder", attrs=attrs)
        yield Sample("Placeholder", title, (node,), {"op": array})
    for op in ("Identity", "StopGradient", "Snapshot"):
        yield sample(op, "float32", floats(3, 4))
        yield sample(op, "int32", ints(3))
    yield sample("PreventGradient", "float32", floats(3, 4), differs=NO_SUCH_OP)
    yield sample("PreventGradient", "int32", ints(3), differs=NO_SUCH_OP)
    yield sample("CheckNumerics", "matrix", floats(3, 4), message="not finite", differs=NO_SUCH_OP)
    yield sample("CheckNumerics", "rank 1", floats(3), differs=NO_SUCH_OP)


def _shapes() -> Iterator[Sample]:
    for op in ("Shape", "Size"):
        yield sample(op, "matrix", floats(3, 4), out_type=INT32)
        yield sample(op, "int64", floats(3, 4, 2), out_type=INT64)
        yield sample(op, "scalar", f32(1).reshape(()), out_type=INT32)
    yield sample("Rank", "matrix", floats(3, 4), differs=NO_LOWERING)
    yield sample("Rank", "scalar", f32(1).reshape(()), differs=NO_LOWERING)
    yield sample("Reshape", "to a known shape", fixed(floats(3, 4)), const(2, 6))
    yield sample("Reshape", "flatten", floats(3, 4, 2), const(-1, 8))
    yield sample("Reshape", "split the last axis", floats(3, 6), const(-1, 2, 3))
    yield sample("Reshape", "rows into the batch", floats(3, 6), const(-1, 2))
    yield sample("Reshape", "int64 shape", floats(3, 6), const(-1, 6, 1, dtype=np.int64))
    yield sample("Reshape", "to a scalar", fixed(floats(1, 1)), const(np.zeros(0, np.int32)))
    rows = via("StridedSlice", shape_of("x0"), *_vectors(0, 1, 1), shrink_axis_mask=1)
    yield sample("Reshape", "computed", floats(3, 4, 2), via("Pack", rows, const(8)))
    rows = via("StridedSlice", shape_of("x0"), *_vectors(0, 1, 1))
    yield sample("Reshape", "computed, joined", floats(3, 4, 2), via("ConcatV2", rows, *_vectors(8), const(0)))
    yield sample("Squeeze", "all", fixed(floats(1, 3, 1, 2)))
    yield sample("Squeeze", "named", floats(2, 1, 3, 1), squeeze_dims=(1,))
    yield sample("Squeeze", "named, negative", floats(2, 1, 3, 1), squeeze_dims=(-1, 1))
    yield sample("ExpandDims", "in front", floats(3, 4), const(0))
    yield sample("ExpandDims", "behind", floats(3, 4), const(-1))
    yield sample("ExpandDims", "vector of an axis", floats(3, 4), const(np.array([1], np.int32)))
    yield sample("Transpose", "matrix", floats(3, 4), const(1, 0))
    yield sample("Transpose", "image", floats(2, 3, 4, 5), const(0, 3, 1, 2))
    yield sample("Transpose", "scalar", f32(3).reshape(()), const(np.zeros(0, np.int32)))
    yield sample("Transpose", "int32, int64 order", ints(2, 3, 4), const(2, 0, 1, dtype=np.int64))


def _vectors(*values: int) -> list[Operand]:
    return [const(np.array([v], np.int32)) for v in values]


def _joins() -> Iterator[Sample]:
    a, b, c = floats(3, 2), floats(3, 4, seed=1), floats(3, 1, seed=2)
    yield sample("ConcatV2", "columns", a, b, c, const(1))
    yield sample("ConcatV2", "negative axis", floats(3, 2, 2), floats(3, 2, 1, seed=1), const(-1))
    yield sample("ConcatV2", "rows", a, floats(3, 2, seed=1), const(0))
    yield sample("ConcatV2", "int64", ints(3, 1, dtype=np.int64), ints(3, 2, dtype=np.int64), const(1))
    yield sample("Pack", "in front", floats(3, 2), floats(3, 2, seed=1))
    yield sample("Pack", "behind", floats(3, 2), floats(3, 2, seed=1), axis=-1)
    yield sample("Pack", "between, three", floats(3, 2), floats(3, 2, seed=1), floats(3, 2, seed=2), axis=1)
    yield sample("Pack", "scalars", const(3), const(4), fixed(np.array(5, np.int32)))
    yield sample("Unpack", "columns", floats(4, 3), num=3, axis=1, outputs=3)
    yield sample("Unpack", "negative axis", floats(4, 3, 2), num=2, axis=-1, outputs=2)
    yield sample("Unpack", "first axis", fixed(ints(2, 3)), num=2, axis=0, outputs=2)
    yield sample("Split", "columns", const(1), floats(3, 8), num_split=4, outputs=4)
    yield sample("Split", "negative axis", const(-1), floats(2, 3, 4), num_split=2, outputs=2)
    yield sample("Split", "one part", const(1), floats(3, 4), num_split=1)
    yield sample(
        "Split",
        "rows",
        const(0),
        floats(4, 3),
        num_split=2,
        outputs=2,
        differs=UNKNOWN_BATCH,
    )
    yield sample("SplitV", "columns", floats(3, 6), const(1, 2, 3), const(1), num_split=3, outputs=3)
    yield sample("SplitV", "the rest", floats(3, 6), const(2, -1), const(-1), num_split=2, outputs=2)
    yield sample(
        "SplitV",
        "rows, the rest",
        floats(4, 3),
        const(1, -1),
        const(0),
        num_split=2,
        outputs=2,
        differs=UNKNOWN_BATCH,
    )


def _slices() -> Iterator[Sample]:
    yield sample("Slice", "columns", floats(3, 5), const(0, 1), const(-1, 2))
    yield sample("Slice", "to the end", floats(3, 5, 2), const(0, 2, 0), const(-1, -1, 1))
    yield sample("Slice", "rows", floats(4, 5), const(1, 0), const(2, -1))
    yield sample("Slice", "int64 bounds", ints(3, 5), const(0, 3, dtype=np.int64), const(-1, 2, dtype=np.int64))
    yield strided("x[:, 1:3]", (3, 5), (0, 1), (0, 3), begin_mask=1, end_mask=1)
    yield strided("x[:, 2]", (3, 5), (0, 2), (0, 3), begin_mask=1, end_mask=1, shrink_axis_mask=2)
    yield strided("x[:, -1]", (3, 5), (0, -1), (0, 0), begin_mask=1, end_mask=1, shrink_axis_mask=2)
    yield strided("x[:, -3:-1]", (3, 5), (0, -3), (0, -1), begin_mask=1, end_mask=1)
    yield strided("x[:, ::-1]", (3, 5), (0, 0), (0, 0), (1, -1), begin_mask=3, end_mask=3)
    yield strided("x[:, 3:0:-2]", (3, 5), (0, 3), (0, 0), (1, -2), begin_mask=1, end_mask=1)
    yield strided("x[:, 1::2]", (3, 6), (0, 1), (0, 0), (1, 2), begin_mask=1, end_mask=3)
    yield strided("x[:, 3:99]", (3, 5), (0, 3), (0, 99), begin_mask=1, end_mask=1)
    yield strided("x[:, newaxis]", (3, 5), (0, 0), (0, 0), begin_mask=1, end_mask=1, new_axis_mask=2)
    yield strided("x[..., newaxis]", (3, 5), (0, 0), (0, 0), ellipsis_mask=1, new_axis_mask=2)
    yield strided("x[..., 1]", (2, 3, 4), (0, 1), (0, 2), ellipsis_mask=1, shrink_axis_mask=2)
    yield strided("x[:, ..., 0:2]", (2, 3, 4), (0, 0, 0), (0, 0, 2), begin_mask=1, end_mask=1, ellipsis_mask=2)
    yield strided("x[newaxis, 0]", (3, 5), (0, 0), (0, 1), new_axis_mask=1, shrink_axis_mask=2)
    yield strided("x[1]", (3, 5), (1,), (2,), shrink_axis_mask=1)
    yield strided("x[1:]", (3, 5), (1,), (0,), end_mask=1)
    yield strided("x[:, 2:2]", (3, 5), (0, 2), (0, 2), begin_mask=1, end_mask=1)
    yield strided(
        "x[:, 1, ::2]",
        (3, 2, 4),
        (0, 1, 0),
        (0, 0, 0),
        (1, 1, 2),
        begin_mask=5,
        end_mask=5,
        shrink_axis_mask=2,
    )
    yield sample("StridedSlice", "of a shape", shape_of(floats(3, 4, 2)), *_vectors(1, 3, 1))
    yield sample("StridedSlice", "int32", ints(3, 4), const(0, 1), const(0, 2), const(1, 1), begin_mask=1, end_mask=1)


def strided(
    title: str,
    shape: Sequence[int],
    begin: Sequence[int],
    end: Sequence[int],
    step: Sequence[int] = (),
    *,
    differs: Mapping[str, str] | None = None,
    **masks: int,
) -> Sample:
    bounds = [const(np.array(v, np.int32)) for v in (begin, end, step or [1] * len(begin))]
    return sample("StridedSlice", title, floats(*shape), *bounds, differs=differs, **masks)


def _gathers() -> Iterator[Sample]:
    table = floats(5, 3)
    yield sample("Gather", "rows", const(table), np.array([4, 0, 2], np.int32))
    yield sample("Gather", "int64 matrix of indices", const(table), ints(2, 2, low=0, high=4, dtype=np.int64))
    yield sample("GatherV2", "rows", const(table), np.array([4, 0, 2], np.int32), const(0))
    yield sample("GatherV2", "columns", floats(3, 5), const(2, 0), const(1))
    yield sample("GatherV2", "one column", floats(3, 5), const(3), const(1))
    yield sample("GatherV2", "negative axis", floats(2, 3, 4), const(np.array([[1, 3]], np.int32)), const(-1))


def _fills() -> Iterator[Sample]:
    seven = const(f32(7).reshape(()))
    yield sample("Fill", "constant", const(2, 3), seven)
    yield sample("Fill", "as an input", shape_of(floats(3, 2)), seven)
    yield sample("Fill", "int32, fed value", const(2, 2), fixed(np.array(3, np.int32)))
    yield sample("BroadcastTo", "rows", const(floats(4)), const(3, 4))
    yield sample("BroadcastTo", "column", fixed(floats(3, 1)), const(3, 4))
    yield sample("BroadcastTo", "scalar to a scalar", f32(3).reshape(()), const(np.zeros(0, np.int32)))
    yield sample("BroadcastTo", "as an input", const(floats(1, 4)), shape_of(floats(3, 4)))
    yield sample("Tile", "columns", floats(3, 2), const(1, 3))
    yield sample("Tile", "rows", floats(3, 2), const(2, 1))
    yield sample("Tile", "int64", ints(2, 1, dtype=np.int64), const(1, 4, dtype=np.int64))
    yield sample("Range", "constant", const(2), const(11), const(3))
    yield sample("Range", "downwards", const(5), const(0), const(-2))
    yield sample("Range", "to a fed limit", const(0), fixed(np.array(4, np.int32)), const(1))
    yield sample("Range", "float32", *(const(f32(v).reshape(())) for v in (0.0, 1.0, 0.1)))


def _one_hots() -> Iterator[Sample]:
    on, off = const(f32(1).reshape(())), const(f32(0).reshape(()))
    indices = np.array([0, 2, 1], np.int32)
    yield sample("OneHot", "vector", indices, const(3), on, off)
    yield sample("OneHot", "outside of the depth", np.array([-1, 3, 7, -3, 2], np.int32), const(3), on, off)
    yield sample("OneHot", "axis 0", indices, const(4), on, off, axis=0)
    yield sample("OneHot", "axis 1 of 3", ints(3, 2, low=0, high=3), const(4), on, off, axis=1)
    yield sample("OneHot", "last axis, said", ints(3, 2, low=0, high=3), const(4), on, off, axis=2)
    yield sample("OneHot", "int64 indices", ints(3, 2, low=0, high=3, dtype=np.int64), const(4), on, off)
    yield sample("OneHot", "depth 1", np.array([0, 1, -1], np.int32), const(1), on, off)
    yield sample("OneHot", "other values", indices, const(3), const(f32(-2).reshape(())), const(f32(0.5).reshape(())))
    yield sample("OneHot", "int32 values", indices, const(3), const(5), const(-1))
    yield sample("OneHot", "one column of a matrix", np.array([[0], [2], [1]], np.int32), const(3), on, off)


# ------------------------------------------------------------------ chance

#: Draws per sample, many enough that a wrong distribution shows.
DRAWS = 20_000
PROBABILITIES = f32(0.6, 0.1, 0.3)


def _random() -> Iterator[Sample]:
    for op in ("RandomStandardNormal", "RandomUniform", "TruncatedNormal"):
        differs = NO_LOWERING if op == "TruncatedNormal" else None
        yield sample(op, "constant shape", const(DRAWS // 4, 4), dtype=FLOAT32, drawn=True, differs=differs)
        shape = shape_of(floats(DRAWS // 2, 2))
        yield sample(op, "as an input", shape, dtype=FLOAT32, drawn=True, differs=differs)
    logits = np.log(PROBABILITIES).reshape(1, 3)
    yield sample("Multinomial", "one row", logits, const(DRAWS), drawn=True)
    yield sample("Multinomial", "int32", logits, const(DRAWS), output_dtype=INT32, drawn=True)
    rows = np.repeat(logits, 2, axis=0)
    again = {"tfjs-cpu": "its generator starts anew for every row"}
    yield sample("Multinomial", "two rows", rows, const(DRAWS // 2), drawn=True, differs=again)


SAMPLES: tuple[Sample, ...] = tuple(
    itertools.chain(
        _unary(),
        _casts(),
        _binary(),
        _several(),
        _products(),
        _reductions(),
        _choices(),
        _convolutions(),
        _pools(),
        _padding(),
        _sources(),
        _shapes(),
        _joins(),
        _slices(),
        _gathers(),
        _fills(),
        _one_hots(),
        _random(),
    )
)


def random_slices(count: int, seed: int) -> tuple[Graph, dict[str, Array], list[str]]:
    """(graph, feeds, fetches) of many StridedSlices of one array, with bounds and masks as TensorFlow allows them."""
    random = np.random.default_rng(seed)
    array = floats(3, 4, 5)
    builder = _Builder()
    source = builder.operand(fixed(array))
    fetches = []
    while len(fetches) < count:
        entries = int(random.integers(1, 6))
        masks = {name: int(random.integers(0, 2**entries)) for name in ("begin", "end", "new_axis", "shrink_axis")}
        masks["ellipsis"] = 1 << int(random.integers(0, entries)) if random.random() < 0.5 else 0
        covered = [i for i in range(entries) if not (masks["ellipsis"] | masks["new_axis"]) >> i & 1]
        if len(covered) > array.ndim:
            continue
        taken = [i for i in covered if masks["shrink_axis"] >> i & 1]
        begin, end = random.integers(-7, 8, entries), random.integers(-7, 8, entries)
        begin[taken] = random.integers(-3, 3, len(taken))  # inside of every axis
        strides = random.choice([-2, -1, 1, 2, 3], entries)
        strides[taken] = 1
        bounds = [builder.operand(const(v.astype(np.int32))) for v in (begin, end, strides)]
        name = f"slice_{len(fetches)}"
        attrs = {f"{key}_mask": value for key, value in masks.items()}
        builder.nodes.append(Node(name, "StridedSlice", (source, *bounds), attrs))
        fetches.append(name)
    return Graph(tuple(builder.nodes)), builder.feeds, fetches
