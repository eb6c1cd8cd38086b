"""Products, reductions, softmax: what mixes the elements of a tensor."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.formats.onnx.importer.elementwise import is_bias
from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.nn import reduction
from export_model.converters.graph.nn.choosing import last, moved_back
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.ops.einsum import einsum, labels_of
from export_model.converters.graph.types import INT64, Dim, product

_MATRIX = 2


# ------------------------------------------------------------------ products


def _gemm(op: Op, net: Importer) -> str:
    """alpha·A'·B' + beta·C; A is a matrix, or flattened to one by the exporter."""
    a, b = op.need(0), op.need(1)
    if op.integer("transA", 0):
        a = net.transpose(a, (1, 0))
    if op.integer("transB", 0):
        b = net.transpose(b, (1, 0))
    value = net.add("MatMul", [a, b])
    alpha, beta, c = op.number("alpha", 1.0), op.number("beta", 1.0), op.get(2)
    if alpha != 1:
        value = net.add("Mul", [value, net.number(value, alpha)])
    if c is None or beta == 0:
        return value
    constant = net.constant(c)
    if beta != 1:
        scaled = None if constant is None else (constant * constant.dtype.type(beta)).astype(constant.dtype)
        c = net.add("Mul", [c, net.number(c, beta)]) if scaled is None else net.const(scaled, "c")
        constant = scaled
    if constant is not None and constant.ndim == _MATRIX and constant.shape[0] == 1:
        row = net.const(constant.reshape(-1), "bias")
        c = row if is_bias(net, value, row) else c
    return net.add("BiasAdd" if is_bias(net, value, c) else "Add", [value, c])


def _matmul(op: Op, net: Importer) -> str:
    return matmul(net, op.need(0), op.need(1))


def _einsum(op: Op, net: Importer) -> str:
    equation, tensors = op.text("equation", "").replace(" ", ""), [op.need(i) for i in range(len(op.inputs))]
    lengths: dict[str, set[Dim]] = {}
    for term, tensor in zip(equation.partition("->")[0].split(","), tensors, strict=False):
        for label, dim in labels_of(term, net.shape(tensor)):
            lengths.setdefault(label, set()).add(dim)
    if repeated := [label for label, dims in lengths.items() if 1 in dims and len(dims) > 1]:
        raise op.op_error(f"{repeated[0]!r} has length 1 in one operand, and is repeated", "no policy needs that")
    return einsum(net, equation, tensors, shape_of=net.shape)


# ------------------------------------------------------------------ reductions


def _axes(op: Op, net: Importer, since: int) -> list[int] | None:
    """The axes of a reduction: an attribute, from opset ``since`` on an input. None: the input is left as it is."""
    x = op.need(0)
    axes = op.integers("axes")
    operand = op.get(1)
    if op.opset >= since and operand is not None:
        axes = tuple(int(a) for a in net.needed_constant(operand, "the list of axes").reshape(-1))
    if not axes:
        if op.integer("noop_with_empty_axes", 0):
            return None
        return list(range(net.rank(x)))
    return sorted({net.axis(x, a) for a in axes})


def _reduction(build: reduction.Reduction, since: int = 18) -> Translate:
    return lambda op, net: build(net, op.need(0), _axes(op, net, since) or [], bool(op.integer("keepdims", 1)))


def _arg(kind: str) -> Translate:
    def function(op: Op, net: Importer) -> str:
        x = op.need(0)
        axis = net.axis(x, op.integer("axis", 0))
        last = bool(op.integer("select_last_index", 0))
        if last:  # the targets take the first of equal elements
            length = net.length(x, axis)
            x = net.take(x, range(length - 1, -1, -1), axis)
        best = net.add(kind, [x, net.ints(axis, "axis")], output_type=INT64)
        best = net.add("Sub", [net.number(best, length - 1), best]) if last else best
        return net.expand_dims(best, axis) if op.integer("keepdims", 1) else best

    return function


# ------------------------------------------------------------------ softmax


def _softmax(op: Op, net: Importer) -> str:
    """Over one axis from opset 13 on; before, over everything from that axis on.

    Written on two axes: TF 1.x takes no others.
    """
    x = op.need(0)
    dims = net.shape(x)
    whole = op.opset < 13
    axis = net.axis(x, op.integer("axis", 1 if whole else -1)) if dims else 0
    if whole and axis < len(dims) - 1:
        size = product(dims[axis:], net.symbols)
        if not isinstance(size, int):
            raise op.op_error("it is taken over axes whose lengths are not known")
        return net.reshape(net.add(op.kind, [net.reshape(x, (-1, size))]), dims)
    return moved_back(net, reduction.over_last_axis(net, op.kind, last(net, x, axis)), axis)


def _hardmax(op: Op, net: Importer) -> str:
    """1 at the first largest element; one axis from opset 13 on."""
    x = op.need(0)
    axis = net.axis(x, op.integer("axis", 1 if op.opset < 13 else -1))
    if op.opset < 13 and axis != net.rank(x) - 1:
        raise op.op_error("it is taken over several axes")
    return moved_back(net, reduction.hardmax(net, last(net, x, axis)), axis)


OPS: Mapping[str, Translate] = {
    "Gemm": _gemm,
    "MatMul": _matmul,
    "Einsum": _einsum,
    "ReduceSum": _reduction(reduction.of_kind("Sum"), since=13),
    **{f"Reduce{kind}": _reduction(reduction.of_kind(kind)) for kind in ("Mean", "Max", "Min", "Prod")},
    "ReduceL1": _reduction(reduction.l1),
    "ReduceL2": _reduction(reduction.l2),
    "ReduceSumSquare": _reduction(reduction.sum_square),
    "ReduceLogSum": _reduction(reduction.log_sum),
    "ReduceLogSumExp": _reduction(reduction.log_sum_exp),
    "ArgMax": _arg("ArgMax"),
    "ArgMin": _arg("ArgMin"),
    "Softmax": _softmax,
    "LogSoftmax": _softmax,
    "Hardmax": _hardmax,
}
