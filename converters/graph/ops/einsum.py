"""Sums of products after an equation (numpy.einsum, ONNX and TensorFlow's Einsum) as ops that TensorFlow 1.4 has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from string import ascii_letters

import numpy as np

from export_model.converters.graph.ops.rewriting import NodeBuilder, Shape
from export_model.converters.graph.types import INT32, Dim
from export_model.signatures.errors import UnsupportedOpError

_OPERANDS = 2


def einsum(
    b: NodeBuilder,
    equation: str,
    tensors: Sequence[str],
    name: str = "einsum",
    *,
    shape_of: Callable[[str], Shape],
) -> str:
    """One or two tensors, each label at most once per operand; their shapes are asked for where there is a ``…`` alone.

    Raises UnsupportedOpError for other equations.
    """
    equation = equation.replace(" ", "")
    left, arrow, result = equation.partition("->")
    terms, tensors = left.split(","), [*tensors]
    if not arrow:
        letters = sorted(set(left) - {",", "."})
        result = ("..." if "..." in left else "") + "".join(c for c in letters if left.count(c) == 1)
    if len(terms) == len(tensors) and "..." in left and set(map(_dots, (*terms, result))) <= {0, 3}:
        terms, tensors, result = _written_out(b, terms, tensors, result, name, [shape_of(t) for t in tensors])
    left = ",".join(terms)
    simple = "." not in left + result and all(len(set(t)) == len(t) for t in (*terms, result))
    if not simple or len(terms) != len(tensors) or len(terms) > _OPERANDS or set(result) - set(left):
        raise UnsupportedOpError(
            f"the equation {equation[:80]!r} must be a plain product",
            why="one or two operands without repeated labels are written as products; no policy uses others",
        )
    lone = [[c for c in t if c not in result and left.count(c) == 1] for t in terms]
    for i, labels in enumerate(lone):
        if labels:
            axes = b.const(np.array([terms[i].index(c) for c in labels], INT32), f"{name}/axes")
            tensors[i] = b.add("Sum", [tensors[i], axes], f"{name}/sum", keep_dims=False)
            terms[i] = "".join(c for c in terms[i] if c not in labels)
    if len(terms) == 1:
        return _transpose(b, tensors[0], terms[0], result, name)
    return _contract(b, tensors, terms, result, name)


def _dots(term: str) -> int:
    """The dots of a term: three in a row, or another number."""
    return 3 if term.count("...") == 1 and term.count(".") == 3 else len(term) if "." in term else 0


def labels_of(term: str, shape: Sequence[Dim]) -> list[tuple[str, Dim]]:
    """Each label of a term with the length of its axis; the axes of a ``…`` are left out."""
    before, _, after = term.partition("...")
    return [*zip(before, shape, strict=False), *zip(after[::-1], reversed(shape), strict=False)]


def _written_out(
    b: NodeBuilder, terms: Sequence[str], tensors: Sequence[str], result: str, name: str, shapes: Sequence[Shape]
) -> tuple[list[str], list[str], str]:
    """Return (terms, tensors, result) with a label for each axis of a ``…``.

    The axes are counted from the last, as numpy broadcasts; one of length 1 is taken off where another operand has it
    longer.
    """
    axes = [_dotted_axes(term, shape) for term, shape in zip(terms, shapes, strict=True)]
    most = max(map(len, axes))
    if most and "." not in result:
        raise UnsupportedOpError("the axes of its '...' are not in its result")
    labels = [c for c in ascii_letters if c not in "".join((*terms, result))][:most]
    if len(labels) < most:
        raise UnsupportedOpError("there are more axes than letters")
    longer = {c for own in axes for c, d in zip(labels[most - len(own) :], own, strict=True) if d != 1}
    made, written = [], []
    for term, tensor, own in zip(terms, tensors, axes, strict=True):
        mine = labels[most - len(own) :]
        single = [i for i, (c, d) in enumerate(zip(mine, own, strict=True)) if d == 1 and c in longer]
        if single:
            dropped = tuple(term.index("...") + i for i in single)
            tensor = b.add("Squeeze", [tensor], f"{name}/single", squeeze_dims=dropped)
        made.append(tensor)
        written.append(term.replace("...", "".join(c for i, c in enumerate(mine) if i not in single)))
    return written, made, result.replace("...", "".join(labels))


def _dotted_axes(term: str, shape: Shape) -> Sequence[Dim]:
    """The lengths of the axes that the ``…`` of a term stands for; none where it has no dots."""
    if shape is None and "." in term:
        raise UnsupportedOpError("the rank of an operand is not known", why="the axes of its '...' must be counted")
    begin = term.find("...")
    count = len(shape or ()) - len(term) + 3
    if begin >= 0 and count < 0:
        raise UnsupportedOpError(f"an operand of rank {len(shape or ())} does not fit {term!r}")
    return () if begin < 0 else (shape or ())[begin : begin + count]


def _contract(b: NodeBuilder, tensors: Sequence[str], terms: Sequence[str], result: str, name: str) -> str:
    """Two operands as matrix products: [batch…, rows, inner] × [batch…, inner, columns]."""
    first, second = terms
    batch = [c for c in first if c in second and c in result]
    inner = [c for c in first if c in second and c not in result]
    rows, columns = ([c for c in t if c not in o] for t, o in ((first, second), (second, first)))
    shapes = [b.add("Shape", [t], f"{name}/shape", out_type=INT32) for t in tensors]

    def length(label: str) -> str:
        term = 0 if label in first else 1
        axis = terms[term].index(label)
        at = [b.const(np.array([n], INT32), f"{name}/at") for n in (axis, axis + 1, 1)]
        return b.add("StridedSlice", [shapes[term], *at], f"{name}/length", shrink_axis_mask=1)

    def side(labels: Sequence[str], *, known: bool) -> str:
        """The number of elements of one axis made of these; -1 where it is the one that is left open."""
        if not known or not labels:
            return b.const(np.array(-1 if labels else 1, INT32), f"{name}/open")
        count = length(labels[0])
        for label in labels[1:]:
            count = b.add("Mul", [count, length(label)], f"{name}/count")
        return count

    matrices = []
    for tensor, term, sides in zip(tensors, terms, ((rows, inner), (inner, columns)), strict=True):
        value = _transpose(b, tensor, term, "".join([*batch, *sides[0], *sides[1]]), name)
        if [len(s) for s in sides] != [1, 1]:
            dims = [*map(length, batch), *(side(s, known=s is inner) for s in sides)]
            value = b.add("Reshape", [value, b.add("Pack", dims, f"{name}/dims", axis=0)], f"{name}/matrix")
        matrices.append(value)
    value = b.add("BatchMatMul" if batch else "MatMul", matrices, f"{name}/product")
    order = [*batch, *rows, *columns]
    if [len(rows), len(columns)] != [1, 1]:
        dims = [length(c) for c in order]
        shape = b.add("Pack", dims, f"{name}/dims", axis=0) if dims else b.const(np.zeros(0, INT32), f"{name}/dims")
        value = b.add("Reshape", [value, shape], f"{name}/whole")
    return _transpose(b, value, "".join(order), result, name)


def _transpose(b: NodeBuilder, tensor: str, term: str, result: str, name: str) -> str:
    if term == result:
        return tensor
    order = b.const(np.array([term.index(c) for c in result], INT32), f"{name}/order")
    return b.add("Transpose", [tensor, order], f"{name}/turned")
