"""The one way to make a graph: nodes under fresh names, constants, and what is known of each tensor.

Every reader builds with a ``Builder`` (or a subclass that knows its format), every pass with an ``Editor``, which is
one over an old graph; the layers of ``converters/graph/nn`` are functions of it. Types are inferred as nodes are added
(the op table's rules), so that a function can ask for ranks, lengths and known values. What writes ONNX nodes
(``OnnxBuilder`` in ``graph/ops/base.py``) is another thing: it makes a ModelProto, not a graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from export_model.converters.graph.nodes import (
    Graph,
    NameScope,
    Node,
    SourceName,
    TensorShape,
    node_of,
    ref,
    topological,
)
from export_model.converters.graph.ops.base import REQUIRED, axis_within
from export_model.converters.graph.ops.table import TABLE, op_of
from export_model.converters.graph.shapes import Types, add_types, outputs_of
from export_model.converters.graph.size_limits import MAX_MADE, Allowance
from export_model.converters.graph.types import FLOAT32, INT32, INT64, Dim, Symbols, TensorType, broadcast
from export_model.signatures.errors import GraphError, UnsupportedOpError

#: A policy has some hundreds.
MAX_BUILT_NODES = 1 << 16
_SHARED_CONSTANT = 64
_DAMAGED = "the model is damaged"


class Builder:
    """Nodes and their types; see the module. ``names`` hands out the names of nodes.

    A function that cannot do its work raises UnsupportedOpError without ``issues``: who called it knows the node or
    layer of the source, and names it.
    """

    #: Whether types are inferred as nodes are added; an editor infers them where it is asked.
    typed = True

    def __init__(self, names: NameScope) -> None:
        self.nodes: list[Node] = []
        self.types: Types = {}
        self.symbols, self.allowance = Symbols(), Allowance()
        self.names = names
        #: what the names of new nodes begin with; empty: a name is what ``add`` is given
        self.prefix = ""
        #: tensors whose value depends on what is assumed of an input
        self.tainted: set[str] = set()
        self.position: dict[str, int] = {}
        self.lengths: dict[str, str] = {}
        self._constants: dict[tuple[Any, ...], str] = {}

    # ------------------------------------------------------------------ new nodes

    def add(
        self,
        op: str,
        inputs: Sequence[str],
        name: str = "",
        origin: SourceName = None,
        **attrs: Any,
    ) -> str:
        """A new node with the op's default attributes; returns its output 0."""
        defaults = {a.name: a.default for a in TABLE[op].attrs if a.derive is None and a.default is not REQUIRED}
        return self.append(Node(self._fresh(name or op), op, tuple(inputs), {**defaults, **attrs}, origin=origin))

    def named_input(
        self, name: str, dtype: np.dtype[Any], dims: Sequence[int | None], origin: SourceName = None
    ) -> str:
        """A named placeholder; None marks a dynamic axis."""
        attrs = {"dtype": dtype, "shape": TensorShape(tuple(dims))}
        return self.append(Node(name, "Placeholder", attrs=attrs, origin=origin))

    def const(self, array: npt.ArrayLike, name: str = "const") -> str:
        """A constant; equal small ones under one prefix share a node."""
        array = np.asarray(array)
        key = None
        if self.typed and self.prefix and array.size <= _SHARED_CONSTANT:
            key = (self.prefix, array.dtype.str, array.shape, array.tobytes())
            if key in self._constants:
                return self._constants[key]
        made = self.append(Node(self._fresh(name), "Const", value=array))
        if key is not None:
            self._constants[key] = made
        return made

    def room(self, elements: int) -> None:
        """Count a constant that follows from lengths alone, before it is made. Raises UnsupportedOpError."""
        if not self.allowance.take(elements if elements > _SHARED_CONSTANT else 0):
            raise UnsupportedOpError(
                f"it makes a constant of {elements} elements",
                why=f"with those of other nodes that is more than {MAX_MADE}, and they are not in the file",
            )

    def floats(self, numbers: npt.ArrayLike, name: str = "const") -> str:
        """A float32 constant."""
        return self.const(np.asarray(numbers, FLOAT32), name)

    def ints(self, numbers: npt.ArrayLike, name: str = "const") -> str:
        """An int32 constant: a vector, or a scalar. Raises GraphError where a number is larger."""
        try:
            return self.const(np.array(numbers, INT32), name)
        except OverflowError as error:
            raise GraphError(
                f"a length or an index of {name!r} has more than 32 bits",
                why=str(error),
                fix="the model is damaged, or not a policy; export it again",
            ) from error

    def number(self, like: str, value: float, name: str = "const") -> str:
        """A scalar constant of the dtype of ``like``."""
        return self.const(np.array(value, self.dtype(like)), name)

    def append(self, node: Node) -> str:
        """Take a node in, and infer what it gives; returns its output 0."""
        if self.typed and len(self.nodes) > MAX_BUILT_NODES:
            raise UnsupportedOpError(
                f"the model unfolds to more than {MAX_BUILT_NODES} nodes",
                why="a policy has some hundreds",
                fix="give the policy alone, without the training part",
            )
        if self.typed:
            add_types(self.types, node, self.symbols, self.allowance)
            if not TABLE[node.op].of_shape and any(r in self.tainted for r in node.inputs):
                self.tainted.update(ref(node.name, i) for i in range(self.outputs(node.name)))
        self.position[node.name] = len(self.nodes)
        self.nodes.append(node)
        return node.name

    def originate(self, node: str, origin: SourceName) -> None:
        """Say what the source calls a node's tensor."""
        at = next(i for i, n in enumerate(self.nodes) if n.name == node)
        self.nodes[at] = replace(self.nodes[at], origin=origin)

    def rename(self, node: str, name: str, origin: SourceName) -> str:
        """Call a node of one output, which no other reads, by a name that is its own; returns it."""
        at = self.position.pop(node)
        self.nodes[at] = replace(self.nodes[at], name=name, origin=origin)
        self.position[name] = at
        if node in self.types:
            self.types[name] = self.types.pop(node)
        if node in self.tainted:
            self.tainted.add(name)
        return name

    def graph(self) -> Graph:
        """The finished graph."""
        return Graph(topological(self.nodes))

    def _fresh(self, name: str) -> str:
        return self.names.fresh(f"{self.prefix}/{name}" if self.prefix else name)

    # ------------------------------------------------------------------ what is known of a tensor

    def outputs(self, name: str) -> int:
        """How many outputs a node has."""
        return outputs_of(self.types, name)

    def type_of(self, reference: str) -> TensorType:
        """dtype, shape and value as far as they are known."""
        return self.types[reference]

    def dtype(self, reference: str) -> np.dtype:
        """The dtype of a tensor."""
        return self.type_of(reference).dtype

    def is_float(self, reference: str) -> bool:
        """Whether a tensor holds floats."""
        return self.dtype(reference).kind == "f"

    def constant(self, reference: str) -> np.ndarray | None:
        """The value of a tensor that is the same in every run."""
        return None if reference in self.tainted else self.type_of(reference).constant

    def constant_of(self, reference: str) -> np.ndarray | None:
        """The value of a tensor under what is assumed of the inputs (``sequence_length`` is 1)."""
        return self.type_of(reference).constant

    def needed_constant(self, reference: str, meaning: str) -> np.ndarray:
        """The value of an operand that must be known; raises UnsupportedOpError."""
        value = self.constant_of(reference)
        if value is None:
            raise UnsupportedOpError(
                f"{meaning} is computed while the graph runs",
                why=f"{meaning} must be known before, in every target",
                fix="if it depends on an input with one value, give it: --set NAME=VALUE; else export the model with "
                "fixed sizes",
            )
        return value

    def producer(self, reference: str) -> Node:
        """The node that makes a tensor, looked for behind what passes it on."""
        node = self.nodes[self.position[node_of(reference)]]
        while op_of(node).moves == "same":
            node = self.nodes[self.position[node_of(node.inputs[0])]]
        return node

    def shape(self, reference: str) -> tuple[Dim, ...]:
        """The shape of a tensor; raises UnsupportedOpError where not even its rank is known."""
        shape = self.type_of(reference).shape
        if shape is None:
            raise UnsupportedOpError("the rank of an input is not known", why="its meaning depends on the rank")
        return shape

    def rank(self, reference: str) -> int:
        """The number of axes of a tensor; raises UnsupportedOpError."""
        return len(self.shape(reference))

    def length(self, reference: str, axis: int) -> int:
        """The length of an axis that must be a number; raises UnsupportedOpError."""
        size = self.shape(reference)[self.axis(reference, axis)]
        if not isinstance(size, int):
            raise UnsupportedOpError(
                f"the length of axis {axis} is not known", why="it must be a number before the graph runs"
            )
        return size

    def axis(self, reference: str, axis: int) -> int:
        """A possibly negative axis as a positive one; raises UnsupportedOpError."""
        return self.axis_of(axis, max(self.rank(reference), 1))

    def axis_of(self, axis: int, rank: int) -> int:
        """A possibly negative axis of ``rank`` as a positive one; raises UnsupportedOpError."""
        try:
            return axis_within(axis, rank)
        except IndexError as error:
            raise UnsupportedOpError(str(error), why=_DAMAGED) from error

    def common_shape(self, shapes: Sequence[tuple[Dim, ...]]) -> tuple[Dim, ...]:
        """The shape that several broadcast to; raises UnsupportedOpError where they do not."""
        dims: tuple[Dim, ...] | None = ()
        for shape in shapes:
            try:
                dims = broadcast(dims, shape, self.symbols)
            except ValueError as error:
                raise UnsupportedOpError(str(error), why=_DAMAGED) from error
        assert dims is not None
        return dims

    # ------------------------------------------------------------------ shapes as tensors

    def vector(self, dims: Sequence[Dim], name: str = "shape", *, open_axis: bool = False) -> str:
        """An int32 shape vector. With ``open_axis`` a single symbol is written -1, for Reshape."""
        names = [d for d in dims if isinstance(d, str)]
        if not names or (open_axis and len(names) == 1 and -1 not in dims and 0 not in dims):
            return self.ints([-1 if isinstance(d, str) else d for d in dims], name)
        parts = [self.length_of(d) if isinstance(d, str) else self.ints(d, "length") for d in dims]
        return self.add("Pack", parts, name, axis=0)

    def length_of(self, symbol: str) -> str:
        """A scalar: the length that a symbol stands for, taken from a tensor that has it."""
        if symbol not in self.lengths:
            for reference, kind in self.types.items():
                if kind.shape is not None and symbol in kind.shape:
                    shape = self.add("Shape", [reference], "lengths", out_type=INT32)
                    self.lengths[symbol] = self.element(shape, kind.shape.index(symbol))
                    break
            else:
                raise UnsupportedOpError(f"the length {symbol} is not known before the graph runs")
        return self.lengths[symbol]

    def shape_operand(self, reference: str) -> str:
        """A shape or index vector as int32: a constant where it is one (TensorFlow.js has no int64)."""
        value = self.constant(reference)
        if value is not None:
            return self.const(np.clip(value, -(2**31), 2**31 - 1).astype(INT32), "operand")
        return self.cast(reference, INT32)

    # ------------------------------------------------------------------ the same elements, or some of them

    def element(self, vector: str, index: int) -> str:
        """``vector[index]`` as a scalar."""
        return self.add(
            "StridedSlice",
            [vector, self.ints([index], "begin"), self.ints([index + 1], "end"), self.ints([1], "step")],
            "element",
            shrink_axis_mask=1,
        )

    def reshape(self, reference: str, dims: Sequence[Dim], name: str = "", origin: SourceName = None) -> str:
        """The same elements under another shape (symbols allowed, -1 for one open axis)."""
        shape = self.vector(dims, f"{name}_shape" if name else "shape", open_axis=True)
        made = self.add("Reshape", [reference, shape], name, origin)
        if self.typed and -1 not in dims:  # which symbol an open axis is, is known here
            self.types[made] = replace(self.types[made], shape=tuple(dims))
        return made

    def transpose(self, reference: str, permutation: Sequence[int]) -> str:
        """Axes in another order; the result itself where the order is the same."""
        if sorted(permutation) != list(range(self.rank(reference))):
            why = f"a tensor has {self.rank(reference)} axes, and {len(permutation)} are put in another order"
            raise UnsupportedOpError("the axes of a transpose are not those of its input", why=why)
        if list(permutation) == sorted(permutation):
            return reference
        value = self.constant(reference)
        if value is not None:
            return self.const(value.transpose(permutation), "transposed")  # a view: weights are not copied
        return self.add("Transpose", [reference, self.ints(list(permutation), "perm")])

    def expand_dims(self, reference: str, axis: int) -> str:
        """A new axis of length 1."""
        return self.add("ExpandDims", [reference, self.ints(axis, "axis")])

    def squeeze(self, reference: str, axes: Sequence[int]) -> str:
        """Without the axes of length 1 at ``axes``."""
        return self.add("Squeeze", [reference], squeeze_dims=tuple(axes)) if axes else reference

    def cast(self, reference: str, dtype: np.dtype, name: str = "") -> str:
        """The tensor in another dtype."""
        same = self.dtype(reference) == dtype
        return reference if same else self.add("Cast", [reference], name, DstT=np.dtype(dtype))

    def slice(
        self,
        reference: str,
        axis: int,
        start: int | None,
        stop: int | None,
        step: int = 1,
        *,
        dropped: bool = False,
        name: str = "",
    ) -> str:
        """``x[..., start:stop:step]`` at one axis, which stays unless it is ``dropped``."""
        begin, end, steps = [0] * (axis + 1), [0] * (axis + 1), [1] * (axis + 1)
        masks = (1 << axis) - 1
        begin[axis], end[axis], steps[axis] = start or 0, stop or 0, step
        return self.add(
            "StridedSlice",
            [reference, self.ints(begin, "begin"), self.ints(end, "end"), self.ints(steps, "steps")],
            name,
            begin_mask=masks | (1 << axis if start is None else 0),
            end_mask=masks | (1 << axis if stop is None else 0),
            shrink_axis_mask=1 << axis if dropped else 0,
        )

    def take(self, reference: str, index: Sequence[int], axis: int) -> str:
        """The elements ``index`` of an axis, in that order."""
        return self.add("GatherV2", [reference, self.ints(list(index), "indices"), self.ints(axis, "axis")])

    def pad(self, x: str, pairs: Sequence[tuple[int, int]], fill: str | float | None = None) -> str:
        """``x`` with a pair of paddings per axis, of zeros or ``fill`` (number or scalar); a negative one cuts off."""
        if isinstance(fill, float | int):
            fill = self.number(x, fill) if fill else None
        for axis, (before, after) in enumerate(pairs):
            if min(before, after) < 0:
                x = self.slice(x, axis, -before if before < 0 else None, after if after < 0 else None)
        wide = [[max(a, 0), max(z, 0)] for a, z in pairs]
        if not any(map(any, wide)):
            return x
        operand = self.ints(wide, "paddings")
        return self.add("Pad", [x, operand]) if fill is None else self.add("PadV2", [x, operand, fill])

    def split(self, reference: str, count: int) -> list[str]:
        """A matrix [rows, count·n] cut into ``count`` matrices [rows, n]."""
        made = self.add("Split", [self.ints(1, "axis"), reference], num_split=count)
        return [ref(made, i) for i in range(count)]

    def concat(self, parts: Sequence[str], axis: int, name: str = "") -> str:
        """Joined along an axis."""
        return parts[0] if len(parts) == 1 else self.add("ConcatV2", [*parts, self.ints(axis, "axis")], name)

    def argmax(self, reference: str, axis: int, name: str = "", dtype: np.dtype = INT64) -> str:
        """The index of the largest element along an axis."""
        return self.add("ArgMax", [reference, self.ints(axis, "axis")], name, output_type=dtype)

    def reduce(self, kind: str, reference: str, axes: Sequence[int], *, keep: bool) -> str:
        """Sum, Mean, Max, Min or Prod over axes."""
        return self.add(kind, [reference, self.ints(list(axes), "axes")], keep_dims=keep)

    def broadcast(self, reference: str, dims: Sequence[Dim]) -> str:
        """The tensor repeated to a shape it broadcasts to. BroadcastTo came with TF 1.12; Tile was always there."""
        shape = self.type_of(reference).shape
        assert shape is not None
        if len(shape) < len(dims):
            shape = (1,) * (len(dims) - len(shape)) + shape
            reference = self.reshape(reference, shape)
        counts: list[Dim] = [d if s == 1 else 1 for s, d in zip(shape, dims, strict=True)]
        return reference if all(c == 1 for c in counts) else self.add("Tile", [reference, self.vector(counts)])

    def where(self, condition: str, a: str, b: str) -> str:
        """``condition ? a : b``, broadcast."""
        shapes = [self.shape(r) for r in (condition, a, b)]
        if shapes[0] == shapes[1] == shapes[2]:
            return self.add("Select", [condition, a, b])
        if self.is_float(a):
            return self.add("SelectV2", [condition, a, b])
        dims = self.common_shape(shapes)
        return self.add("Select", [self.broadcast(r, dims) for r in (condition, a, b)])
