"""A policy on random observations and on their mirror images: how well a mirror fits, as one number.

For the layout that a symmetric robot's policy was trained with, and for all that mirror alike, acting on the image is
the image of the action: π(M o) ≈ M' π(o). The score is the squared difference over the variance of both sides: 0 where
they are equal, 1 where they have nothing to do with each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.graph.nodes import Graph, node_of
from export_model.converters.graph.ops.table import hands_on
from export_model.converters.graph.run import run_graph
from export_model.converters.layouts.layouts import Mirrors
from export_model.converters.policy.policy import Policy
from export_model.exporter.layout.ports import ports_of
from export_model.signatures.errors import UsageError
from export_model.signatures.spec import TensorSpec

#: Observations, and how far they go: in the normaliser's deviations where the policy has one, else as they are fed.
#: A third of a deviation is where policies are nearly linear and act; at a whole one, public policies saturate.
ROWS, SPREAD = 256, 0.3
#: The same with a memory, which is fed back.
ROWS_WITH_MEMORY, STEPS = 48, 8
#: Rows that are run at once.
_MOST_ROWS = 4096


class Trial:
    """A policy with what it did on observations; ``scores`` tries mirrors on them."""

    def __init__(self, policy: Policy, seed: int = 0) -> None:
        self.policy = policy
        self.vector, self._action = _ports(policy)
        self.width = int(self.vector.shape[-1] or 0)
        signature = policy.signature
        self._memory = signature.recurrences
        rows, steps = (ROWS_WITH_MEMORY, STEPS) if self._memory else (ROWS, 1)
        self.mean, self.deviation = statistics_of(policy, self.vector)
        drawn = np.random.default_rng(seed).standard_normal((steps, rows, self.width))
        center = 0.0 if self.mean is None else self.mean
        spread = 1.0 if self.deviation is None else self.deviation
        self.observations = (center + SPREAD * spread * drawn).astype(np.float32)
        acted = self.act(self.observations)
        self._acted = acted - acted.mean((0, 1))

    @property
    def actions(self) -> int:
        """Numbers of the action."""
        return int(self._acted.shape[-1])

    def scores(self, mirrors: Sequence[Mirrors]) -> list[float]:
        """How well each pair of mirrors fits; what is not finite, or does not move at all, fits as chance does."""
        found: list[float] = []
        step = max(1, _MOST_ROWS // self.observations.shape[1])
        for start in range(0, len(mirrors), step):
            some = mirrors[start : start + step]
            images = np.concatenate([m.apply(self.observations) for m, _ in some], axis=1)
            parts = np.split(self.act(images), len(some), axis=1)
            found += [self._score(part, acted.apply(self._acted)) for part, (_, acted) in zip(parts, some, strict=True)]
        return found

    def _score(self, acted: np.ndarray, wanted: np.ndarray) -> float:
        acted = acted - acted.mean((0, 1))
        variance = float(acted.var((0, 1)).sum() + wanted.var((0, 1)).sum())
        difference = float(((acted - wanted) ** 2).mean((0, 1)).sum())
        return difference / variance if np.isfinite(difference) and variance > 0 else 1.0

    def act(self, observations: np.ndarray) -> np.ndarray:
        """Actions [steps, rows, m] for observations [steps, rows, n], from an empty memory on."""
        policy, rows = self.policy, observations.shape[1]
        feeds = {
            policy.feeds[s.name]: np.zeros([rows if n is None else n for n in s.shape], s.dtype)
            for s in policy.signature.inputs
        }
        fetched = [policy.fetches[name] for name in (self._action.name, *(given for _, given in self._memory))]
        acted = []
        for observed in observations:
            feeds[policy.feeds[self.vector.name]] = observed
            action, *memories = run_graph(policy.graph, feeds, fetched).values()
            feeds |= {policy.feeds[taken]: m for (taken, _), m in zip(self._memory, memories, strict=True)}
            acted.append(action)
        return np.stack(acted).astype(np.float64)


def _ports(policy: Policy) -> tuple[TensorSpec, TensorSpec]:
    """The observation and the action without chance. Raises UsageError for other forms of policies."""
    found = ports_of(policy.signature)
    if found is None:
        raise UsageError(
            f"the layout of {policy.name!r} cannot be told: it takes {policy.signature.flow}",
            why="a mirror is tried on one row of numbers and continuous actions",
            fix="name the tensors by their roles: --input NAME=ROLE, --output NAME=ROLE",
        )
    return found


def statistics_of(policy: Policy, vector: TensorSpec) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Mean and deviation [n] with which a policy normalises its observation before all else; None where it does not."""
    said = vector.distribution or {}
    if "std" in said:
        mean, std = (np.broadcast_to(np.asarray(said[k], float), vector.shape[-1] or 1) for k in ("mean", "std"))
        return mean, std
    graph, name = policy.graph, policy.feeds[vector.name]
    centre: np.ndarray | None = None
    spread: np.ndarray | None = None
    readers = graph.consumers()
    while len(readers[name]) == 1:
        node = readers[name][0]
        if not hands_on(node):
            value = _other(graph, node.inputs, name)
            if value is None or value.size != vector.shape[-1] or node_of(node.inputs[0]) != name:
                break
            value = value.reshape(-1).astype(float)
            if node.op == "Sub":
                centre = value
            elif node.op == "RealDiv":
                spread = value
            elif node.op == "Mul":
                spread = 1 / np.where(value == 0, 1, value)
            else:
                break
        name = node.name
    return (centre, spread) if centre is not None and spread is not None else (None, None)


def _other(graph: Graph, inputs: Sequence[str], name: str) -> np.ndarray | None:
    """The constant beside ``name`` of a node with two inputs."""
    return next((graph.constant(r) for r in inputs if node_of(r) != name), None)
