"""What a format, loaded in a runtime, has of the graph's tensors, and how to ask for them.

A format says it by ``Format.inner``; one that says nothing hides them. Where nodes are called as the graph calls them
and any can be fetched, ``own_names`` is enough.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from export_model.converters.graph.nodes import split_ref
from export_model.converters.graph.ops.samplers import KINDS

if TYPE_CHECKING:
    from export_model.converters.runtimes.pool import RuntimePool
if not TYPE_CHECKING:  # what asks a record for its signature looks these names up
    RuntimePool = Any

Feeds = Mapping[str, np.ndarray]
Run = Callable[[Feeds, Sequence[str]], dict[str, np.ndarray]]
RunAll = Callable[[Sequence[Feeds], Sequence[str]], list[dict[str, np.ndarray]]]
#: The outputs of samplers that are fed, with their ranks, and the tensors that are fetched → what runs it so.
Opened = Callable[[Mapping[str, int], Sequence[str]], contextlib.AbstractContextManager[RunAll]]


class View(Struct, frozen=True):
    """A tensor as a format has it: its name there, and the axes it was transposed by (None: as it is)."""

    name: str
    axes: tuple[int, ...] | None = None

    def restore(self, array: np.ndarray) -> np.ndarray:
        """The tensor as the graph has it."""
        if self.axes is None or array.ndim != len(self.axes):
            return array
        return array.transpose(np.argsort(self.axes))


class Sampler(Struct, frozen=True):
    """An op of an artefact that draws, by the artefact's names: its output, the scores of the classes that it draws.

    ``kind`` is a kind of the op table; numbers are ``scale`` times those of the kind, and ``mean`` more. ``dtype`` is
    that of the output, where it may be another than the policy's.
    """

    tensor: str
    kind: str
    scores: str | None = None
    mean: float = 0.0
    scale: float = 1.0
    dtype: str | None = None


class InnerTensors(Struct, frozen=True):
    """``view`` says how the format has a tensor of the graph (None: not at all), ``run`` fetches what it calls so.

    ``opened`` runs the artefact with the outputs of ``samplers`` as inputs; None where it cannot be run so.
    """

    view: Callable[[str], View | None]
    run: Run
    #: Another tool may have made it: what has a tensor's name may be another tensor.
    foreign: bool = False
    samplers: Sequence[Sampler] = ()
    opened: Opened | None = None

    def fetch(self, feeds: Feeds, tensors: Sequence[str]) -> dict[str, np.ndarray]:
        """Tensors of the graph by name, its own axes; raises RunFailedError."""
        views = {tensor: view for tensor in tensors if (view := self.view(tensor)) is not None}
        values = self.run(feeds, list(dict.fromkeys(v.name for v in views.values()))) if views else {}
        return {tensor: view.restore(values[view.name]) for tensor, view in views.items()}


class Loaded(Struct, frozen=True):
    """An artefact in a runtime of a pool, ``run`` as it is loaded; ``signature`` is the one called, "" for the only."""

    path: Path
    runtime: str
    run: Run
    run_all: RunAll
    pool: RuntimePool
    signature: str = ""

    def open_any(self, fed: Mapping[str, int], fetched: Sequence[str]) -> contextlib.AbstractContextManager[RunAll]:
        """Run it as it is: its runtime feeds and fetches any tensor."""
        return contextlib.nullcontext(self.run_all)


def no_tensors(loaded: Loaded) -> contextlib.AbstractContextManager[InnerTensors]:
    """No tensor can be had."""
    return contextlib.nullcontext(InnerTensors(lambda tensor: None, loaded.run))


def own_names(nodes: Iterable[str]) -> Callable[[str], View | None]:
    """A view for a format that has ``nodes``, called as in the graph."""
    known = frozenset(nodes)
    return lambda tensor: View(tensor) if split_ref(tensor)[0] in known else None


def samplers_of(nodes: Mapping[str, tuple[str, Sequence[str]]], classes: str | None = None) -> tuple[Sampler, ...]:
    """The samplers among a graph's nodes: name → (op, what it reads). ``classes`` is the dtype of drawn classes."""
    return tuple(
        Sampler(name, KINDS[op], inputs[0], dtype=classes) if KINDS[op] == "categorical" else Sampler(name, KINDS[op])
        for name, (op, inputs) in nodes.items()
        if op in KINDS
    )
