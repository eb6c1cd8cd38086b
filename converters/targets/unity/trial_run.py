"""The run on zeros with which ML-Agents 3.0 and later begin: what it throws, told from types and shapes.

Every free length is 1 in it. Nothing is computed here: an input of integers is refused before the run, one of length 0
has no memory, and lengths that do not fit are met by shape inference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from converters.targets.unity.consumers import Consumer
from converters.targets.unity.findings import Thrown, null_reference
from converters.targets.unity.onnx_file import OnnxFile, attributes

_FAILED = "Assertion failure. Value was False. Expected: True"

_FREE = "the model must run with every free length at 1: declare all lengths of the observations but the batch"
_BROADCAST = frozenset({"Add", "Sub", "Mul", "Div", "Pow", "Where", "Max", "Min", "Equal", "Greater", "Less"})
#: Ops whose result holds no element of a tensor.
_MAY_BE_EMPTY = frozenset({"Shape", "Constant", "Slice"})

Shape = tuple[int, ...]


def failure(file: OnnxFile, consumer: Consumer) -> Thrown | None:
    """The exception that the run throws, None where it runs."""
    for index, given in enumerate(file.inputs):
        if not given.is_float:
            return Thrown(
                "AssertionException",
                f"{_FAILED} Cannot set input tensor {index} as data types do not match, expected Int received Float",
                f"input {given.name}",
                f"declare the input float32, with a Cast behind it; --for {consumer.profile} does. Only the Editor "
                "asserts it: in a release player the run may go on",
            )
    for given in file.inputs:
        if given.dims is not None and 0 in given.dims:
            return null_reference(f"input {given.name}", "leave the batch free, and no length 0")
    return next((found for node in file.model.graph.node if (found := _mismatch(file, node)) is not None), None)


def _mismatch(file: OnnxFile, node: Any) -> Thrown | None:
    known: list[Shape] = []
    for name in node.input:
        shape = file.shapes.get(name) if name else ()
        lengths = tuple(d for d in shape or () if d is not None)
        if shape is None or len(lengths) != len(shape):
            return None
        known.append(lengths)
    where = f"node {node.output[0] if node.output else node.name} ({node.op_type})"
    if any(0 in file.shapes.get(name, ()) for name in node.output) and node.op_type not in _MAY_BE_EMPTY:
        return null_reference(where, _FREE)
    if node.op_type in _TESTS:
        text = _TESTS[node.op_type](file, node, known)
        return None if text is None else Thrown("AssertionException", f"{_FAILED} ValueError: {text}", where, _FREE)
    if node.op_type in _BROADCAST and not _broadcasts(known):
        lengths_text = " and ".join(_text(s) for s in known)
        return Thrown("AssertionException", f"{lengths_text} do not broadcast", where, _FREE, worded=False)
    return None


def _broadcasts(shapes: Sequence[Shape]) -> bool:
    for axis in range(1, max((len(s) for s in shapes), default=0) + 1):
        lengths = {s[-axis] for s in shapes if len(s) >= axis} - {1}
        if len(lengths) > 1:
            return False
    return True


def _product(file: OnnxFile, node: Any, shapes: Sequence[Shape]) -> str | None:
    del file
    if len(shapes) < 2:
        return None
    left, right = shapes[0], shapes[1]
    if node.op_type == "Gemm":
        held = attributes(node)
        left = left[::-1] if "transA" in held and held["transA"].i else left
        right = right[::-1] if "transB" in held and held["transB"].i else right
    if len(left) < 2 or len(right) < 2 or left[-1] == right[-2]:
        return None
    return f"dimension does not match for matmul {_text(left)}, {_text(right)}"


def _reshape(file: OnnxFile, node: Any, shapes: Sequence[Shape]) -> str | None:
    wanted = file.value(node.input[1]) if len(node.input) > 1 else None
    if wanted is None:
        return None
    before = shapes[0]
    if 0 in before:
        return None
    lengths = [before[i] if n == 0 and i < len(before) else int(n) for i, n in enumerate(wanted.ravel())]
    size, rest = _size(before), _size([n for n in lengths if n != -1])
    fits = size == rest if -1 not in lengths else rest != 0 and size % rest == 0
    return None if fits else "reshaped length does not match with input length"


def _text(shape: Shape) -> str:
    return f"({', '.join(map(str, shape))})"


def _size(shape: Sequence[int]) -> int:
    size = 1
    for length in shape:
        size *= length
    return size


_TESTS: dict[str, Callable[[OnnxFile, Any, Sequence[Shape]], str | None]] = {
    "Gemm": _product,
    "MatMul": _product,
    "Reshape": _reshape,
}
