"""What a reader returns: a graph in the TensorFlow vocabulary, and what the format says beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from converters.graph.nodes import Graph
from converters.understand.facts import SourceFacts


@dataclass(frozen=True, slots=True)
class OriginalRun:
    """How the source itself is run, for comparison: a runtime, and what its child process is told to load."""

    runtime: str
    path: Path
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SourceModel:
    """One model of a source (a run folder has one per behavior; a graph may still hold several brains).

    ``name`` is the policy's name where the path does not give it; ``files`` are the files that were read, for the
    hash of the source. ``original`` is None where no runtime reads the source (a ``.nn``).
    """

    graph: Graph
    files: tuple[Path, ...]
    facts: SourceFacts = field(default_factory=SourceFacts)
    name: str | None = None
    original: OriginalRun | None = None


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """What a reader may be told: the checkpoint's step (None: the newest); the shapes of the agent's sensors, in their
    order, images C, H, W (empty: as far as the source tells).
    """

    step: int | None = None
    sensors: tuple[tuple[int, ...], ...] = ()


#: A reader takes the path (a file whose content was recognised, or a folder) and gives its models.
Reader = Callable[[Path, ReadOptions], "list[SourceModel]"]
