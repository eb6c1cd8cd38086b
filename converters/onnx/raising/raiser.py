"""The graph in the making: what raising functions build with.

Types are inferred as nodes are added (the op table's rules), so that a function can ask for ranks, lengths and known
values: half of ONNX's ops are told apart by them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from converters.graph.ops.base import REQUIRED
from converters.graph.ops.table import TABLE
from converters.graph.shapes import Types, add_types
from converters.graph.types import FLOAT32, INT32, Dim, Symbols, TensorType, broadcast
from converters.onnx.proto import array_of, attribute_of
from converters.onnx.raising.node import Op, Raise
from signatures.errors import DamagedFileError, UnsupportedOpError
from signatures.graph import Graph, NameScope, Node, TensorShape, node_of, ref, topological

#: Ops whose result depends on shapes, not on values.
_SHAPE_OPS = frozenset(("Shape", "Size", "Rank"))
_MAX_NODES = 1 << 16


def node_name(value: str) -> str:
    """An ONNX value's name as TensorFlow allows a node to be called: [A-Za-z0-9.] and then _ - and / too.

    The suffix ``:0`` of tensors that tf2onnx converted goes, ``:1`` becomes ``_1``.
    """
    name = value.removesuffix(":0")
    name = re.sub(r"[^A-Za-z0-9_.\-/]", "_", name).lstrip("/_-\\")
    return name or "value"


class Raiser:
    """Collects nodes for the new graph; see the module.

    ``opsets`` is the version of each domain, ``reserved`` the values whose names are kept as they are (inputs and
    outputs). ``batch`` is the number of rows that a model was exported for, where that is fixed: its first axes are
    freed, and shapes that begin with that number are read as beginning with the batch.
    """

    def __init__(
        self,
        table: Mapping[tuple[str, str], Raise],
        opsets: Mapping[str, int],
        reserved: Sequence[str],
        batch: int | None = None,
    ) -> None:
        self.table = table
        self.opsets = opsets
        self.batch = batch
        self.nodes: list[Node] = []
        self.types: Types = {}
        self.values: dict[str, str] = {}
        #: ONNX value → why it could not be made
        self.broken: dict[str, UnsupportedOpError] = {}
        #: ONNX values that are N(0, 1) draws
        self.draws: list[str] = []
        #: whether a recurrent layer takes its memory in a form that is right for one row only
        self.one_row = False
        self.symbols = Symbols()
        own = NameScope(())
        self._reserved = {value: own.fresh(node_name(value)) for value in dict.fromkeys(reserved)}
        self._names = NameScope(self._reserved.values())
        self._position: dict[str, int] = {}
        #: tensors whose value depends on what is assumed of an input
        self._tainted: set[str] = set()
        self._lengths: dict[str, str] = {}
        self._bound: set[str] = set()
        self._constants: dict[tuple[Any, ...], str] = {}
        #: where the nodes of an inlined body go, empty for the model's own
        self._scope = ""
        self._prefix = ""

    # ------------------------------------------------------------------ new nodes

    def add(self, op: str, inputs: Sequence[str], name: str = "", **attrs: Any) -> str:
        """A new node with the op's default attributes; returns its output 0."""
        defaults = {a.name: a.default for a in TABLE[op].attrs if a.derive is None and a.default is not REQUIRED}
        fresh = self._names.fresh(f"{self._prefix}/{name or op}" if self._prefix else name or op)
        return self._append(Node(fresh, op, tuple(inputs), {**defaults, **attrs}))

    def const(self, array: np.ndarray, name: str = "const") -> str:
        """A constant; equal small ones of one ONNX node share a node."""
        array = np.asarray(array)
        key = (self._prefix, array.dtype.str, array.shape, array.tobytes()) if array.size <= 64 else None
        if key is not None and key in self._constants:
            return self._constants[key]
        made = self._append(Node(self._names.fresh(f"{self._prefix}/{name}"), "Const", value=array))
        if key is not None:
            self._constants[key] = made
        return made

    def ints(self, numbers: Sequence[int] | int, name: str = "const") -> str:
        """An int32 constant: a vector, or a scalar."""
        return self.const(np.array(numbers, INT32), name)

    def number(self, like: str, value: float, name: str = "const") -> str:
        """A scalar constant of the dtype of ``like``."""
        return self.const(np.array(value, self.dtype(like)), name)

    def draw(self, op: str, inputs: Sequence[str], value: str) -> str:
        """A sampler of N(0, 1), which carries the name of the ONNX value that is drawn."""
        made = self.add(op, inputs, dtype=FLOAT32)
        if not self._scope:
            self.draws.append(value)
            self.nodes[-1] = replace(self.nodes[-1], origin=value)
        return made

    def _append(self, node: Node) -> str:
        if len(self.nodes) > _MAX_NODES:
            raise UnsupportedOpError(
                f"the model unfolds to more than {_MAX_NODES} nodes",
                why="a policy has some hundreds",
                fix="give the policy alone, without the training part",
            )
        add_types(self.types, node, self.symbols)
        if node.op not in _SHAPE_OPS and any(r in self._tainted for r in node.inputs):
            self._tainted.update(ref(node.name, i) for i in range(self.outputs(node.name)))
        self._position[node.name] = len(self.nodes)
        self.nodes.append(node)
        return node.name

    def outputs(self, name: str) -> int:
        """How many outputs a node has."""
        count = 1
        while ref(name, count) in self.types:
            count += 1
        return count

    # ------------------------------------------------------------------ what is known of a tensor

    def type_of(self, reference: str) -> TensorType:
        """dtype, shape and value as far as they are known."""
        return self.types[reference]

    def dtype(self, reference: str) -> np.dtype:
        """The dtype of a tensor."""
        return self.types[reference].dtype

    def is_float(self, reference: str) -> bool:
        """Whether a tensor holds floats."""
        return self.types[reference].dtype.kind == "f"

    def constant(self, reference: str) -> np.ndarray | None:
        """The value of a tensor that is the same in every run."""
        return None if reference in self._tainted else self.types[reference].constant

    def known(self, reference: str) -> np.ndarray | None:
        """The value of a tensor under what is assumed of the inputs (``sequence_length`` is 1)."""
        return self.types[reference].constant

    def producer(self, reference: str) -> Node:
        """The node that makes a tensor, looked for behind identities."""
        node = self.nodes[self._position[node_of(reference)]]
        while node.op == "Identity":
            node = self.nodes[self._position[node_of(node.inputs[0])]]
        return node

    def needed_constant(self, op: Op, reference: str, meaning: str) -> np.ndarray:
        """The value of an operand that must be known; raises UnsupportedOpError."""
        value = self.known(reference)
        if value is None:
            raise op.refused(
                f"{meaning} is computed while the graph runs",
                f"{meaning} must be known before, in every target",
                "if it depends on an input with one value, give it: --set NAME=VALUE; else export the model with "
                "fixed sizes",
            )
        return value

    def shape(self, op: Op, reference: str) -> tuple[Dim, ...]:
        """The shape of a tensor; raises UnsupportedOpError where not even its rank is known."""
        shape = self.types[reference].shape
        if shape is None:
            raise op.refused("the rank of an input is not known", "its meaning depends on the rank")
        return shape

    def rank(self, op: Op, reference: str) -> int:
        """The number of axes of a tensor; raises UnsupportedOpError."""
        return len(self.shape(op, reference))

    def length(self, op: Op, reference: str, axis: int) -> int:
        """The length of an axis that must be a number; raises UnsupportedOpError."""
        size = self.shape(op, reference)[axis]
        if not isinstance(size, int):
            raise op.refused(f"the length of axis {axis} is not known", "it must be a number before the graph runs")
        return size

    def axis(self, op: Op, reference: str, axis: int) -> int:
        """A possibly negative axis as a positive one; raises UnsupportedOpError."""
        rank = self.rank(op, reference)
        if not -rank <= axis < max(rank, 1):
            raise op.refused(f"axis {axis} is outside of {rank} axes", "the model is damaged")
        return axis % max(rank, 1)

    # ------------------------------------------------------------------ small building blocks

    def vector(self, dims: Sequence[Dim], *, open_axis: bool = False) -> str:
        """An int32 shape vector. With ``open_axis`` a single symbol is written -1, for Reshape."""
        names = [d for d in dims if isinstance(d, str)]
        if not names or (open_axis and len(names) == 1 and -1 not in dims and 0 not in dims):
            return self.ints([-1 if isinstance(d, str) else d for d in dims], "shape")
        parts = [self.length_of(d) if isinstance(d, str) else self.ints(d, "length") for d in dims]
        return self.add("Pack", parts, "shape", axis=0)

    def length_of(self, symbol: str) -> str:
        """A scalar: the length that a symbol stands for, taken from a tensor that has it."""
        if symbol not in self._lengths:
            for reference, kind in self.types.items():
                if kind.shape is not None and symbol in kind.shape:
                    shape = self.add("Shape", [reference], "lengths", out_type=INT32)
                    self._lengths[symbol] = self.element(shape, kind.shape.index(symbol))
                    break
            else:
                raise UnsupportedOpError(f"the length {symbol} is not known before the graph runs", issues=[])
        return self._lengths[symbol]

    def element(self, vector: str, index: int) -> str:
        """``vector[index]`` as a scalar."""
        return self.add(
            "StridedSlice",
            [vector, self.ints([index], "begin"), self.ints([index + 1], "end"), self.ints([1], "step")],
            "element",
            shrink_axis_mask=1,
        )

    def reshape(self, reference: str, dims: Sequence[Dim]) -> str:
        """The same elements under another shape (symbols allowed, -1 for one open axis)."""
        made = self.add("Reshape", [reference, self.vector(dims, open_axis=True)])
        if -1 not in dims:  # which symbol an open axis is, is known here
            self.types[made] = replace(self.types[made], shape=tuple(dims))
        return made

    def transpose(self, reference: str, permutation: Sequence[int]) -> str:
        """Axes in another order; the result itself where the order is the same."""
        if list(permutation) == sorted(permutation):
            return reference
        value = self.constant(reference)
        if value is not None:
            return self.const(np.ascontiguousarray(value.transpose(permutation)), "transposed")
        return self.add("Transpose", [reference, self.ints(list(permutation), "perm")])

    def expand_dims(self, reference: str, axis: int) -> str:
        """A new axis of length 1."""
        return self.add("ExpandDims", [reference, self.ints(axis, "axis")])

    def squeeze(self, reference: str, axes: Sequence[int]) -> str:
        """Without the axes of length 1 at ``axes``."""
        return self.add("Squeeze", [reference], squeeze_dims=tuple(axes)) if axes else reference

    def cast(self, reference: str, dtype: np.dtype) -> str:
        """The tensor in another dtype."""
        return reference if self.dtype(reference) == dtype else self.add("Cast", [reference], DstT=np.dtype(dtype))

    def shape_operand(self, reference: str) -> str:
        """A shape or index vector as int32: a constant where it is one (TensorFlow.js has no int64)."""
        value = self.constant(reference)
        if value is not None:
            return self.const(np.clip(value, -(2**31), 2**31 - 1).astype(INT32), "operand")
        return self.cast(reference, INT32)

    def slice(self, reference: str, axis: int, start: int | None, stop: int | None, step: int = 1) -> str:
        """``x[..., start:stop:step]`` at one axis."""
        begin, end, steps = [0] * (axis + 1), [0] * (axis + 1), [1] * (axis + 1)
        masks = (1 << axis) - 1
        begin[axis], end[axis], steps[axis] = start or 0, stop or 0, step
        return self.add(
            "StridedSlice",
            [reference, self.ints(begin, "begin"), self.ints(end, "end"), self.ints(steps, "steps")],
            begin_mask=masks | (1 << axis if start is None else 0),
            end_mask=masks | (1 << axis if stop is None else 0),
        )

    def concat(self, parts: Sequence[str], axis: int) -> str:
        """Joined along an axis."""
        return parts[0] if len(parts) == 1 else self.add("ConcatV2", [*parts, self.ints(axis, "axis")])

    def reduce(self, kind: str, reference: str, axes: Sequence[int], *, keep: bool) -> str:
        """Sum, Mean, Max, Min or Prod over axes."""
        return self.add(kind, [reference, self.ints(list(axes), "axes")], keep_dims=keep)

    def broadcast(self, reference: str, dims: Sequence[Dim]) -> str:
        """The tensor repeated to a shape it broadcasts to. BroadcastTo came with TF 1.12; Tile was always there."""
        shape = self.types[reference].shape
        assert shape is not None
        if len(shape) < len(dims):
            shape = (1,) * (len(dims) - len(shape)) + shape
            reference = self.reshape(reference, shape)
        counts: list[Dim] = [d if s == 1 else 1 for s, d in zip(shape, dims, strict=True)]
        return reference if all(c == 1 for c in counts) else self.add("Tile", [reference, self.vector(counts)])

    def where(self, op: Op, condition: str, a: str, b: str) -> str:
        """``condition ? a : b``, broadcast."""
        shapes = [self.shape(op, r) for r in (condition, a, b)]
        if shapes[0] == shapes[1] == shapes[2]:
            return self.add("Select", [condition, a, b])
        if self.is_float(a):
            return self.add("SelectV2", [condition, a, b])
        dims = self.joined(op, shapes)
        return self.add("Select", [self.broadcast(r, dims) for r in (condition, a, b)])

    def joined(self, op: Op, shapes: Sequence[tuple[Dim, ...]]) -> tuple[Dim, ...]:
        """The shape that several broadcast to; raises UnsupportedOpError where they do not."""
        dims: tuple[Dim, ...] | None = ()
        for shape in shapes:
            try:
                dims = broadcast(dims, shape, self.symbols)
            except ValueError as error:
                raise op.refused(str(error), "the model is damaged") from error
        assert dims is not None
        return dims

    # ------------------------------------------------------------------ ONNX values

    def placeholder(self, value: str, dtype: np.dtype, shape: TensorShape, assumed: np.ndarray | None = None) -> str:
        """An input of the model. ``assumed`` is the value that it has in every run of a policy."""
        node = Node(self._reserved[value], "Placeholder", attrs={"dtype": dtype, "shape": shape}, origin=value)
        self._append(node)
        if assumed is not None:
            self.types[node.name] = TensorType(dtype, tuple(assumed.shape), assumed)
            self._tainted.add(node.name)
        self.values[value] = node.name
        return node.name

    def initializer(self, value: str, array: np.ndarray) -> None:
        """A constant of the model, or of a body that is being inlined."""
        self.values[value] = self._append(Node(self._name_for(value), "Const", value=array, origin=self._origin(value)))

    def raise_node(self, op: Op, names: Sequence[str]) -> None:
        """Make what an ONNX node becomes, and let its values (``names`` are the ones it reads) stand for it.

        A node that cannot be converted breaks its values and all that depend on them; whether that matters is decided
        when the outputs are known.
        """
        function = self.table.get((op.domain.removeprefix("ai.onnx"), op.kind))
        errors = [op.refused(*_unknown(op))] if function is None else []
        missing = [n for n in names if n and n not in self.values]
        if function is None or missing:
            self._break(op, joined_errors([*self._causes(op, missing), *errors]))
            return
        target = next((o for o in op.outputs if o), op.name)
        self._prefix = self._scope + (self._reserved.get(target) or node_name(target))
        try:
            results = function(op, self)
        except UnsupportedOpError as error:
            self._break(op, error if error.issues else op.refused(error.what, error.why, error.fix))
            return
        made = [results] if isinstance(results, str) else list(results)
        bound = [(v, m) for v, m in zip(op.outputs, made, strict=False) if v and m is not None]
        for value, result in bound:
            self.bind(value, result, rename=len(bound) == 1)

    def bind(self, value: str, reference: str, *, rename: bool = False) -> None:
        """Let a node that is called after ``value`` (and carries its name as origin) stand for it.

        With ``rename`` the graph's last node may be renamed for it; nothing else may refer to that node.
        """
        if value in self.values:
            raise DamagedFileError(
                f"the value {value!r} is made twice", why="names of values must be unique", fix="export the model again"
            )
        name, origin = self._name_for(value), self._origin(value)
        last = self.nodes[-1]
        if rename and reference == last.name and last.origin in (None, origin) and self._may_rename(last):
            self._rename_last(name, origin)
        else:
            at = self._position.get(reference)
            if at is not None and self.nodes[at].origin is None and self.nodes[at].op != "Const":
                self.nodes[at] = replace(self.nodes[at], origin=origin)
            self._append(Node(name, "Identity", (reference,), origin=origin))
        self.values[value] = name
        self._bound.add(name)

    def _may_rename(self, node: Node) -> bool:
        if node.op in ("Placeholder", "Const") or node.name in self._bound or node.name in self._lengths.values():
            return False
        return self.outputs(node.name) == 1

    def _rename_last(self, name: str, origin: str | None) -> None:
        """The usual case: a function's last node is the result, so it takes the value's name itself."""
        last = self.nodes[-1]
        self.nodes[-1] = replace(last, name=name, origin=origin)
        self._position[name] = self._position.pop(last.name)
        self.types[name] = self.types.pop(last.name)
        if last.name in self._tainted:
            self._tainted.add(name)

    def _name_for(self, value: str) -> str:
        if not self._scope and value in self._reserved:
            return self._reserved[value]
        return self._names.fresh(self._scope + node_name(value))

    def _origin(self, value: str) -> str | None:
        """Values inside a body have no name that could be asked for from outside."""
        return None if self._scope else value

    def inline(self, op: Op, body: Any, bindings: Mapping[str, str]) -> list[str]:
        """The nodes of a body, run once where ``op`` stands; returns its outputs."""
        outer = (self.values, self._scope, self._prefix)
        self.values = {**self.values, **bindings}
        self._scope = f"{self._prefix}/"
        try:
            for tensor in body.initializer:
                self.initializer(tensor.name, array_of(tensor))
            self.run(body.node)
            names = [o.name for o in body.output]
            missing = [n for n in names if n not in self.values]
            if missing:
                raise joined_errors(self._causes(op, missing))
            return [self.values[n] for n in names]
        finally:
            self.values, self._scope, self._prefix = outer

    def run(self, protos: Iterable[Any]) -> None:
        """Raise nodes in their order."""
        for proto in protos:
            names = list(proto.input)
            inputs = tuple(self.values.get(n) if n else None for n in names)
            version = self.opsets.get("" if proto.domain == "ai.onnx" else proto.domain, 0)
            op = Op(
                proto.op_type,
                proto.domain,
                proto.name or next((o for o in proto.output if o), "?"),
                version,
                inputs,
                {a.name: attribute_of(a) for a in proto.attribute},
                tuple(proto.output),
            )
            self.raise_node(op, names)

    def _causes(self, op: Op, missing: Sequence[str]) -> list[UnsupportedOpError]:
        """Why values are missing; raises DamagedFileError where nothing makes them."""
        unknown = [n for n in missing if n not in self.broken]
        if unknown:
            raise DamagedFileError(
                f"node {op.name!r} ({op.kind}) reads {unknown[0]!r}, which nothing makes before it",
                why="the model was cut or edited, or its nodes are not in order",
                fix="export the model again",
            )
        return [self.broken[n] for n in missing]

    def _break(self, op: Op, error: UnsupportedOpError) -> None:
        for value in op.outputs:
            if value:
                self.broken[value] = error

    def graph(self) -> Graph:
        """The finished graph."""
        return Graph(topological(self.nodes))


def joined_errors(errors: Sequence[UnsupportedOpError]) -> UnsupportedOpError:
    """The first of several errors, with the issues of all."""
    first = errors[0]
    issues = tuple(dict.fromkeys(issue for error in errors for issue in error.issues))
    if issues == first.issues:
        return first
    others = ", ".join(sorted({op for _, op in issues[len(first.issues) :]}))
    what = first.what.split(" (also: ")[0] + f" (also: {others})"
    return UnsupportedOpError(what, issues=issues, where=first.where, why=first.why, fix=first.fix)


def _unknown(op: Op) -> tuple[str, str, str]:
    if op.domain not in ("", "ai.onnx"):
        return (
            "its domain is not ONNX's own",
            "ops of other domains are private to one runtime",
            "export the model without that runtime's optimisations, with ONNX's own ops (domain 'ai.onnx') only",
        )
    return (
        "no entry of the raising table covers it",
        "it occurs in no policy that this tool was made for",
        "if the node is not part of the policy, name the outputs you need with --output; else please open an issue",
    )
