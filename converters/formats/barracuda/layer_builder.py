"""Tensors of a ``.nn`` as tensors of a TensorFlow graph: [B, C] where height and width are 1, else NHWC.

A ``.nn`` knows only [N, H, W, C]; N is the batch of a policy, whose length is not known here (None). Constants, and
what is computed from constants alone, are vectors [C] where N = H = W = 1: they broadcast against both other forms.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from export_model.converters.formats.barracuda.format import Layer, four_axes
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import NameScope, Node
from export_model.converters.graph.ops.barracuda.vocabulary import layer_label
from export_model.signatures.errors import GraphError, UnsupportedOpError

#: N, H, W, C; N is None where it is the batch.
Shape = tuple[int | None, int, int, int]

#: Elements of one row of a tensor; a picture of 1024 by 1024 with 16 channels has as many.
MAX_NN_ELEMENTS = 1 << 24
_UNFIT = re.compile(r"[^A-Za-z0-9_.\-/]")


def node_name(name: str) -> str:
    """A name that a TensorFlow node may have (letters, digits and ``_.-/``, the first of them no ``_-/``)."""
    fit = _UNFIT.sub("_", name)
    return fit if re.match(r"[A-Za-z0-9.]", fit) else f"layer{fit}"


def with_length(shape: Shape, axis: int, length: int) -> Shape:
    """``shape`` with another length on an axis (0 to 3: N, H, W, C)."""
    rest = [length if i == axis else d for i, d in enumerate(shape[1:], start=1)]
    return length if axis == 0 else shape[0], rest[0], rest[1], rest[2]


class NnValue(Struct, frozen=True):
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


class LayerBuilder(Builder):
    """The builder of a ``.nn``'s graph, at a layer of it; ``notes`` are what the user should know of how it was read.

    ``reserved`` are the names of the nodes that stand for layers, inputs and outputs, ``version`` is the file's.
    """

    def __init__(self, reserved: Iterable[str], version: int) -> None:
        super().__init__(NameScope(reserved))
        self.version = version
        self.notes: list[str] = []
        self.layer = Layer("", 0)

    def start(self, layer: Layer, name: str) -> int:
        """Begin a layer whose node will be called ``name``; returns the number of nodes before it."""
        self.layer, self.prefix = layer, name
        return len(self.nodes)

    def note(self, text: str) -> None:
        """Say something once."""
        if text not in self.notes:
            self.notes.append(text)

    # ------------------------------------------------------------------ nodes

    def dataset(self, name: str, array: npt.NDArray[np.float32], node: str | None = None) -> NnValue:
        """A dataset [N, H, W, C] as a Const (``node``: its reserved name), in the form that its shape asks for."""
        n, h, w, c = array.shape
        form = array if (h, w) != (1, 1) else array.reshape(c) if n == 1 else array.reshape(n, c)
        made = Node(
            node or self.names.fresh(node_name(name)), "Const", value=form, origin=None if node is None else name
        )
        return NnValue(self.append(made), (n, h, w, c), array)

    def finish(self, value: str, started: int, name: str, origin: str | tuple[str, ...]) -> str:
        """Call the node behind ``value`` ``name``; one from before ``started``, or a constant, gets an Identity."""
        at = self.position.get(value, -1)
        new = at >= started and self.nodes[at].op != "Const"
        if new and not any(value in n.inputs for n in self.nodes[started:]):
            return self.rename(value, name, origin)
        return self.append(Node(name, "Identity", (value,), origin=origin))

    # ------------------------------------------------------------------ forms of a tensor

    def as_image(self, value: NnValue) -> str:
        """The tensor as [N, H, W, C]."""
        if value.rank == 4:
            return value.reference
        if value.constant is not None:
            return self.floats(value.constant, "nhwc")
        n, h, w, c = value.shape
        return self.add("Reshape", [value.reference, self.ints([-1 if n is None else n, h, w, c], "nhwc")])

    def as_matrix(self, value: NnValue) -> str:
        """The tensor as [N, H·W·C], rows flattened in the order H, W, C."""
        if value.rank == 2:
            return value.reference
        if value.constant is not None:
            return self.floats(value.constant.reshape(len(value.constant), -1), "matrix")
        return self.add("Reshape", [value.reference, self.ints([-1, value.size], "flat")], name="flatten")

    def as_vector(self, value: NnValue) -> str:
        """The tensor as a vector: a bias, slopes, indices."""
        if value.rank == 1:
            return value.reference
        if value.constant is not None:
            return self.floats(value.constant.reshape(-1), "vector")
        return self.add("Reshape", [value.reference, self.ints([-1], "vector")], name="list")

    def as_shape(self, reference: str, shape: Shape, integer: str | None = None) -> NnValue:
        """A tensor that has ``shape``'s elements in order, brought to the form that ``shape`` asks for."""
        n, *rest = shape
        rows = [] if shape[:3] == (1, 1, 1) else [-1 if n is None else n]
        to = self.ints([*rows, *(rest if shape[1:3] != (1, 1) else rest[2:])], "shape")
        made = None if integer is None else self.add("Reshape", [integer, to], name="integer")
        return NnValue(self.add("Reshape", [reference, to]), shape, integer=made)

    def rows(self, matrix: str, n: int | None, width: int, integer: str | None = None) -> NnValue:
        """A matrix [N, width] as a tensor."""
        shape = (n, 1, 1, width)
        return self.as_shape(matrix, shape, integer) if n == 1 else NnValue(matrix, shape, integer=integer)

    def operands(self, values: Sequence[NnValue]) -> tuple[list[str], Shape]:
        """References that broadcast against each other as the ``.nn`` means it, and the shape of the result."""
        shape = self.broadcast_shape(values)
        if shape[1:3] == (1, 1):
            return [v.reference for v in values], shape
        # Beside an image, [B, C] would be taken for [W, C]; a vector is right as it is.
        return [self.as_image(v) if v.rank == 2 else v.reference for v in values], shape

    def broadcast_shape(self, values: Sequence[NnValue]) -> Shape:
        """The shape of an elementwise result: on each axis the lengths are equal or 1."""
        dims: list[int | None] = [1, 1, 1, 1]
        for value in values:
            for axis, length in enumerate(value.shape):
                if length == dims[axis] or length == 1:
                    continue
                if dims[axis] != 1:
                    shapes = ", ".join(str(list(v.shape)) for v in values)
                    raise self.damaged_error(f"its inputs have the shapes {shapes}", "they do not broadcast")
                dims[axis] = length
        n, h, w, c = dims
        return n, int(h or 0), int(w or 0), int(c or 0)

    # ------------------------------------------------------------------ checks, errors

    def four(self, values: Sequence[int]) -> tuple[int, int, int, int]:
        """A shape among the layer's fields as N, H, W, C."""
        if len(values) in (4, 8):
            return four_axes(tuple(values), self.location)
        raise self.damaged_error(f"it holds {list(values)}", "a shape must have four or eight axes")

    def whole(self, array: npt.NDArray[np.float32]) -> list[int]:
        """Numbers that stand for lengths or indices, in order; a ``.nn`` holds them as floats."""
        with np.errstate(invalid="ignore"):
            fit = bool(np.all(np.abs(array) < MAX_NN_ELEMENTS))
        if not fit:
            raise self.damaged_error(f"an index or length in it is beyond {MAX_NN_ELEMENTS}", "its dataset is damaged")
        return [int(v) for v in array.reshape(-1)]

    def check_size(self, *lengths: int) -> None:
        """Refuse a tensor of more elements per row than any policy has, before anything is made for it."""
        if math.prod(lengths) > MAX_NN_ELEMENTS:
            raise self.unsupported_error(
                f"a tensor of {list(lengths)}", f"more than {MAX_NN_ELEMENTS} numbers are not read"
            )

    @property
    def location(self) -> str:
        """The layer that is being read."""
        return f"layer {self.layer.name!r} ({layer_label(self.layer.type)})"

    def damaged_error(self, what: str, why: str) -> GraphError:
        """The error for a layer that contradicts itself."""
        return GraphError(
            f"{self.location}: {what}",
            why=why,
            fix="convert the model again: the frozen_graph_def.pb beside the .nn is exported in its place",
        )

    def unsupported_error(self, what: str, why: str) -> UnsupportedOpError:
        """The error for a layer, or a variant of one, that is not translated."""
        return UnsupportedOpError(
            f"{self.location}: {what}",
            issues=[(self.layer.name, layer_label(self.layer.type))],
            why=why,
            fix="export the frozen_graph_def.pb or the .onnx that the model was converted from",
        )
