"""Matrix products, as numpy's matmul (onnx/docs/Operators.md, MatMul)."""

from __future__ import annotations

from export_model.converters.graph.builder import Builder


def matmul(b: Builder, x: str, y: str) -> str:
    """[…, rows, inner] by […, inner, columns]: vectors are rows or columns, further axes broadcast.

    A product with a matrix behind further axes is written on two axes, and batches are repeated to one shape: TF 1.x
    multiplies no others.
    """
    left, right = b.rank(x), b.rank(y)
    x = b.expand_dims(x, 0) if left == 1 else x
    y = b.expand_dims(y, 1) if right == 1 else y
    value = _product(b, x, y)
    rank = b.rank(value)
    return b.squeeze(value, [axis for axis, gone in ((rank - 2, left == 1), (rank - 1, right == 1)) if gone])


def _product(b: Builder, x: str, y: str) -> str:
    left, right = b.shape(x), b.shape(y)
    if len(left) == len(right) == 2:
        return b.add("MatMul", [x, y])
    if len(right) == 2:
        rows = b.reshape(x, (-1, b.length(x, -1)))
        return b.reshape(b.add("MatMul", [rows, y]), (*left[:-1], right[-1]))
    batch = b.common_shape([left[:-2], right[:-2]])
    return b.add("BatchMatMul", [b.broadcast(t, (*batch, *s[-2:])) for t, s in ((x, left), (y, right))])
