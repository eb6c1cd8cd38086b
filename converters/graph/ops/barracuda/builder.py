"""The layers of a ``.nn`` that are written so far, and the tensors that they give (``values``)."""

from __future__ import annotations

import bisect
import itertools
import math
import re
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.graph.nn.choosing import MAX_TABLE
from export_model.converters.graph.nodes import NameScope, Node
from export_model.converters.graph.ops.barracuda.values import FREE, Array, Axes, Dims, Piece, Value, usual_axes
from export_model.converters.graph.ops.barracuda.vocabulary import Activation, C, LayerType, N
from export_model.converters.graph.size_limits import MAX_MADE, Allowance
from export_model.converters.graph.types import BATCH, Dim, TensorType
from export_model.signatures.errors import UnsupportedOpError

#: Tensors that a tensor is joined from.
MAX_PIECES = 1 << 10
#: What ML-Agents' converter writes where a layer has no pads.
NO_PADS = (0, 0, 0, 0)
_UNFIT = re.compile(r"[^\x21-\x7e]")


class Draft(Struct, frozen=True):
    """A layer before its constants have their places in the weights; ``data`` are they, each [N, H, W, C]."""

    name: str
    type: LayerType
    inputs: tuple[str, ...] = ()
    activation: Activation = Activation.NONE
    pad: tuple[int, ...] = NO_PADS
    stride: tuple[int, ...] = ()
    pool: tuple[int, ...] = ()
    axis: int = -1
    alpha: float = 1.0
    beta: float = 0.0
    data: tuple[tuple[str, Array], ...] = ()


class NnBuilder:
    """Collects layers. ``names`` are taken by inputs, outputs and memories before the first layer is made.

    ``draws``: classes are drawn by the model, as ML-Agents expects from release 17 (Barracuda 1.4) on; 1.1 draws
    once for all agents.
    """

    def __init__(self, types: Mapping[str, TensorType], names: Sequence[str], *, draws: bool = False) -> None:
        self.types, self.draws = types, draws
        self.drafts: list[Draft] = []
        self.node = Node("", "NoOp")
        held = sum(t.value.size for t in types.values() if t.value is not None)
        self._allowance = Allowance(MAX_MADE + held)
        self._names = NameScope(names)
        self._inputs: list[str] = []
        self._dims: dict[str, Dims] = {}
        self._constants: dict[tuple[Dims, bytes], str] = {}
        self._joined: dict[tuple[Piece, ...], str] = {}
        #: the pieces that were cut last, and where each ends: a Split cuts the same ones again and again
        self._cut: tuple[Piece, ...] = ()
        self._ends: list[int] = []
        self._spread: dict[str, str] = {}

    # ------------------------------------------------------------------ what is known of the graph

    def type_of(self, reference: str) -> TensorType:
        """What is known of a tensor of the graph."""
        return self.types[reference]

    def shape_of(self, reference: str) -> tuple[Dim, ...]:
        """The shape of a tensor of the graph; raises UnsupportedOpError where it is not known but for the batch."""
        shape = self.types[reference].shape
        if shape is None or any(isinstance(d, str) and d != BATCH for d in shape) or list(shape).count(BATCH) > 1:
            raise self.nn_error(
                f"the shape of {reference!r} is {'unknown' if shape is None else list(shape)}",
                "the layers of a .nn have lengths that are known, all but the batch",
            )
        return shape

    def constant_operand(self, position: int, meaning: str) -> npt.NDArray[np.generic]:
        """The constant operand of the current node, or UnsupportedOpError."""
        value = self.types[self.node.inputs[position]].constant
        if value is None:
            raise self.nn_error(f"{meaning} is computed while the graph runs", "a .nn holds it as plain numbers")
        return value

    def nn_error(self, what: str, why: str, fix: str | None = None) -> UnsupportedOpError:
        """The error for what a ``.nn`` cannot hold."""
        return UnsupportedOpError(
            f"node {self.node.name!r} ({self.node.op}) cannot be written to a .nn: {what}",
            issues=[(self.node.name, self.node.op)],
            why=why,
            fix=fix or "leave nn out of --to: the ONNX of the same policy holds it",
        )

    def made_up(self, elements: int) -> None:
        """Count numbers that are about to be made, beside those of the graph; raises UnsupportedOpError."""
        if not self._allowance.take(elements):
            raise self.nn_error(
                f"its constants unfold to {elements} numbers more",
                "a .nn holds each as a plain number, and no policy has so many",
            )

    def table(self, rows: int, columns: int) -> tuple[int, int]:
        """The shape of a matrix that is about to be made; raises UnsupportedOpError where it is too large."""
        if rows * columns > MAX_TABLE:
            raise self.nn_error(
                f"a table of {rows}×{columns} numbers",
                f"it is computed by comparing each with each, and no more than {MAX_TABLE} pairs are",
            )
        self.made_up(rows * columns)
        return rows, columns

    # ------------------------------------------------------------------ layers

    def layer(
        self,
        kind: LayerType,
        inputs: Sequence[str],
        dims: Dims,
        *,
        label: str = "",
        data: Sequence[tuple[str, Array]] = (),
        activation: Activation = Activation.NONE,
        pad: tuple[int, ...] = NO_PADS,
        stride: tuple[int, ...] = (),
        pool: tuple[int, ...] = (),
        axis: int = -1,
        alpha: float = 1.0,
        beta: float = 0.0,
    ) -> str:
        """A layer of the current node that gives ``dims``; returns its name."""
        name = self.fresh(f"{self.node.name}/{label}" if label else self.node.name)
        named = tuple((f"{name}/{key}", np.ascontiguousarray(a, np.float32)) for key, a in data)
        self.drafts.append(
            Draft(
                name=name,
                type=kind,
                inputs=tuple(inputs),
                activation=activation,
                pad=pad,
                stride=stride,
                pool=pool,
                axis=axis,
                alpha=alpha,
                beta=beta,
                data=named,
            ),
        )
        self._dims[name] = dims
        return name

    def fresh(self, wish: str) -> str:
        """A free name like ``wish``, of plain characters."""
        return self._names.fresh(_UNFIT.sub("_", wish))

    def activation(self, kind: Activation, x: str, *, label: str = "", alpha: float = 1.0, beta: float = 0.0) -> str:
        """An Activation layer."""
        return self.layer(
            LayerType.ACTIVATION, [x], self.dims_of(x), activation=kind, label=label, alpha=alpha, beta=beta
        )

    def note_input(self, name: str, dims: Dims) -> None:
        """Note an input of the model (or of its memories)."""
        self._inputs.append(name)
        self._dims[name] = dims

    def constant_rows(self, row: Array, label: str) -> str:
        """The same numbers for every agent, [N, 1, 1, size]: an input times 0, plus them."""
        source = min(self._inputs, key=lambda name: math.prod(self._dims[name][1:]))
        width = math.prod(self._dims[source][1:])
        if self._dims[source][1:3] != (1, 1):
            source = self.layer(LayerType.FLATTEN, [source], (FREE, 1, 1, width), label=f"{label}/flat")
        self.made_up(width * row.size)
        return self.dense(source, np.zeros((width, row.size), np.float32), row, label)

    def like(self, dims: Dims) -> str | None:
        """A tensor that is computed so far and has ``dims``."""
        return next((d.name for d in reversed(self.drafts) if self._dims[d.name] == dims), None)

    def dims_of(self, name: str) -> Dims:
        """The lengths of a layer's result, an input or a constant."""
        return self._dims[name]

    def constant(self, array: npt.NDArray[np.generic], name: str | None = None) -> str:
        """A Load layer of one constant [N, H, W, C]; equal ones share it."""
        values = np.ascontiguousarray(array, np.float32)
        assert values.ndim == 4
        dims: Dims = values.shape
        key = (dims, values.tobytes())
        if name is None and key in self._constants:
            return self._constants[key]
        label = name or self.fresh(f"{self.node.name}/constant")
        # One dataset a layer: Barracuda 1.0 counts the weights of a Load of several twice, and would read on behind
        # them. ML-Agents looks a constant up by the name, which is here the layer's and the dataset's.
        self.drafts.append(Draft(label, LayerType.LOAD, data=((label, values),)))
        self._dims[label] = dims
        self._constants.setdefault(key, label)
        return label

    def number(self, value: float) -> str:
        """A constant [1, 1, 1, 1]."""
        return self.constant(np.full((1, 1, 1, 1), value, np.float32))

    def dense(self, x: str, kernel: npt.NDArray[np.generic], bias: npt.NDArray[np.generic], label: str = "") -> str:
        """``x`` flattened, times ``kernel`` [in, out], plus ``bias`` [out]: [N, 1, 1, out]."""
        rows, columns = kernel.shape
        data = [
            ("kernel", kernel.reshape(rows, 1, 1, columns).astype(np.float32)),
            ("bias", bias.reshape(1, 1, 1, columns).astype(np.float32)),
        ]
        return self.layer(LayerType.DENSE, [x], (self.dims_of(x)[N], 1, 1, columns), data=data, label=label)

    def two(self, kind: LayerType, a: str, b: str, label: str = "") -> str:
        """Arithmetic of two tensors that broadcast; the first has all the lengths of the result."""
        dims = self.dims_of(a)
        return self.layer(kind, [a, b], dims, label=label)

    def scale(self, x: str, factor: float, label: str = "scaled") -> str:
        """``x`` times a number."""
        return self.two(LayerType.MUL, x, self.number(factor), label)

    def shift(self, x: str, offset: float, label: str = "shifted") -> str:
        """``x`` plus a number."""
        return self.two(LayerType.ADD, x, self.number(offset), label)

    def at_most(self, x: str, bound: float) -> str:
        """The smaller of ``x`` and a number."""
        return self.two(LayerType.MIN, x, self.number(bound), "min")

    def at_least(self, x: str, bound: float) -> str:
        """The larger of ``x`` and a number."""
        return self.two(LayerType.MAX, x, self.number(bound), "max")

    def spread(self, x: str, width: int) -> str:
        """A column [N, 1, 1, 1] as [N, 1, 1, width]: early Barracudas repeat it along the batch instead."""
        key = f"{x} {width}"
        if key not in self._spread:
            self.made_up(width)
            self._spread[key] = self.dense(x, np.ones((1, width)), np.zeros(width), "spread")
        return self._spread[key]

    def name_tensor(self, name: str, tensor: str) -> None:
        """A linear activation called ``name``, as the trainers' converter ends an output."""
        self.drafts.append(Draft(name, LayerType.ACTIVATION, (tensor,)))

    # ------------------------------------------------------------------ values

    def layer_value(self, name: str, shape: tuple[Dim, ...], axes: Axes) -> Value:
        """The tensor that a layer gives."""
        width = self.dims_of(name)[C]
        value = Value(shape, axes, (Piece(name, width, 0, width),))
        assert value.dims == self.dims_of(name), (name, value, self.dims_of(name))
        return value

    def result(self, name: str, index: int = 0) -> Value:
        """The tensor that a layer gives as output ``index`` of the current node, its axes where they usually lie."""
        shape = self.shape_of(self.node.name if index == 0 else f"{self.node.name}:{index}")
        axes = usual_axes(shape)
        assert axes is not None
        return self.layer_value(name, shape, axes)

    def flatten_if_due(self, value: Value) -> Value:
        """``value`` with pieces: an image that was to be flattened is turned to the graph's order and flattened."""
        if value.flat_of is None:
            return value
        name = self.stored_name(self.in_usual_place(value.flat_of))
        return self.layer_value(
            self.layer(LayerType.FLATTEN, [name], value.dims, label="flat"), value.shape, value.axes
        )

    def stored_name(self, value: Value) -> str:
        """The one tensor of the file that ``value`` is: its pieces cut and joined, if there are several."""
        assert value.array is None
        value = self.flatten_if_due(value)
        if len(value.pieces) == 1 and value.pieces[0].whole:
            return value.pieces[0].name
        if value.pieces not in self._joined:
            n, h, w, c = value.dims
            parts = [self._part(piece, (n, h, w)) for piece in value.pieces]
            if len(parts) == 1:
                return parts[0]
            name = self.layer(LayerType.CONCAT, parts, (n, h, w, c), axis=C, label="joined")
            self._joined[value.pieces] = name
        return self._joined[value.pieces]

    def _part(self, piece: Piece, lead: tuple[int, int, int]) -> str:
        if piece.whole:
            return piece.name
        if (piece,) not in self._joined:
            self._joined[(piece,)] = self.layer(
                LayerType.STRIDED_SLICE,
                [piece.name],
                (*lead, piece.stop - piece.start),
                pad=(0, 0, 0, piece.start),
                pool=(0, 0, 0, piece.stop),
                stride=(1, 1, 1, 1),
                label="part",
            )
        return self._joined[(piece,)]

    def cut(self, value: Value, start: int, stop: int, shape: tuple[Dim, ...]) -> Value:
        """Channels ``start`` to ``stop``: of the pieces, so that what was only joined is not cut."""
        if self._cut is not value.pieces:
            self._cut = value.pieces
            self._ends = list(itertools.accumulate(p.stop - p.start for p in value.pieces))
        pieces: list[Piece] = []
        for index in range(bisect.bisect_right(self._ends, start), len(self._ends)):
            piece = value.pieces[index]
            at = self._ends[index] - (piece.stop - piece.start)
            if at >= stop:
                break
            first, last = max(start - at, 0), min(stop, self._ends[index]) - at
            if first < last:
                pieces.append(replace(piece, start=piece.start + first, stop=piece.start + last))
        return Value(shape, value.axes, self._merge_pieces(pieces))

    def join(self, values: Sequence[Value], shape: tuple[Dim, ...]) -> Value:
        """Tensors one after the other along C."""
        return Value(shape, values[0].axes, self._merge_pieces([p for v in values for p in v.pieces]))

    def _merge_pieces(self, pieces: Sequence[Piece]) -> tuple[Piece, ...]:
        """Pieces, those that follow each other in one tensor as one."""
        merged: list[Piece] = []
        for piece in pieces:
            if merged and merged[-1].name == piece.name and merged[-1].stop == piece.start:
                merged[-1] = replace(merged[-1], stop=piece.stop)
            else:
                merged.append(piece)
        if len(merged) > MAX_PIECES:
            raise self.nn_error(
                f"{len(merged)} tensors are joined", f"no more than {MAX_PIECES} are; a policy has a few"
            )
        return tuple(merged)

    def place_constant(self, array: npt.NDArray[np.generic], axes: Axes) -> Array:
        """A constant of the graph as [N, H, W, C], its axes (aligned at the end, as they broadcast) at ``axes``."""
        wide = array.reshape((1,) * (len(axes) - array.ndim) + array.shape)
        order = sorted((i for i in range(len(axes)) if wide.shape[i] != 1), key=lambda i: axes[i] or 0)
        lengths = [1, 1, 1, 1]
        for i in order:
            place = axes[i]
            assert place is not None
            lengths[place] = wide.shape[i]
        rest = [i for i in range(len(axes)) if i not in order]
        return np.ascontiguousarray(wide.transpose([*rest, *order]).reshape(lengths), np.float32)

    def with_axes(self, value: Value, axes: Axes) -> Value:
        """``value`` with its axes at ``axes``: as it is, or moved by a Transpose or Reshape layer."""
        wanted = replace(value, axes=axes)
        if wanted.dims == value.dims and all(
            a == b for a, b, d in zip(value.axes, axes, value.shape, strict=True) if d != 1
        ):
            return wanted
        long = [i for i, d in enumerate(value.shape) if d != 1]
        if sorted(long, key=lambda i: value.axes[i] or 0) == sorted(long, key=lambda i: axes[i] or 0):
            name = self.layer(LayerType.RESHAPE, [self.stored_name(value)], wanted.dims, pool=wanted.dims, label="laid")
            return self.layer_value(name, value.shape, axes)
        # The axes that the graph counts, each where it shall be; those of length 1 fill the other places.
        order: list[int | None] = [None] * 4
        for i in long:
            place = axes[i]
            assert place is not None
            order[place] = value.axes[i]
        left = [a for a in range(4) if a not in order]
        filled = [left.pop(0) if o is None else o for o in order]
        name = self.layer(
            LayerType.TRANSPOSE, [self.stored_name(value)], wanted.dims, pool=tuple(filled), label="turned"
        )
        return self.layer_value(name, value.shape, axes)

    def in_usual_place(self, value: Value) -> Value:
        """``value`` with its axes where they usually lie; raises UnsupportedOpError where they cannot."""
        axes = usual_axes(value.shape)
        if axes is None:
            raise self.nn_error(
                f"a tensor of shape {list(value.shape)}",
                "a tensor of a .nn has the batch first and three axes more",
            )
        return self.with_axes(value, axes)

    def rows(self, value: Value) -> str:
        """The tensor of a value [B, …], flattened in the graph's order: a name of [N, …] whose rows are the rows."""
        return self.stored_name(self.in_usual_place(value))
