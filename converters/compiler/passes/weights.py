"""Weights in less room: rounded to what float16 holds, or to 255 steps for each output of their layer.

*Rounding* is a pass on numbers alone: weights stay float32, so whatever reads, runs or compares the graph goes on as
before. *Storing* is the writers' and changes no number: a constant takes fewer bytes where each of its numbers comes
back as it was, from a Cast, or a Cast and a Mul. (ONNX's DequantizeLinear would do as well, but onnxruntime keeps it
for integer kernels and computes it at every run, where it folds a Cast and a Mul once.)

Only what a layer multiplies by is rounded: biases, normalisers, masks and indices are small, or ask for every digit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import traits
from export_model.converters.graph.types import FLOAT32

#: How weights are kept.
Storage = Literal["float32", "float16", "int8"]
#: Numbers that a weight has at least: below, the ops that widen it take more room than it saves.
LEAST = 256
#: The steps on either side of zero; the length of one has so few bits that the product of the two is exact in float32.
_STEPS, _STEP_BITS = 127, 16


def round_weights(graph: Graph, storage: Storage) -> Graph:
    """The graph with its weights rounded; one that would overflow, or is whole numbers, stays as it is."""
    readers = graph.consumers()
    editor = Editor(graph)
    for node in graph.nodes:
        axis = _channels(node, readers[node.name])
        found = None if axis is None or node.value is None else _round_array(node.value, storage, axis)
        editor.keep(node if found is None else Node(node.name, node.op, value=found, origin=node.origin))
    return editor.graph()


def store_compactly(graph: Graph, storage: Storage) -> Graph:
    """The graph with weights that were rounded as constants of fewer bytes, widened under the weights' own names."""
    if storage == "float32":
        return graph
    editor = Editor(graph)
    for node in graph.nodes:
        found = None if node.value is None else compact(node.value, storage)
        if found is None:
            editor.keep(node)
            continue
        narrow, step = found
        cast: dict[str, Any] = {"DstT": FLOAT32, "Truncate": False}
        wide = editor.const(narrow, f"{node.name}/{storage}")
        if step is None:
            editor.keep(Node(node.name, "Cast", (wide,), cast, origin=node.origin))
        else:
            wide = editor.add("Cast", [wide], f"{node.name}/steps", **cast)
            scale = editor.const(step, f"{node.name}/step")
            editor.keep(Node(node.name, "Mul", (wide, scale), origin=node.origin))
    return editor.graph()


def are_steps(array: np.ndarray) -> bool:
    """Whether a float32 constant holds what int8 does."""
    if array.dtype != FLOAT32 or array.size < LEAST:
        return False
    return bool((array == np.rint(array)).all() and (np.abs(array) <= _STEPS).all())


def compact(array: np.ndarray, storage: Storage) -> tuple[np.ndarray, np.ndarray | None] | None:
    """(the numbers in fewer bytes, the length of a step for each channel); None where one would not come back."""
    if array.dtype != FLOAT32 or array.size < LEAST or not np.isfinite(array).all():
        return None
    if storage == "float16":
        half = _half(array)
        return (half, None) if np.array_equal(half.astype(np.float32), array) else None
    for axis in range(array.ndim - 1, -1, -1):
        step = _most(array, axis) / np.float32(_STEPS)
        step[step == 0] = 1
        steps = np.rint(array / step).astype(np.int8)
        if np.array_equal(steps * step, array):
            return steps, step
    return None


def _channels(node: Node, readers: Sequence[Node]) -> int | None:
    """The axis of a weight along which the outputs of its layer lie; None where it is no weight."""
    value = node.value
    if value is None or value.dtype != FLOAT32 or value.ndim < 2 or value.size < LEAST or not readers:
        return None
    if any(traits(r).layer not in ("dense", "convolution") or r.inputs.index(node.name) != 1 for r in readers):
        return None
    turned = {bool(r.attrs.get("transpose_b") or r.attrs.get("adj_y")) for r in readers}
    return None if len(turned) > 1 else value.ndim - 2 if turned.pop() else value.ndim - 1


def _round_array(array: np.ndarray, storage: Storage, axis: int) -> np.ndarray | None:
    if not np.isfinite(array).all() or (array == np.rint(array)).all():
        return None
    if storage == "float16":
        made = _half(array).astype(np.float32)
    else:
        # Rounded up, so that the largest number is 127 steps and tells the length of one.
        digits, exponent = np.frexp(_most(array, axis).astype(np.float64) / _STEPS)
        step = np.ldexp(np.ceil(np.ldexp(digits, _STEP_BITS)), exponent - _STEP_BITS).astype(np.float32)
        step[step == 0] = 1
        made = np.rint(array / step).astype(np.int8) * step
    return made if compact(made, storage) is not None else None


def _half(array: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore"):
        return array.astype(np.float16)


def _most(array: np.ndarray, axis: int) -> np.ndarray:
    """The largest magnitude of each channel, with axes of length 1 for the others."""
    return np.asarray(np.abs(array).max(axis=tuple(i for i in range(array.ndim) if i != axis), keepdims=True))
