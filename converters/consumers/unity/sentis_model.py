"""What Sentis and the Inference Engine hold after importing an ONNX: shapes as they are, float or int.

ML-Agents runs the model once on zeros and reads its constants from the **outputs**, as float tensors (the deprecated
pair as int tensors); a wrong type is an InvalidCastException. Outputs are found by a part of their name. A free length
counts as 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import zip_longest
from typing import Any, ClassVar

import numpy as np
from msgspec import Struct, field

from export_model.converters.consumers.mlagents.names import CONTINUOUS, DISCRETE
from export_model.converters.consumers.unity.barracuda_model import trim_index
from export_model.converters.consumers.unity.consumers import Consumer
from export_model.converters.consumers.unity.findings import Thrown, UnityThrows, null_reference
from export_model.converters.consumers.unity.model import CheckedModel, InputView, truncate
from export_model.converters.consumers.unity.onnx_file import Dims, OnnxFile, attributes
from export_model.signatures.roles import (
    ACTION_SHAPE,
    CONTINUOUS_SHAPE,
    DISCRETE_SHAPE,
    IS_CONTINUOUS,
    MEMORY_SIZE,
    VERSION_NUMBER,
)

_SINGLE, _INT32 = "Single", "Int32"


class SentisModel(CheckedModel, Struct, frozen=True, dict=True):
    """A model in Sentis; ``values`` are the outputs that are read as constants, with their type."""

    by_substring: ClassVar[bool] = True

    inputs: tuple[InputView, ...]
    outputs: tuple[str, ...]
    values: Mapping[str, np.ndarray] = field(default_factory=dict)
    namespace: str = "Unity.Sentis"
    memories: tuple[str, ...] = ()

    def load(self, deterministic: bool) -> None:
        """Read what ML-Agents reads at once when it loads a model, in its order; raises what that throws."""
        for _ in (
            self.version,
            self.has_continuous(deterministic),
            self.has_discrete(deterministic),
            self.memory_size,
            self.continuous_size,
            self.discrete_size,
        ):
            pass

    def constant(self, name: str) -> np.ndarray | None:
        """An output's numbers by its whole name."""
        found = self.values.get(name)
        return None if found is None else found.astype(np.float64).ravel()

    def _read(self, name: str, wanted: str) -> np.ndarray | None:
        """An output as a tensor of one type; InvalidCastException where it has the other."""
        found = self.values.get(name)
        if found is None:
            return None
        held = _SINGLE if found.dtype.kind == "f" else _INT32
        if held != wanted:
            tensor = f"{self.namespace}.Tensor`1[System.{{}}]"
            raise UnityThrows(
                Thrown(
                    "InvalidCastException",
                    f"Unable to cast object of type '{tensor.format(held)}' to type '{tensor.format(wanted)}'.",
                    f"constant {name}",
                    f"give out {name} as {'float32' if wanted == _SINGLE else 'int32'}",
                )
            )
        return found.ravel()

    def _shape(self, name: str) -> np.ndarray | None:
        return self._read(name, _SINGLE)

    def _first_of_shape(self, name: str) -> int:
        """0 where it is not there."""
        found = self._shape(name)
        return 0 if found is None or not found.size else truncate(found[0])

    def _deprecated_number(self, name: str) -> int:
        found = self._read(name, _INT32)
        if found is None:
            raise UnityThrows(null_reference(f"constant {name}", f"name the actions {CONTINUOUS} or {DISCRETE}"))
        return truncate(found[0]) if found.size else 0

    @cached_property
    def version(self) -> int:
        """The API version; −1 where there is none, or none above 0."""
        number = self._first_of_shape(VERSION_NUMBER)
        return number if number > 0 else -1

    @cached_property
    def memory_size(self) -> int:
        """The memory's size; 0 where the file does not say it."""
        return self._first_of_shape(MEMORY_SIZE)


def of_onnx(file: OnnxFile, consumer: Consumer) -> SentisModel:
    """The model that the importer makes; ``importing.refusal`` has said before that it takes the file."""

    def name_of(name: str) -> str:
        return trim_index(name) if consumer.strips_zero else name

    read = (VERSION_NUMBER, MEMORY_SIZE, CONTINUOUS_SHAPE, DISCRETE_SHAPE, IS_CONTINUOUS, ACTION_SHAPE)
    values = {name_of(n): file.trial_value(n) for n in file.outputs if name_of(n) in read}
    return SentisModel(
        tuple(_input(name_of(i.name), i.dims or ()) for i in file.inputs),
        tuple(name_of(n) for n in file.outputs),
        {name: value for name, value in values.items() if value is not None},
        consumer.namespace,
    )


def _input(name: str, dims: Dims) -> InputView:
    lengths = [1 if d is None or d < 0 else d for d in dims]
    rank = len(lengths)
    return InputView(
        name,
        height=lengths[-2] if rank > 3 else 1,
        width=lengths[-1] if rank > 2 else 1,
        channels=lengths[1] if rank > 1 else 1,
        last=lengths[-1] if lengths else 1,
    )


_FAILED = "Assertion failure. Value was False. Expected: True"

_FREE = "the model must run with every free length at 1: declare all lengths of the observations but the batch"
_BROADCAST = frozenset({"Add", "Sub", "Mul", "Div", "Pow", "Where", "Max", "Min", "Equal", "Greater", "Less"})
#: Ops whose result holds no element of a tensor.
_MAY_BE_EMPTY = frozenset({"Shape", "Constant", "Slice"})

Shape = tuple[int, ...]


def failure(file: OnnxFile, consumer: Consumer) -> Thrown | None:
    """What the run on zeros throws with which ML-Agents 3.0 and later begin; None where it runs.

    It is told from types and shapes, with every free length 1. Nothing is computed here: an input of integers is
    refused before the run, one of length 0 has no memory, and lengths that do not fit are met by shape inference.
    """
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
    columns = zip_longest(*(s[::-1] for s in shapes), fillvalue=1)
    return all(len(set(lengths) - {1}) < 2 for lengths in columns)


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
    size, rest = math.prod(before), math.prod(n for n in lengths if n != -1)
    fits = size == rest if -1 not in lengths else rest != 0 and size % rest == 0
    return None if fits else "reshaped length does not match with input length"


def _text(shape: Shape) -> str:
    return f"({', '.join(map(str, shape))})"


_TESTS: dict[str, Callable[[OnnxFile, Any, Sequence[Shape]], str | None]] = {
    "Gemm": _product,
    "MatMul": _product,
    "Reshape": _reshape,
}
