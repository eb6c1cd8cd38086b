"""Matrix products, as numpy's matmul and einsum (onnx/docs/Operators.md, MatMul, Einsum)."""

from __future__ import annotations

from collections.abc import Sequence

from converters.graph.builder import Builder
from converters.graph.types import Dim, product
from signatures.errors import UnsupportedOpError

_OPERANDS = 2


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
    batch = b.joined([left[:-2], right[:-2]])
    return b.add("BatchMatMul", [b.broadcast(t, (*batch, *s[-2:])) for t, s in ((x, left), (y, right))])


def einsum(b: Builder, equation: str, tensors: Sequence[str]) -> str:
    """Sums of products of one or two tensors, each label at most once per operand. Raises UnsupportedOpError."""
    equation = equation.replace(" ", "")
    left, arrow, result = equation.partition("->")
    terms, tensors = left.split(","), [*tensors]
    if not arrow:
        letters = sorted(set(left) - {","})
        result = "".join(c for c in letters if left.count(c) == 1)
    simple = "." not in equation and all(len(set(t)) == len(t) for t in (*terms, result))
    if not simple or len(terms) != len(tensors) or len(terms) > _OPERANDS or set(result) - set(left):
        raise UnsupportedOpError(
            f"the equation {equation!r} is no plain product",
            why="one or two operands without repeated labels are written as products; no policy uses others",
        )
    lone = [[c for c in t if c not in result and left.count(c) == 1] for t in terms]
    for i, labels in enumerate(lone):
        if labels:
            tensors[i] = b.reduce("Sum", tensors[i], [terms[i].index(c) for c in labels], keep=False)
            terms[i] = "".join(c for c in terms[i] if c not in labels)
    if len(terms) == 1:
        return b.transpose(tensors[0], [terms[0].index(c) for c in result])
    return _contracted(b, tensors, terms, result)


def _contracted(b: Builder, tensors: Sequence[str], terms: Sequence[str], result: str) -> str:
    """Two operands as matrix products: [batch, rows, inner] × [batch, inner, columns]."""
    first, second = terms
    groups = {
        "batch": [c for c in first if c in second and c in result],
        "inner": [c for c in first if c in second and c not in result],
        "rows": [c for c in first if c not in second],
        "columns": [c for c in second if c not in first],
    }
    lengths: dict[str, Dim] = {}
    for tensor, term in zip(tensors, terms, strict=True):
        lengths.update(zip(term, b.shape(tensor), strict=True))
    batch = ["batch"] if groups["batch"] else []
    matrices = []
    for tensor, term, sides in zip(tensors, terms, (("rows", "inner"), ("inner", "columns")), strict=True):
        order = [c for name in ("batch", *sides) for c in groups[name]]
        turned = b.transpose(tensor, [term.index(c) for c in order])
        sizes = [product((lengths[c] for c in groups[name]), b.symbols) for name in (*batch, *sides)]
        matrices.append(b.reshape(turned, _one_open(sizes)))
    value = b.add("BatchMatMul" if batch else "MatMul", matrices)
    order = [c for name in ("batch", "rows", "columns") for c in groups[name]]
    value = b.reshape(value, [lengths[c] for c in order])
    return b.transpose(value, [order.index(c) for c in result])


def _one_open(sizes: Sequence[Dim]) -> list[Dim]:
    """A single length that is not known as -1."""
    names = [s for s in sizes if isinstance(s, str)]
    return [-1 if isinstance(s, str) and len(names) == 1 else s for s in sizes]
