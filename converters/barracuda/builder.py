"""Tensors of a ``.nn`` as tensors of a TensorFlow graph: [B, C] where height and width are 1, else NHWC.

A ``.nn`` knows only [N, H, W, C]; N is the batch of a policy, whose length is not known here (None). Constants, and
what is computed from constants alone, are vectors [C] where N = H = W = 1: they broadcast against both other forms.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from converters.barracuda.format import Layer, four_axes
from converters.barracuda.vocabulary import layer_label
from converters.graph.editor import Editor
from converters.graph.nodes import Graph, Node
from converters.graph.types import FLOAT32, INT32
from signatures.errors import GraphError, UnsupportedOpError

#: N, H, W, C; N is None where it is the batch.
Shape = tuple[int | None, int, int, int]

#: Elements of one row of a tensor; a picture of 1024 by 1024 with 16 channels has as many.
MAX_ELEMENTS = 1 << 24
_UNFIT = re.compile(r"[^A-Za-z0-9_.\-/]")


def node_name(name: str) -> str:
    """A name that a TensorFlow node may have (letters, digits and ``_.-/``, the first of them no ``_-/``)."""
    fit = _UNFIT.sub("_", name)
    return fit if re.match(r"[A-Za-z0-9.]", fit) else f"layer{fit}"


def with_length(shape: Shape, axis: int, length: int) -> Shape:
    """``shape`` with another length on an axis (0 to 3: N, H, W, C)."""
    rest = [length if i == axis else d for i, d in enumerate(shape[1:], start=1)]
    return length if axis == 0 else shape[0], rest[0], rest[1], rest[2]


@dataclass(frozen=True, slots=True)
class Value:
    """A tensor: where it is, and its shape in the ``.nn``.

    ``constant`` are its numbers [N, H, W, C] where they are known; ``integer`` is the same tensor before a ``.nn``
    made floats of it (a previous action, a drawn class): an action is given as integers, an index is read from them.
    """

    reference: str
    shape: Shape
    constant: npt.NDArray[np.float32] | None = None
    integer: str | None = None

    @property
    def rank(self) -> int:
        """Axes in the graph: 1 for a vector [C], 2 for [B, C], 4 for an image."""
        return 4 if self.shape[1:3] != (1, 1) else 1 if self.shape[0] == 1 else 2

    @property
    def n(self) -> int | None:
        """The rows; None: the batch."""
        return self.shape[0]

    @property
    def h(self) -> int:
        """The height."""
        return self.shape[1]

    @property
    def w(self) -> int:
        """The width."""
        return self.shape[2]

    @property
    def c(self) -> int:
        """The channels."""
        return self.shape[3]

    @property
    def size(self) -> int:
        """The elements of one row: H·W·C."""
        return self.h * self.w * self.c


class Builder:
    """Collects the nodes of the graph; ``notes`` are what the user should know of how it was read."""

    def __init__(self, reserved: Iterable[str]) -> None:
        # The editor keeps off the names of a graph's nodes: those that stand for layers, inputs and outputs.
        self._editor = Editor(Graph(tuple(Node(name, "NoOp") for name in sorted(set(reserved)))))
        self.notes: list[str] = []
        self.layer = Layer("", 0)
        self._label = ""

    def start(self, layer: Layer, name: str) -> int:
        """Begin a layer whose node will be called ``name``; returns the number of nodes before it."""
        self.layer, self._label = layer, name
        return len(self._editor.nodes)

    def graph(self) -> Graph:
        """The nodes in topological order."""
        return self._editor.graph()

    def note(self, text: str) -> None:
        """Say something once."""
        if text not in self.notes:
            self.notes.append(text)

    # ------------------------------------------------------------------ nodes

    def op(self, op: str, inputs: Sequence[str], *, label: str | None = None, **attrs: Any) -> str:
        """A node of the current layer."""
        return self._editor.add(op, inputs, f"{self._label}/{label or op}", **attrs)

    def sample(self, op: str, size: str) -> str:
        """A sampler of normals; it carries the layer's name, which reports of lifted noise give."""
        return self._editor.add(op, [size], f"{self._label}/{op}", self.layer.name, dtype=FLOAT32)

    def const(self, array: npt.ArrayLike, label: str, dtype: np.dtype = FLOAT32) -> str:
        """A Const of the current layer."""
        return self._editor.const(np.asarray(array, dtype), f"{self._label}/{label}")

    def ints(self, values: npt.ArrayLike, label: str) -> str:
        """An int32 Const: a shape, axes, bounds."""
        return self.const(values, label, INT32)

    def constant(self, name: str, array: npt.NDArray[np.float32], node: str | None = None) -> Value:
        """A dataset [N, H, W, C] as a Const (``node``: its reserved name), in the form that its shape asks for."""
        n, h, w, c = array.shape
        form = array if (h, w) != (1, 1) else array.reshape(c) if n == 1 else array.reshape(n, c)
        if node is None:
            reference = self._editor.const(form, node_name(name))
        else:
            reference = self.place(Node(node, "Const", value=form, origin=name))
        return Value(reference, (n, h, w, c), array)

    def place(self, node: Node) -> str:
        """A node whose name was reserved."""
        self._editor.nodes.append(node)
        return node.name

    def finish(self, value: str, started: int, name: str, origin: str | tuple[str, ...]) -> str:
        """Call the node behind ``value`` ``name``; one from before ``started``, or a constant, gets an Identity."""
        nodes = self._editor.nodes
        for index in range(len(nodes) - 1, started - 1, -1):
            if nodes[index].name == value and nodes[index].op != "Const":
                if any(value in n.inputs for n in nodes[started:]):
                    break
                nodes[index] = replace(nodes[index], name=name, origin=origin)
                return name
        return self.place(Node(name, "Identity", (value,), origin=origin))

    # ------------------------------------------------------------------ forms of a tensor

    def image(self, value: Value) -> str:
        """The tensor as [N, H, W, C]."""
        if value.rank == 4:
            return value.reference
        if value.constant is not None:
            return self.const(value.constant, "nhwc")
        n, h, w, c = value.shape
        return self.op("Reshape", [value.reference, self.ints([-1 if n is None else n, h, w, c], "nhwc")])

    def matrix(self, value: Value) -> str:
        """The tensor as [N, H·W·C], rows flattened in the order H, W, C."""
        if value.rank == 2:
            return value.reference
        if value.constant is not None:
            return self.const(value.constant.reshape(len(value.constant), -1), "matrix")
        return self.op("Reshape", [value.reference, self.ints([-1, value.size], "flat")], label="flatten")

    def vector(self, value: Value) -> str:
        """The tensor as a vector: a bias, slopes, indices."""
        if value.rank == 1:
            return value.reference
        if value.constant is not None:
            return self.const(value.constant.reshape(-1), "vector")
        return self.op("Reshape", [value.reference, self.ints([-1], "vector")], label="list")

    def shaped(self, reference: str, shape: Shape, integer: str | None = None) -> Value:
        """A tensor that has ``shape``'s elements in order, brought to the form that ``shape`` asks for."""
        n, *rest = shape
        rows = [] if shape[:3] == (1, 1, 1) else [-1 if n is None else n]
        to = self.ints([*rows, *(rest if shape[1:3] != (1, 1) else rest[2:])], "shape")
        made = None if integer is None else self.op("Reshape", [integer, to], label="integer")
        return Value(self.op("Reshape", [reference, to]), shape, integer=made)

    def rows(self, matrix: str, n: int | None, width: int, integer: str | None = None) -> Value:
        """A matrix [N, width] as a tensor."""
        shape = (n, 1, 1, width)
        return self.shaped(matrix, shape, integer) if n == 1 else Value(matrix, shape, integer=integer)

    def operands(self, values: Sequence[Value]) -> tuple[list[str], Shape]:
        """References that broadcast against each other as the ``.nn`` means it, and the shape of the result."""
        shape = self.broadcast(values)
        if shape[1:3] == (1, 1):
            return [v.reference for v in values], shape
        # Beside an image, [B, C] would be taken for [W, C]; a vector is right as it is.
        return [self.image(v) if v.rank == 2 else v.reference for v in values], shape

    def broadcast(self, values: Sequence[Value]) -> Shape:
        """The shape of an elementwise result: on each axis the lengths are equal or 1."""
        dims: list[int | None] = [1, 1, 1, 1]
        for value in values:
            for axis, length in enumerate(value.shape):
                if length == dims[axis] or length == 1:
                    continue
                if dims[axis] != 1:
                    shapes = ", ".join(str(list(v.shape)) for v in values)
                    raise self.damaged(f"its inputs have the shapes {shapes}", "they do not broadcast")
                dims[axis] = length
        n, h, w, c = dims
        return n, int(h or 0), int(w or 0), int(c or 0)

    # ------------------------------------------------------------------ checks, errors

    def four(self, values: Sequence[int]) -> tuple[int, int, int, int]:
        """A shape among the layer's fields as N, H, W, C."""
        if len(values) in (4, 8):
            return four_axes(tuple(values), self.where)
        raise self.damaged(f"it holds {list(values)}", "that is no shape of four or eight axes")

    def whole(self, array: npt.NDArray[np.float32]) -> list[int]:
        """Numbers that stand for lengths or indices, in order; a ``.nn`` holds them as floats."""
        with np.errstate(invalid="ignore"):
            fit = bool(np.all(np.abs(array) < MAX_ELEMENTS))
        if not fit:
            raise self.damaged("an index or length in it is no number of that size", "its dataset is damaged")
        return [int(v) for v in array.reshape(-1)]

    def sized(self, *lengths: int) -> None:
        """Refuse a tensor of more elements per row than any policy has, before anything is made for it."""
        if math.prod(lengths) > MAX_ELEMENTS:
            raise self.unsupported(f"a tensor of {list(lengths)}", f"more than {MAX_ELEMENTS} numbers are not read")

    @property
    def where(self) -> str:
        """The layer that is being read."""
        return f"layer {self.layer.name!r} ({layer_label(self.layer.type)})"

    def damaged(self, what: str, why: str) -> GraphError:
        """The error for a layer that contradicts itself."""
        return GraphError(
            f"{self.where}: {what}",
            why=why,
            fix="convert the model again: the frozen_graph_def.pb beside the .nn is exported in its place",
        )

    def unsupported(self, what: str, why: str) -> UnsupportedOpError:
        """The error for a layer, or a variant of one, that is not translated."""
        return UnsupportedOpError(
            f"{self.where}: {what}",
            issues=[(self.layer.name, layer_label(self.layer.type))],
            why=why,
            fix="export the frozen_graph_def.pb or the .onnx that the model was converted from",
        )
