"""Runtimes that are not there: the numpy kernels play every part, in this process, and can be told to go wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy.typing as npt
import pytest

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes import pool as runtimes
from export_model.converters.runtimes.registry import RuntimeInfo
from export_model.exporter.export import pipeline
from export_model.exporter.export.pipeline import ExportResult
from export_model.exporter.verify.cut import CUT
from export_model.exporter.verify.report import ParityReport

Array = npt.NDArray[Any]
Tensors = dict[str, Array]
#: (format, runtime, what it answers) → what it says instead
Spoil = Callable[[str, str, Tensors], Tensors]

ALL = ("numpy", "tensorflow", "onnxruntime", "tfjs-cpu", "tfjs-wasm")
KNOWN = tuple(RuntimeInfo(name, True, "1.0", f"install {name}") for name in ALL)


def honest(kind: str, runtime: str, answer: Tensors) -> Tensors:
    """Nothing goes wrong."""
    return answer


def graph_in(path: Path) -> Graph:
    """The graph of a source or of a bundle's .bytes, without the contract."""
    graph = read_graph(path.read_bytes())
    return normalise(Graph(tuple(n for n in graph.nodes if n.value is None or n.value.dtype.kind != "S")))


@dataclass
class Actor:
    """A model in a runtime that is only played."""

    kind: str
    process: ActingProcess
    graph: Graph

    def run(self, feeds: Mapping[str, Array], fetch: Sequence[str], **request: Any) -> Tensors:
        self.process.must_live()
        jitter = request.get("jitter")
        generator = None if jitter is None else Jitter(jitter)
        try:
            answer = run_graph(self.graph, feeds, list(fetch), generator)
        except KeyError as error:
            raise RunFailedError(f"{self.process.name} has no tensor {error}") from error
        answer = self.process.pool.spoil(self.kind, self.process.name, dict(answer))
        missing = [name for name in fetch if name not in answer]
        if missing:
            raise RunFailedError(f"{self.process.name} gave no output {missing[0]!r}")
        return answer

    def run_all(
        self, inputs: Sequence[Mapping[str, Array]], fetch: Sequence[str], requests: Sequence[Mapping[str, Any]] = ()
    ) -> list[Tensors]:
        more = requests or [{}] * len(inputs)
        return [self.run(feeds, fetch, **request) for feeds, request in zip(inputs, more, strict=True)]

    def predict_all(self, inputs: Sequence[Mapping[str, Array]], outputs: Sequence[str]) -> list[Tensors]:
        return self.run_all(inputs, outputs)

    def unload(self) -> None:
        if self.process.alive:
            self.process.pool.unloaded.append((self.kind, self.process.name))

    def __enter__(self) -> Actor:
        return self

    def __exit__(self, *error: object) -> None:
        self.unload()


@dataclass
class ActingProcess:
    """A runtime's process, played."""

    name: str
    pool: ActingPool
    alive: bool = True

    def must_live(self) -> None:
        if not self.alive:
            raise RunFailedError(f"{self.name} is not running")

    def load(self, path: str, **options: Any) -> Actor:
        self.pool.loaded += 1
        place = Path(path)
        kind = "bytes" if self.name == "numpy" else format_of(place)
        if (kind, self.name) in self.pool.refused:
            self.pool.loaded -= 1
            raise RunFailedError(f"{self.name} failed", why="it does not like this model")
        if kind == "source" or place.suffix == ".bytes":
            graph = graph_in(place)
            if self.name == "numpy" and place.name != CUT:
                self.pool.reference = graph
        else:
            assert self.pool.reference is not None, "numpy is always the first to load"
            graph = self.pool.reference
        return Actor(kind, self, graph)


@dataclass
class ActingPool:
    """Takes the part of RuntimePool. The .bytes that numpy reads stands for every format."""

    spoil: Spoil = honest
    refused: frozenset[tuple[str, str]] = frozenset()
    unloaded: list[tuple[str, str]] = field(default_factory=list)
    processes: dict[str, ActingProcess] = field(default_factory=dict)
    reference: Graph | None = None
    loaded: int = 0

    def start(self, names: Iterable[str]) -> None:
        pass

    def process(self, name: str) -> ActingProcess:
        found = self.processes.setdefault(name, ActingProcess(name, self))
        found.alive = True
        return found

    def versions(self) -> dict[str, str]:
        return {name: "1.0" for name, process in self.processes.items() if process.alive}

    def __enter__(self) -> ActingPool:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.processes.clear()


def format_of(path: Path) -> str:
    """Which format a loader is given; a ``.bytes`` that is not in a bundle is the source, and so is ``source.pb``."""
    if path.name == "source.pb":
        return "source"
    if path.suffix == ".bytes":
        return "bytes" if (path.parent / "policy.json").exists() else "source"
    return {"saved_model": "saved_model", "tfjs": "tfjs"}.get(path.name, "onnx")


def export(
    monkeypatch: pytest.MonkeyPatch, source: Path, out: Path, pool: ActingPool, **options: Any
) -> list[ExportResult]:
    """Export ``source``, the runtimes of ``pool`` verifying."""
    monkeypatch.setattr(runtimes, "chosen_runtimes", lambda wanted, formats: (ALL, list(KNOWN)))
    return list(pipeline.export([source], pipeline.ExportOptions(out, **options), pool=pool))  # type: ignore[arg-type]


#: What the fixture ``exporting`` gives.
Exporting = Callable[..., ExportResult]


def report_of(result: ExportResult) -> ParityReport:
    assert result.report is not None
    return result.report


def spoiling(kind: str, runtime: str, change: Callable[[Tensors], object]) -> Spoil:
    """One format in one runtime answers something else where it is asked for the action."""

    def spoil(a: str, b: str, answer: Tensors) -> Tensors:
        if (a, b) == (kind, runtime) and {"action", "action:0"} & set(answer):
            change(answer)
        return answer

    return spoil


def failures(result: ExportResult) -> set[tuple[str, str, str, str]]:
    return {(c.format, c.runtime, c.output, c.kind) for c in report_of(result).failures}
