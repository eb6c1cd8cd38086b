"""How an op is written as other ops, where a target or TensorFlow 1.4 lacks it: the builder and what an entry says."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from export_model.converters.graph.nodes import Node, SourceName
from export_model.converters.graph.types import Dim, TensorType
from export_model.signatures.errors import UnsupportedOpError

#: A shape as far as it is known; a string is a free axis.
Shape = Sequence[Dim] | None


class NodeBuilder(Protocol):
    """What makes nodes."""

    def add(self, op: str, inputs: Sequence[str], name: str, origin: SourceName = None, **attrs: Any) -> str:
        """A new node under a fresh name like ``name``; returns its output 0."""

    def const(self, array: np.ndarray, name: str) -> str:
        """A new Const under a fresh name like ``name``."""


class GraphBuilder(NodeBuilder, Protocol):
    """What an op that is written as other ops may use; ``export_model.converters.graph.editor.Editor`` is one."""

    def ints(self, numbers: npt.ArrayLike, name: str = "const") -> str:
        """An int32 constant: a vector, or a scalar."""

    def constant_of(self, reference: str) -> np.ndarray | None:
        """The value of a tensor of the old graph that is a Const."""

    def producer(self, reference: str) -> Node:
        """The node of the old graph that makes a tensor."""

    def shape_of(self, reference: str) -> Shape:
        """What is known of the shape of a tensor of the old graph by what was made so far; None: nothing."""

    def known_value(self, reference: str, meaning: str) -> np.ndarray:
        """The value of a tensor of the old graph that no input changes; raises UnsupportedOpError."""

    def write(self, operands: Sequence[str], layer: Callable[..., Sequence[str]], name: str) -> Sequence[str]:
        """What a layer of ``graph/nn`` makes of tensors of the old graph. Raises UnsupportedOpError."""

    def redirect(self, reference: str, to: str) -> None:
        """Let every later reader of ``reference`` read ``to``."""

    def resolve(self, reference: str) -> str:
        """Where a tensor of the old graph is now."""


#: A node as nodes of older ops, whose names begin with its own; returns the tensor that stands for its output 0.
Older = Callable[[GraphBuilder, Node], str]


def refuse_by_name(write: Older) -> Older:
    """``write``, which raises UnsupportedOpError with its node and op for what a layer of ``graph/nn`` refuses."""

    def older(builder: GraphBuilder, node: Node) -> str:
        try:
            return write(builder, node)
        except UnsupportedOpError as error:
            what = f"cannot convert {node.op} (node {node.name!r}): {error.what}"
            raise UnsupportedOpError(what, issues=[(node.name, node.op)], why=error.why) from error

    return older


#: A node as TensorFlow.js computes it rightly: further nodes are added, the one that takes its place is returned.
Tfjs = Callable[[GraphBuilder, Node, Mapping[str, TensorType]], Node]


class Decomposition(Struct, frozen=True):
    """A node in ops that every Barracuda computes rightly: ``write`` adds nodes and returns the one in its place.

    ``onnx`` is the ONNX op that the node becomes otherwise: decomposed for importers that lack or misread it (``""``:
    in ONNX the op has a formula anyway), ``everywhere``: in every ONNX. ``nn``: decomposed in every ``.nn``, which
    Barracuda 1.0 shall run.
    """

    onnx: str
    write: Tfjs
    nn: bool = True
    everywhere: bool = False
