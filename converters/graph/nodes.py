"""A graph in the TensorFlow vocabulary: nodes, references, topological order. Structure only, no op knowledge.

A *reference* names a tensor: ``"node"`` is output 0, ``"node:2"`` is output 2 (TensorFlow's GraphDef form).
Graphs are immutable by convention: passes make new ones.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.graph.types import TensorType
from export_model.signatures.errors import GraphError

#: Attribute values: bool, int, float, str, bytes, numpy dtype, ``TensorShape``, ndarray, or a tuple of these.
AttrValue = Any
#: The types that a node read, what came of them, and the elements that were folded.
Inference = tuple[Sequence[TensorType], Sequence[TensorType], int]


#: The source's name for what a node computes: a tensor, or several that were joined.
SourceName = str | tuple[str, ...] | None


def joined_name(names: Sequence[str]) -> str | tuple[str, ...]:
    """The source's name for what was joined of its tensors."""
    return names[0] if len(names) == 1 else tuple(names)


class TensorShape(Struct, frozen=True):
    """A ``shape`` attribute: ``dims`` is None for an unknown rank, an entry is None for a free axis."""

    dims: tuple[int | None, ...] | None


class Node(Struct, frozen=True, dict=True):
    """One operation.

    ``attrs`` hold what changes the result (strides, axis, ``DstT``); dtypes that follow from the inputs (``T``) are
    not kept, the writers derive them. ``value`` is the array of a ``Const``. ``origin`` is the tensor of the source
    that output 0 stands for (``"dense/BiasAdd:0"``, a tuple where several were joined); it survives renaming, so that
    reports can point at the source.
    """

    name: str
    op: str
    inputs: tuple[str, ...] = ()
    attrs: Mapping[str, AttrValue] = field(default_factory=dict)
    value: np.ndarray | None = None
    origin: SourceName = None

    @property
    def inference(self) -> Inference | None:
        """What ``shapes`` last inferred of it."""
        return self.__dict__.get("_inference")

    def keep_inference(self, inference: Inference | None) -> None:
        """Keep what was inferred, beside the fields: it is not compared, and ``replace`` leaves it out."""
        self.__dict__["_inference"] = inference

    @property
    def dims(self) -> tuple[int | None, ...] | None:
        """The lengths of a placeholder's or a variable's axes, None if the graph does not say."""
        shape = self.attrs.get("shape")
        return shape.dims if isinstance(shape, TensorShape) else None

    def with_inputs(self, inputs: Iterable[str]) -> Node:
        """The same node fed from other tensors."""
        return self.rewire(self.name, inputs)

    def rewire(self, name: str, inputs: Iterable[str]) -> Node:
        """The same node under a name, fed from other tensors; what was inferred of it depends on neither."""
        fed = tuple(inputs)
        if fed == self.inputs and name == self.name:
            return self
        made = Node(name, self.op, fed, self.attrs, self.value, self.origin)
        made.keep_inference(self.inference)
        return made


def ref(name: str, index: int = 0) -> str:
    """The reference to output ``index`` of node ``name``."""
    return name if index == 0 else f"{name}:{index}"


def split_ref(reference: str) -> tuple[str, int]:
    """(node name, output index) of a reference; ``"a:0"`` and ``"a"`` are the same tensor."""
    if ":" not in reference:  # nearly all
        return reference, 0
    name, _, index = reference.rpartition(":")
    if index.isascii() and index.isdigit() and len(index) < 10:
        return name, int(index)
    return reference, 0


def node_of(reference: str) -> str:
    """The name of the node that a reference points to."""
    return split_ref(reference)[0] if ":" in reference else reference


def normal_ref(reference: str) -> str:
    """``"a:0"`` as ``"a"``; everything else unchanged."""
    return ref(*split_ref(reference))


def renamed_ref(reference: str, names: Mapping[str, str]) -> str:
    """``reference`` where the nodes of ``names`` (old → new) are called otherwise."""
    name, index = split_ref(reference)
    return ref(names.get(name, name), index)


def reachable(starts: Iterable[str], ahead: Callable[[str], Iterable[str]]) -> set[str]:
    """``starts`` and all names that ``ahead`` leads to from them."""
    seen: set[str] = set()
    stack = list(starts)
    while stack:
        name = stack.pop()
        if name not in seen:
            seen.add(name)
            stack.extend(ahead(name))
    return seen


def downstream(node: Node, consumers: Mapping[str, list[Node]], through: Callable[[Node], bool]) -> Iterator[Node]:
    """What reads ``node``, the nearest first, looked for behind those that ``through`` holds for."""
    queue, seen = [node], {node.name}
    for source in queue:
        for reader in consumers[source.name]:
            if reader.name not in seen:
                seen.add(reader.name)
                yield reader
                if through(reader):
                    queue.append(reader)


class Graph(Struct, frozen=True, dict=True):
    """Nodes in topological order (the back edges of while loops apart), looked up by name."""

    nodes: tuple[Node, ...]

    def __post_init__(self) -> None:
        _ = self._index  # raises where two nodes share a name

    @cached_property
    def _index(self) -> dict[str, Node]:
        return by_name(self.nodes)

    @cached_property
    def inferences(self) -> dict[bool, dict[str, TensorType]]:
        """What ``shapes.infer_types`` found, by its ``partial``: half of the passes ask for it."""
        return {}

    @cached_property
    def cache(self) -> dict[Any, Any]:
        """What was made of it and may be asked for again: by who made it, and of what else."""
        return {}

    def __repr__(self) -> str:
        return f"<Graph of {len(self.nodes)} nodes>"

    def __contains__(self, name: str) -> bool:
        return name in self._index

    def __getitem__(self, name: str) -> Node:
        return self._index[name]

    def get(self, name: str) -> Node | None:
        """The node, or None."""
        return self._index.get(name)

    def producer(self, reference: str) -> Node:
        """The node that makes the tensor ``reference``."""
        return self._index[node_of(reference)]

    def constant(self, reference: str) -> np.ndarray | None:
        """The array behind ``reference`` if it is a Const, possibly through Identity; else None."""
        node = self.producer(reference)
        while node.op == "Identity" and node.inputs:
            node = self.producer(node.inputs[0])
        return node.value if node.op == "Const" else None

    def is_full_of(self, reference: str, number: float) -> bool:
        """Whether a tensor is known to hold nothing but ``number``, of however many rows."""
        node = self.get(node_of(reference))
        value = None if node is None else self.constant(node.inputs[1] if node.op == "Fill" else reference)
        return value is not None and bool((value == number).all())

    def values(self) -> list[np.ndarray]:
        """Its constants."""
        return [node.value for node in self.nodes if node.value is not None]

    def consumers(self) -> dict[str, list[Node]]:
        """Node name → the nodes that read any of its outputs, in graph order."""
        table: dict[str, list[Node]] = {node.name: [] for node in self.nodes}
        for node in self.nodes:
            for name in dict.fromkeys(map(node_of, node.inputs)):
                table[name].append(node)
        return table

    def ancestors(self, references: Iterable[str], stop: frozenset[str] = frozenset()) -> set[str]:
        """Names of all nodes upstream of ``references``, themselves included; does not look behind ``stop``."""
        index = self._index
        return reachable(map(node_of, references), lambda n: () if n in stop else map(node_of, index[n].inputs))

    def descendants(self, names: Iterable[str]) -> set[str]:
        """Names of all nodes downstream of those called ``names``, themselves included, in a graph without loops."""
        found = set(names)
        for node in self.nodes:
            if any(node_of(r) in found for r in node.inputs):
                found.add(node.name)
        return found

    def prune(self, references: Iterable[str]) -> Graph:
        """Only what is upstream of ``references``, in the same order."""
        keep = self.ancestors(references)
        return self if len(keep) == len(self.nodes) else Graph(tuple(n for n in self.nodes if n.name in keep))

    def rename(self, names: Mapping[str, str]) -> Graph:
        """The graph with the nodes of ``names`` (old → new) renamed; their ``origin`` stays."""
        if not names:
            return self
        return Graph(
            tuple(n.rewire(names.get(n.name, n.name), (renamed_ref(r, names) for r in n.inputs)) for n in self.nodes)
        )


def by_name(nodes: Sequence[Node]) -> dict[str, Node]:
    """Name → node; raises GraphError when two nodes have the same name."""
    index = {node.name: node for node in nodes}
    if len(index) < len(nodes):
        twice = next(name for name, count in Counter(n.name for n in nodes).items() if count > 1)
        raise GraphError(
            f"two nodes are called {twice!r}",
            why="names must be unique in a graph",
            fix="export the graph again; this file breaks TensorFlow's own rules",
        )
    return index


def checked_inputs(nodes: Sequence[Node]) -> None:
    """Raise GraphError when a node reads a tensor whose node does not exist."""
    names = {node.name for node in nodes}
    for node in nodes:
        for reference in node.inputs:
            if node_of(reference) not in names:
                raise GraphError(
                    f"node {node.name!r} ({node.op}) reads {reference!r}, which is not in the graph",
                    why="the graph has a dangling input; it was cut or edited",
                    fix="freeze the graph again from its checkpoint",
                )


def topological(nodes: Sequence[Node]) -> tuple[Node, ...]:
    """``nodes`` ordered so that inputs come first, otherwise in the given order.

    The edge NextIteration → Merge closes a while loop and does not count. Raises GraphError on any other cycle, on
    dangling inputs and on a name that stands twice.
    """
    if _is_ordered(nodes):
        by_name(nodes)
        return tuple(nodes)
    checked_inputs(nodes)
    index = by_name(nodes)
    done: dict[str, bool] = {}  # False = being visited
    ordered: list[Node] = []

    def start(node: Node) -> tuple[Node, Iterator[str]]:
        """A node, and the names of those that it reads and that are still to be looked at."""
        done[node.name] = False
        sources = (node_of(r) for r in node.inputs)
        return node, (s for s in sources if node.op != "Merge" or index[s].op != "NextIteration")

    for root in nodes:
        if root.name in done:
            continue
        stack = [start(root)]
        while stack:
            node, sources = stack[-1]
            for source in sources:
                if source not in done:
                    stack.append(start(index[source]))
                    break
                if not done[source]:
                    raise GraphError(
                        f"node {source!r} depends on itself",
                        why="the graph has a cycle that is not a while loop",
                        fix="freeze the graph again; this file is damaged",
                    )
            else:
                stack.pop()
                done[node.name] = True
                ordered.append(node)
    return tuple(ordered)


def _is_ordered(nodes: Sequence[Node]) -> bool:
    """Whether every node stands behind those that it reads; a Merge may make it say no."""
    seen: set[str] = set()
    for node in nodes:
        if not seen.issuperset(map(node_of, node.inputs)):
            return False
        seen.add(node.name)
    return True


#: Characters of a name that is made here: an untrusted name of a megabyte would go to all nodes made of its layer.
MAX_NAME = 1 << 10


class NameScope:
    """Hands out node names that are not taken yet, the same ones in every run; long ones are cut."""

    def __init__(self, taken: Iterable[str]) -> None:
        self._taken = set(taken)
        self._numbers: dict[str, int] = {}

    def fresh(self, wish: str) -> str:
        """``wish``, or ``wish_1``, ``wish_2``… if it is taken."""
        wish = wish[:MAX_NAME]
        name, number = wish, self._numbers.get(wish, 0)
        while name in self._taken:
            number += 1
            name = f"{wish}_{number}"
        self._taken.add(name)
        self._numbers[wish] = number
        return name

    def __contains__(self, name: str) -> bool:
        return name in self._taken

    def take(self, name: str) -> None:
        """Hand ``name`` out to nobody else."""
        self._taken.add(name)

    def release(self, name: str) -> None:
        """Let a name be taken again, as if it had never been."""
        self._taken.discard(name)
        self._numbers.clear()
