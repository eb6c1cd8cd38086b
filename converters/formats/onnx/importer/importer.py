"""ONNX nodes into a graph, one by one: values get names, what cannot be converted breaks what depends on it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.files.external_data import Detached
from export_model.converters.formats.onnx.importer.fixed_batch import FixedBatch
from export_model.converters.formats.onnx.importer.node import STANDARD, Op, Translate
from export_model.converters.formats.onnx.proto import array_of, attribute_of
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import MAX_NAME, NameScope, Node, TensorShape
from export_model.converters.graph.ops.base import MISFIT
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.types import FLOAT32, TensorType
from export_model.signatures.errors import DamagedFileError, UnsupportedOpError


def node_name(value: str) -> str:
    """An ONNX value's name as TensorFlow allows a node to be called: [A-Za-z0-9.] and then _ - and / too.

    The suffix ``:0`` of tensors that tf2onnx converted goes, ``:1`` becomes ``_1``.
    """
    name = value.removesuffix(":0")
    name = re.sub(r"[^A-Za-z0-9_.\-/]", "_", name).lstrip("/_-\\")
    return name or "value"


class Importer(Builder):
    """The builder of a model's graph; see the module.

    ``opsets`` is the version of each domain, ``reserved`` the values whose names are kept as they are (inputs and
    outputs). ``batch`` is the number of rows that a model was exported for, where that is fixed: its first axes are
    freed, and shapes that hold the number are read accordingly (``fixed_batch.py``). ``detached`` holds the large
    tensors of the protos that are run.
    """

    def __init__(
        self,
        table: Mapping[tuple[str, str], Translate],
        opsets: Mapping[str, int],
        reserved: Sequence[str],
        batch: int | None = None,
        detached: Detached | None = None,
    ) -> None:
        own = NameScope(())
        self._reserved = {value: own.fresh(node_name(value)) for value in dict.fromkeys(reserved)}
        super().__init__(NameScope(self._reserved.values()))
        self.table = table
        self.opsets = opsets
        self.batch = batch
        self.detached = detached
        self.fixed = None if batch is None else FixedBatch(batch, self.symbols)
        #: ONNX value → tensor
        self.values: dict[str, str] = {}
        #: ONNX value → why it could not be made
        self.broken: dict[str, UnsupportedOpError] = {}
        #: ONNX values that are N(0, 1) draws
        self.draws: list[str] = []
        #: whether a recurrent layer takes its memory in a form that is right for one row only
        self.one_row = False
        #: nodes that stand for a value
        self._bound: set[str] = set()
        #: where the nodes of an inlined body go, empty for the model's own
        self._scope = ""

    def draw(self, op: str, inputs: Sequence[str], value: str) -> str:
        """A sampler of N(0, 1), which carries the name of the ONNX value that is drawn."""
        if not self._scope:
            self.draws.append(value)
        return self.add(op, inputs, origin=self._origin(value), dtype=FLOAT32)

    def placeholder(self, value: str, dtype: np.dtype, shape: TensorShape, assumed: np.ndarray | None = None) -> str:
        """An input of the model. ``assumed`` is the value that it has in every run of a policy."""
        node = Node(self._reserved[value], "Placeholder", attrs={"dtype": dtype, "shape": shape}, origin=value)
        self.append(node)
        if assumed is not None:
            self.types[node.name] = TensorType(dtype, tuple(assumed.shape), assumed)
            self.tainted.add(node.name)
        self.values[value] = node.name
        return node.name

    def initializer(self, value: str, array: np.ndarray) -> None:
        """A constant of the model, or of a body that is being inlined."""
        self.values[value] = self.append(Node(self._name_for(value), "Const", value=array, origin=self._origin(value)))

    def import_node(self, op: Op, names: Sequence[str]) -> None:
        """Make what an ONNX node becomes, and let its values (``names`` are the ones it reads) stand for it.

        A node that cannot be converted breaks its values and all that depend on them; whether that matters is decided
        when the outputs are known.
        """
        function = self.table.get((op.domain.removeprefix("ai.onnx"), op.kind))
        errors = [op.op_error(*_unknown_op_reason(op))] if function is None else []
        missing = [n for n in names if n and n not in self.values]
        if function is None or missing:
            self._break(op, joined_errors([*self._causes(op, missing), *errors]))
            return
        target = next((o for o in op.outputs if o), op.name)
        self.prefix = (self._scope + (self._reserved.get(target) or node_name(target)))[:MAX_NAME]
        try:
            results = function(op, self)
        except UnsupportedOpError as error:
            self._break(op, error if error.issues else op.op_error(error.what, error.why, error.fix))
            return
        except MISFIT as error:
            why = f"{type(error).__name__}: {error}"
            self._break(op, op.op_error("it has inputs or attributes that its operator does not allow", why))
            return
        made = [results] if isinstance(results, str) else list(results)
        bound = [(v, m) for v, m in zip(op.outputs, made, strict=False) if v and m is not None]
        for value, result in bound:
            self.bind(value, result, rename=len(bound) == 1)
        for value in (v for v in op.outputs if v and v not in self.values):
            self.broken[value] = op.op_error(f"its output {value!r} is not made", "no policy reads it")

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
            self.rename(last.name, name, origin)  # the usual case
        else:
            at = self.position.get(reference)
            if at is not None and self.nodes[at].origin is None and self.nodes[at].op != "Const":
                self.nodes[at] = replace(self.nodes[at], origin=origin)
            self.append(Node(name, "Identity", (reference,), origin=origin))
        self.values[value] = name
        self._bound.add(name)

    def _may_rename(self, node: Node) -> bool:
        if op_of(node).start or node.name in self._bound or node.name in self.lengths.values():
            return False
        return self.outputs(node.name) == 1

    def _name_for(self, value: str) -> str:
        if not self._scope and value in self._reserved:
            return self._reserved[value]
        return self.names.fresh(self._scope + node_name(value))

    def _origin(self, value: str) -> str | None:
        """Values inside a body have no name that could be asked for from outside."""
        return None if self._scope else value

    def inline(self, op: Op, body: Any, bindings: Mapping[str, str]) -> list[str]:
        """The nodes of a body, run once where ``op`` stands; returns its outputs."""
        outer = (self.values, self._scope, self.prefix)
        self.values = {**self.values, **bindings}
        self._scope = f"{self.prefix}/"
        try:
            for tensor in body.initializer:
                self.initializer(tensor.name, array_of(tensor, self.detached))
            self.run(body.node)
            names = [o.name for o in body.output]
            missing = [n for n in names if n not in self.values]
            if missing:
                raise joined_errors(self._causes(op, missing))
            return [self.values[n] for n in names]
        finally:
            self.values, self._scope, self.prefix = outer

    def run(self, protos: Iterable[Any]) -> None:
        """Translate nodes in their order."""
        for proto in protos:
            names = list(proto.input)
            inputs = tuple(self.values.get(n) if n else None for n in names)
            version = self.opsets.get("" if proto.domain in STANDARD else proto.domain, 0)
            name = proto.name or next((o for o in proto.output if o), "?")
            op = Op(
                kind=proto.op_type,
                domain=proto.domain,
                name=name,
                opset=version,
                inputs=inputs,
                attrs={},
                outputs=tuple(proto.output),
            )
            try:
                op = replace(op, attrs={a.name: attribute_of(a, self.detached) for a in proto.attribute})
            except UnsupportedOpError as error:
                self._break(op, error)
            else:
                self.import_node(op, names)

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


def joined_errors(errors: Sequence[UnsupportedOpError]) -> UnsupportedOpError:
    """The first of several errors, with the issues of all."""
    first = errors[0]
    issues = tuple(dict.fromkeys(issue for error in errors for issue in error.issues))
    if issues == first.issues:
        return first
    others = ", ".join(sorted({op for _, op in issues[len(first.issues) :]}))
    what = first.what.split(" (also: ")[0] + f" (also: {others})"
    return UnsupportedOpError(what, issues=issues, where=first.where, why=first.why, fix=first.fix)


_QUANTISED = frozenset(
    (
        *("QuantizeLinear", "DequantizeLinear", "DynamicQuantizeLinear"),
        *("MatMulInteger", "ConvInteger", "QLinearMatMul", "QLinearConv"),
    )
)


def _unknown_op_reason(op: Op) -> tuple[str, str, str]:
    if op.domain not in STANDARD:
        return (
            "its domain is not ONNX's own",
            "ops of other domains are private to one runtime",
            "export the model without that runtime's optimisations, with ONNX's own ops (domain 'ai.onnx') only",
        )
    if op.kind in _QUANTISED:
        return (
            "no entry of the table of ONNX ops covers it",
            "the model is quantised: it computes in integers, which not all formats have, and of which runtimes differ",
            "give the float32 model that it was made of (float16 is read, too)",
        )
    return (
        "no entry of the table of ONNX ops covers it",
        "it occurs in no policy that this tool was made for",
        "if the node is not part of the policy, name the outputs you need with --output; else please open an issue",
    )
