"""Whether LiteRT for Microcontrollers has the operators of a file, and how much memory its arena takes.

Facts: tflite-micro 0.dev20261023182759 (its ``python_ops_resolver.cc``, the widest list there, and what the
interpreter of that package said of files for one agent; x86-64). A board's own resolver may list fewer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from msgspec import Struct

from export_model.converters.formats.litert.artifact import operator_of
from export_model.converters.formats.litert.flatbuffer import Table, decode
from export_model.converters.formats.litert.tensors import dims_of, dtype_of, entry_of
from export_model.converters.graph.types import INT32, INT64

VERSION = "tflite-micro 0.dev20261023182759"
_OPERATORS = frozenset(
    (
        *("ABS", "ADD", "ADD_N", "ARG_MAX", "ARG_MIN", "AVERAGE_POOL_2D", "BATCH_TO_SPACE_ND", "BROADCAST_ARGS"),
        *("BROADCAST_TO", "CAST", "CEIL", "CONCATENATION", "CONV_2D", "COS", "CUMSUM", "DEPTHWISE_CONV_2D"),
        *("DEQUANTIZE", "DIV", "ELU", "EQUAL", "EXP", "EXPAND_DIMS", "FILL", "FLOOR", "FLOOR_DIV", "FLOOR_MOD"),
        *("FULLY_CONNECTED", "GATHER", "GATHER_ND", "GREATER", "GREATER_EQUAL", "HARD_SWISH", "LEAKY_RELU", "LESS"),
        *("LESS_EQUAL", "LOG", "LOG_SOFTMAX", "LOGICAL_AND", "LOGICAL_NOT", "LOGICAL_OR", "LOGISTIC"),
        *("MAX_POOL_2D", "MAXIMUM", "MEAN", "MINIMUM", "MUL", "NEG", "NOT_EQUAL", "PACK", "PAD", "PADV2", "PRELU"),
        *("QUANTIZE", "REDUCE_MAX", "RELU", "RELU6", "RESHAPE", "ROUND", "RSQRT", "SELECT_V2", "SHAPE", "SIN"),
        *("SLICE", "SOFTMAX", "SPLIT", "SPLIT_V", "SQRT", "SQUARE", "SQUARED_DIFFERENCE", "SQUEEZE"),
        *("STRIDED_SLICE", "SUB", "SUM", "TANH", "TRANSPOSE", "UNPACK", "ZEROS_LIKE"),
    )
)
#: (operator, whether of its first operand or of its result) → a dtype that it does not take there, as it said.
_REFUSED: Mapping[tuple[str, str], np.dtype] = {
    ("ARG_MAX", "outputs"): INT64,
    ("ARG_MIN", "outputs"): INT64,
    ("GATHER", "inputs"): INT32,
}
#: Bytes of the arena beside tensors: for each tensor, for each operator, and for the model (measured, 64 bits).
_PER_TENSOR, _PER_OPERATOR, _PER_MODEL = 24, 112, 1200
_ALIGNMENT = 16


class Fit(Struct, frozen=True):
    """What stands against running a file (nothing where it runs), and the arena's bytes, about."""

    lacks: tuple[str, ...]
    arena: int


def fit(data: bytes) -> Fit:
    """How a file for a fixed number of agents fits. Raises DamagedFileError."""
    model = decode(data)
    lacks: dict[str, None] = {}
    tensors = operators = 0
    largest = 0
    for number, subgraph in enumerate(model.get("subgraphs", ())):
        tensors += len(subgraph.get("tensors", ()))
        operators += len(subgraph.get("operators", ()))
        largest = max(largest, _planned_bytes(subgraph, runs=number == 0))
        for operator in subgraph.get("operators", ()):
            lacks |= dict.fromkeys(_faults(model, subgraph, operator))
    arena = largest + _PER_TENSOR * tensors + _PER_OPERATOR * operators + _PER_MODEL
    return Fit(tuple(lacks), arena)


def _faults(model: Table, subgraph: Table, operator: Table) -> list[str]:
    kind = operator_of(entry_of(model, "operator_codes", operator.get("opcode_index", 0)))
    if kind not in _OPERATORS:
        return [kind]
    found = []
    for side in ("inputs", "outputs"):
        refused = _REFUSED.get((kind, side))
        numbers = operator.get(side, ())
        if refused is not None and len(numbers) and numbers[0] >= 0:
            dtype = dtype_of(entry_of(subgraph, "tensors", int(numbers[0])))
            found += [f"{kind} of {dtype}"] if dtype == refused else []
    return found


def _planned_bytes(subgraph: Table, *, runs: bool) -> int:
    """Bytes of the tensors that are computed, as ``GreedyMemoryPlanner`` lays them.

    The largest is laid first, each as low as it can lie beside those that are needed while it is. Those of the
    signature that is not called (the second) lie side by side.
    """
    first: dict[int, int] = {int(i): 0 for i in subgraph.get("inputs", ())}
    last: dict[int, int] = dict.fromkeys(first, 0)
    for time, operator in enumerate(subgraph.get("operators", ()), 1):
        for number in map(int, operator.get("outputs", ())):
            first.setdefault(number, time)
            last[number] = time
        for number in map(int, operator.get("inputs", ())):
            if number in first:
                last[number] = time
    end = len(subgraph.get("operators", ())) + 1
    last |= {int(i): end for i in subgraph.get("outputs", ()) if int(i) in first}
    sizes = {number: _bytes_of(entry_of(subgraph, "tensors", number)) for number in first}
    placed: list[tuple[int, int, int, int]] = []  # (offset, end, first, last)
    for number in sorted(first, key=lambda n: (-sizes[n], first[n])):
        offset = 0
        for start, stop, begins, ends in sorted(placed):
            beside = not runs or (begins <= last[number] and first[number] <= ends)
            if beside and start < offset + sizes[number] and offset < stop:
                offset = stop
        placed.append((offset, offset + sizes[number], first[number], last[number]))
    return max((stop for _, stop, _, _ in placed), default=0)


def _bytes_of(tensor: Table) -> int:
    """Bytes of a tensor, to the next multiple; a free axis counts as one."""
    dtype = dtype_of(tensor)
    size = math.prod(n or 1 for n in dims_of(tensor)) * (4 if dtype is None else dtype.itemsize)
    return -(-size // _ALIGNMENT) * _ALIGNMENT
