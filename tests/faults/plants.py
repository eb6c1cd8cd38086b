"""Faults of every class, planted into a policy on its way to a writer, so that every format can have each.

What is planted stands behind the tensor that it spoils: that one is called ``<name>/right``, and the spoiled one has
its name. Everything is computed in float32, which all formats have.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import Graph, NameScope, Node, node_of, topological
from export_model.converters.graph.ops.samplers import SAMPLERS
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import FLOAT32, INT32
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec

#: Nodes from a tensor (its right values): what stands in its place.
Spoil = Callable[["Planter", str], str]


class Planter(Builder):
    """Nodes beside a policy's graph, and the policy's inputs."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(NameScope(n.name for n in policy.graph.nodes))
        self.policy, self.prefix = policy, "fault"
        self.types.update(infer_types(policy.graph))

    # ------------------------------------------------------------------ numbers

    def plus(self, tensor: str, number: float) -> str:
        return self.add("Add", [tensor, self.floats(number)])

    def times(self, tensor: str, number: float) -> str:
        return self.add("Mul", [tensor, self.floats(number)])

    def gather(self, tensor: str, places: Sequence[int], axis: int) -> str:
        """Other places of one axis."""
        indices, along = self.ints(list(places)), self.ints(axis)
        return self.add("GatherV2", [tensor, indices, along])

    def first_row(self, tensor: str) -> str:
        """The first row's values for all rows."""
        kept = [0] + [1] * (self.rank(tensor) - 1)
        first = self.slice(tensor, 0, 0, 1)
        if self.dtype(tensor) != FLOAT32:
            return self.add("Add", [first, self.add("Sub", [tensor, tensor])])
        rows = self.add("Max", [tensor, self.ints([i for i, k in enumerate(kept) if k])], keep_dims=True)
        ones = self.as_float(self.add("GreaterEqual", [rows, self.floats(-np.inf)]))
        return self.add("Mul", [first, ones])

    def as_float(self, tensor: str) -> str:
        return self.cast(tensor, FLOAT32)

    # ------------------------------------------------------------------ conditions, [B, 1 …] of zeros and ones

    def where_seen(self, like: str) -> str:
        """Where the first number of the first observation is above 0.2 (of an image: above its middle)."""
        spec = next(iter(self.policy.signature.observations))
        seen = self.as_float(self.policy.feeds[spec.name])
        flat = (
            self.reshape(seen, [-1, int(np.prod([n or 1 for n in spec.shape[1:]]))]) if len(spec.shape) != 2 else seen
        )
        limit = 0.2 if spec.role is not Role.VISUAL else 0.5
        return self._as_rows(self.add("Greater", [self.slice(flat, 1, 0, 1), self.floats(limit)]), like)

    def where_forbidden(self, like: str) -> str:
        """Where any action is forbidden."""
        return self._as_rows(self.add("Less", [self._least(self.masks()), self.floats(0.5)]), like)

    def masks(self) -> str:
        (spec,) = (s for s in self.policy.signature.inputs if s.role is Role.MASKS)
        return self.as_float(self.policy.feeds[spec.name])

    def forbidden_class(self, chosen: str) -> str:
        """[B, branches]: a forbidden class of each branch, where one is; else what is ``chosen``."""
        columns, start = [], 0
        for branch, size in enumerate(self.policy.signature.branches):
            mask = self.slice(self.masks(), 1, start, start + size)
            start += size
            worst = self.expand_dims(self.add("ArgMin", [mask, self.ints(1)], output_type=INT32), 1)
            some = self.as_float(self.add("Less", [self._least(mask), self.floats(0.5)]))
            right = self.slice(chosen, 1, branch, branch + 1)
            moved = self.add("Mul", [some, self.add("Sub", [self.as_float(worst), right])])
            columns.append(self.add("Add", [right, moved]))
        return self.add("ConcatV2", [*columns, self.ints(1)]) if len(columns) > 1 else columns[0]

    def _least(self, tensor: str) -> str:
        return self.add("Min", [tensor, self.ints([1])], keep_dims=True)

    def _as_rows(self, condition: str, like: str) -> str:
        rank = self.rank(like)
        numbers = self.as_float(condition)
        return numbers if rank == 2 else self.reshape(numbers, [-1] + [1] * (rank - 1))

    # ------------------------------------------------------------------ the policy with the fault

    def spoil(self, tensor: str, how: Spoil) -> Policy:
        """The policy in which all that reads ``tensor``, a node's first output, reads what ``how`` makes of it."""
        graph = self.policy.graph
        old = graph[tensor]
        feeding = old.op == "Placeholder"  # an input keeps its name, what reads it reads another
        right = tensor if feeding else self.names.fresh(f"{tensor}/right")
        self.types[right] = self.types[tensor]
        dtype = self.dtype(right)
        made = how(self, right)
        if self.dtype(made) != dtype:
            made = self.cast(made, dtype)
        if not feeding:
            assert made != right and made in self.position, "a fault is a node of its own"
            made = self.rename(made, tensor, old.origin)
        fault = {n.name for n in self.nodes}
        kept = [replace(n, name=right) if n.name == tensor else n for n in graph.nodes]
        if feeding:
            kept = [n.with_inputs(made if r == tensor else r for r in n.inputs) for n in kept]
        nodes = [_bare(n) for n in (*kept, *(n for n in self.nodes if n.name in fault))]
        return replace(self.policy, graph=Graph(topological(nodes)))


def _bare(node: Node) -> Node:
    """A node without what was inferred of it where it read other tensors."""
    return Node(node.name, node.op, node.inputs, node.attrs, node.value, node.origin)


def _matrices(policy: Policy) -> list[tuple[int, str, np.ndarray]]:
    """(size, node, value) of a policy's weights."""
    values = [(n.name, n.value) for n in policy.graph.nodes if n.op == "Const" and n.value is not None]
    return [(v.size, name, v) for name, v in values if v.ndim >= 2 and v.dtype == np.float32]


def _weakened(policy: Policy, name: str, value: np.ndarray) -> Policy:
    other = (value * np.float32(0.9)).astype(np.float32)
    nodes = [replace(n, value=other) if n.name == name else n for n in policy.graph.nodes]
    return replace(policy, graph=Graph(tuple(map(_bare, nodes))))


@dataclass(frozen=True)
class Plant:
    """One fault in one policy; ``tensor`` is the one that is spoiled, ``output`` what a consumer reads of it."""

    kind: str
    tensor: str
    plant: Callable[[], Policy]


def _number(spec: TensorSpec) -> bool:
    return spec.dtype == "float32" and spec.role is not Role.MEMORY_OUT


def _whole(spec: TensorSpec) -> bool:
    return spec.dtype in ("int64", "int32")


def _as_class(how: Spoil) -> Spoil:
    """A fault of classes, computed with floats."""
    return lambda b, x: how(b, b.as_float(x))


def _reversed(b: Planter, x: str) -> str:
    size = b.length(x, -1)
    return b.gather(x, range(size)[::-1], b.rank(x) - 1) if size > 1 else b.times(x, -1.0)


def _other_end(b: Planter, x: str) -> str:
    """Classes counted from the other end."""
    sizes = np.array(b.policy.signature.branches or [2], np.float32)
    return b.add("Sub", [b.floats(sizes - 1), x])


def _segments(b: Planter, x: str) -> str:
    """Branches of scores in the opposite order."""
    edges = np.cumsum([0, *b.policy.signature.branches])
    places = [p for i in range(len(edges) - 1)[::-1] for p in range(edges[i], edges[i + 1])]
    return b.gather(x, places, 1)


def _scored(b: Planter, x: str) -> str:
    """The forbidden classes are as good as certain."""
    return b.add("Maximum", [x, b.times(b.masks(), -1e9)])


#: Faults of how rows stand together.
OF_ROWS = ("the first row's for all", "one memory for all")

NUMBERS: dict[str, Spoil] = {
    "× 0": lambda b, x: b.times(x, 0.0),
    "NaN": lambda b, x: b.plus(x, np.nan),
    "+ 0.1": lambda b, x: b.plus(x, 0.1),
    "× 0.3": lambda b, x: b.times(x, 0.3),
    "reversed": _reversed,
    "+ 5 where obs[0] > 0.2": lambda b, x: b.add("Add", [x, b.times(b.where_seen(x), 5.0)]),
    "the first row's for all": lambda b, x: b.first_row(x),
}
CLASSES: dict[str, Spoil] = {
    "× 0": lambda b, x: b.times(x, 0.0),
    "reversed": _other_end,
    "+ 5 where obs[0] > 0.2": lambda b, x: b.add("Mul", [x, b.plus(b.times(b.where_seen(x), -1.0), 1.0)]),
    "the first row's for all": lambda b, x: b.first_row(x),
}
MEMORIES: dict[str, Spoil] = {
    "memory not fed": lambda b, x: b.times(x, 0.0),
    "one memory for all": lambda b, x: b.first_row(x),
}
NOISE: dict[str, Spoil] = {
    "noise × 1.15": lambda b, x: b.times(x, 1.15),
    "noise none": lambda b, x: b.times(x, 0.0),
    "no chance where obs[0] > 0.2": lambda b, x: b.add("Mul", [x, b.plus(b.times(b.where_seen(x), -1.0), 1.0)]),
}
ODDS: dict[str, Spoil] = {
    "temperature × 1.2": lambda b, x: b.times(x, 1 / 1.2),
    "2 % at random": lambda b, x: b.add(
        "Log", [b.plus(b.times(b.add("Softmax", [x]), 0.98), 0.02 / max(b.length(x, -1), 1))]
    ),
    "no chance where obs[0] > 0.2": lambda b, x: b.add("Mul", [x, b.plus(b.times(b.where_seen(x), 30.0), 1.0)]),
    "the first row's for all": lambda b, x: b.first_row(x),
}


def plants(policy: Policy, answered: Collection[str]) -> Iterator[Plant]:
    """Every fault that a policy can have in a file that answers these outputs."""
    signature = policy.signature

    def behind(kind: str, tensor: str, how: Spoil) -> Plant:
        return Plant(kind, tensor, lambda: Planter(policy).spoil(tensor, how))

    masked = any(s.role is Role.MASKS for s in signature.inputs)
    several = len(signature.branches) > 1
    for spec in (s for s in signature.outputs if s.name in answered):
        tensor = policy.fetches[spec.name]
        if node_of(tensor) != tensor or policy.graph[tensor].op == "Placeholder":
            continue
        scores = len(spec.shape) == 2 and bool(signature.branches) and spec.shape[1] == sum(signature.branches)
        chosen = len(spec.shape) == 2 and spec.shape[1] == len(signature.branches)
        if _number(spec):
            yield from (behind(kind, tensor, how) for kind, how in NUMBERS.items())
            if masked:
                yield behind("+ 3 where one is forbidden", tensor, _raised)
            if scores and several:
                yield behind("branches exchanged", tensor, _segments)
            if scores and masked:
                yield behind("a forbidden class", tensor, _scored)
        elif _whole(spec):
            yield from (behind(kind, tensor, _as_class(how)) for kind, how in CLASSES.items())
            if chosen and several:
                yield behind("branches exchanged", tensor, _as_class(_reversed))
            if chosen and masked:
                yield behind("a forbidden class", tensor, _as_class(lambda b, x: b.forbidden_class(x)))
    for given, taken in signature.recurrences:
        yield from (behind(kind, policy.feeds[given], how) for kind, how in MEMORIES.items())
        yield behind("memory kept at zero", policy.fetches[taken], NUMBERS["× 0"])
    yield from _chances(policy, behind)
    if matrices := _matrices(policy):
        _, name, value = max(matrices, key=lambda m: m[0])
        yield Plant("a matrix × 0.9", name, lambda: _weakened(policy, name, value))


def _raised(b: Planter, x: str) -> str:
    return b.add("Add", [x, b.times(b.where_forbidden(x), 3.0)])


def _chances(policy: Policy, behind: Callable[[str, str, Spoil], Plant]) -> Iterator[Plant]:
    """Faults of what is drawn."""
    graph, consumers = policy.graph, policy.graph.consumers()
    normals = [policy.feeds[s.name] for s in policy.signature.inputs if s.role is Role.NOISE]
    normals += [n.name for n in graph.nodes if n.op == "RandomStandardNormal"]
    for noise in (n for n in normals if consumers[n]):
        yield from (behind(kind, noise, how) for kind, how in NOISE.items())
    for sampler in (n for n in graph.nodes if n.op == "Multinomial"):
        odds = node_of(sampler.inputs[0])
        if odds == sampler.inputs[0]:
            yield from (
                Plant(kind, sampler.name, lambda o=odds, s=sampler.name, h=how: _for_one(policy, o, s, h))  # type: ignore[misc]
                for kind, how in ODDS.items()
            )
    drawn = graph.descendants([*normals] + [n.name for n in graph.nodes if n.op in SAMPLERS])
    acting = graph.ancestors([policy.fetches[head.name] for head in policy.signature.heads if head.is_continuous])
    for node in graph.nodes:
        clipped = graph.get(node.inputs[0]) if node.op == "Minimum" else None
        if clipped is not None and clipped.op == "Maximum" and node.name in drawn & acting:
            yield Plant("the clamp left out", node.name, lambda n=node.name: _unclamped(policy, n))  # type: ignore[misc]
            return


def _for_one(policy: Policy, tensor: str, reader: str, how: Spoil) -> Policy:
    """The policy in which one node alone reads what ``how`` makes of a tensor."""
    planter = Planter(policy)
    made = how(planter, tensor)
    nodes = [
        n.with_inputs(made if r == tensor else r for r in n.inputs) if n.name == reader else n
        for n in policy.graph.nodes
    ]
    return replace(policy, graph=Graph(topological([_bare(n) for n in (*nodes, *planter.nodes)])))


def _unclamped(policy: Policy, name: str) -> Policy:
    """The policy in which a Minimum of a Maximum gives what that reads."""
    graph = policy.graph
    inside = graph[node_of(graph[name].inputs[0])].inputs[0]
    nodes = [Node(n.name, "Identity", (inside,), origin=n.origin) if n.name == name else _bare(n) for n in graph.nodes]
    return replace(policy, graph=Graph(topological(nodes)))
