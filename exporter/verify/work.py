"""How much of a verification a slow runtime is given: what a row of a policy costs, and how many rows that leaves."""

from __future__ import annotations

import math

from export_model.converters.formats.embed import runnable
from export_model.converters.graph.nodes import Graph, ref
from export_model.converters.graph.ops.table import traits
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import TensorType
from export_model.converters.runtimes.registry import RUNTIMES
from export_model.exporter.verify.participants import Participant

#: What one policy may take in one runtime, about.
SECONDS = 20
#: A free axis behind the batch is about that long (signatures/sampling.py).
_FREE_AXIS = 8
_SPEEDS = {r.name: r.products_per_second for r in RUNTIMES}


class WorkAllowance:
    """The rows that a runtime may still be given of one policy, and what was left out for want of them."""

    def __init__(self, cost: int, runtime: str) -> None:
        self.cost = cost
        self.left = int(SECONDS * _SPEEDS.get(runtime, max(_SPEEDS.values())) / cost)
        self.left_out: list[str] = []

    def takes(self, rows: int, what: str) -> bool:
        """Whether there is time for this many; they are taken then, else ``what`` is left out."""
        if rows > self.left:
            self.left_out.append(what)
            return False
        self.left -= rows
        return True

    def at_most(self, rows: int, what: str) -> int:
        """How many of this many there is time for; they are taken, and what is left out of ``what`` is noted."""
        taken = min(rows, self.left)
        if taken < rows:
            self.left_out.append(f"{what} but for {taken}")
        self.left -= taken
        return taken

    def note(self, who: str) -> str | None:
        """What was left out, for a report."""
        if not self.left_out:
            return None
        shown = ", ".join(self.left_out)
        return f"{who} is slow ({self.cost / 1e6:.3g} million products for a row); left out there: {shown}"


class Allowances:
    """What time there is for each artefact of a policy in each runtime."""

    def __init__(self, graph: Graph) -> None:
        self._graph, self._cost = graph, 0
        self._known: dict[tuple[str, str], WorkAllowance] = {}
        #: format → the runtime that is given the dearest input
        self._first: dict[str, str] = {}

    def of(self, participant: Participant, purpose: str = "inputs") -> WorkAllowance:
        """Return that of an artefact in a runtime; there is as much for inputs as for draws."""
        key = (f"{participant.name} in {participant.runtime}", purpose)
        if key not in self._known:
            self._cost = self._cost or products(self._graph)
            self._known[key] = WorkAllowance(self._cost, participant.runtime)
        return self._known[key]

    def is_first(self, participant: Participant) -> bool:
        """Whether the runtime is the first of its format."""
        return self._first.setdefault(participant.name, participant.runtime) == participant.runtime

    def notes(self) -> list[str]:
        """Return what was left out, a sentence each."""
        return [note for (who, _), each in self._known.items() if (note := each.note(who)) is not None]


def products(graph: Graph) -> int:
    """Multiplications that one row of a policy's inputs costs, about; whatever else an op computes counts as one."""
    graph = runnable(graph)  # that of a bundle is spelled as it was written
    types = infer_types(graph)
    total = 0
    for node in graph.nodes:
        if not node.inputs:
            continue
        result = _elements(types[ref(node.name, 0)])
        terms = 1.0
        if traits(node).layer in ("dense", "convolution"):
            kernel, shape = types[node.inputs[1]], types[ref(node.name, 0)].shape
            width = shape[-1] if shape and isinstance(shape[-1], int) else 1
            terms = _elements(kernel) / max(1, width)
        total += round(result * max(1.0, terms))
    return max(1, total)


def _elements(kind: TensorType) -> int:
    """Elements that belong to one row: the first free axis is the batch."""
    sizes = kind.shape or ()
    return math.prod(n if isinstance(n, int) else 1 if i == 0 else _FREE_AXIS for i, n in enumerate(sizes))
