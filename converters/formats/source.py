"""What a reader returns: a graph in the TensorFlow vocabulary, and what the format says beside it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.subgraph import check, subgraph
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.facts import SourceFacts
from export_model.signatures.errors import ExportModelError
from export_model.signatures.spec import SourceMap

if TYPE_CHECKING:
    from export_model.converters.trainers.trainer import Modules

#: An option of a run for which a child imports TensorFlow's Python first, more than what a file from anyone may take;
#: the model is the user's own.
BUILT_BY_PYTHON: Mapping[str, Any] = {"answered": True}


class OriginalRun(Struct, frozen=True):
    """How the source itself is run, for comparison: a runtime, and what its child process is told to load.

    ``definition`` is the GraphDef that TensorFlow runs, as the file has it, variables apart, which are constants. It
    is None where the child reads the file itself, within the reader's own rules (ONNX).
    """

    runtime: str
    path: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    definition: Any = None
    #: writes a copy to a folder that holds what the file names elsewhere; returns the copy
    copy: Callable[[Path], Path] | None = None
    #: what of the definition lies beside it
    detached: Detached = field(default_factory=Detached)
    #: the tensors that are asked for, and those that are fed: no more of the definition is run (None: all of it)
    asked: tuple[Collection[str], Collection[str]] | None = None

    def narrow(self, source_map: SourceMap) -> OriginalRun:
        """The same with no more of the definition than a policy asks for, which is held against what may be run.

        Raises UnsupportedOpError where an op that does more than compute hangs on it, GraphError where it is not whole.
        """
        if self.definition is None:
            return self
        asked = source_map.all_fetches(), source_map.all_feeds()
        check(self.definition, *asked)
        return replace(self, asked=asked)

    @contextmanager
    def loadable(self) -> Iterator[tuple[str, Mapping[str, Any]]]:
        """The path and the options that the child is told; what was written for it is gone afterwards."""
        if self.definition is None and self.copy is None:
            yield str(self.path), self.options
            return
        with scratch_folder() as folder:
            if self.copy is not None:
                try:
                    file = self.copy(folder)
                except ExportModelError as error:
                    from export_model.converters.files.children.process import (
                        RunFailedError,  # an export alone starts no process
                    )

                    raise RunFailedError("cannot be given to its runtime", why=f"{error.what}: {error.why}") from error
                yield str(file), self.options
                return
            file = folder / "source.pb"
            part = self.definition if self.asked is None else subgraph(self.definition, *self.asked)
            schema.pieces(part, self.detached).write(file)
            yield str(file), {"kind": "graph", "source": True}


def run_of(path: Path, modules: Modules | None) -> OriginalRun | None:
    """How PyTorch runs a trainer's network, of the state that was read as data; None where it is not built there."""
    if modules is None:
        return None
    return OriginalRun("torch", path, {"kind": modules.kind, **modules.told}, copy=modules.write)


class SourceModel(Struct, frozen=True):
    """One model of a source (a run folder has one per behavior; a graph may still hold several brains).

    ``name`` is the policy's name where the path does not give it; ``files`` are the files that were read, for the
    hash of the source. ``original`` is None where no runtime reads the source (a ``.nn``). ``producer`` is what the
    file says of the tool that wrote it, and in which version of the format.
    """

    graph: Graph
    files: tuple[Path, ...]
    facts: SourceFacts = field(default_factory=SourceFacts)
    name: str | None = None
    original: OriginalRun | None = None
    producer: str = ""
    #: samplers whose seed the graph does not keep draw alike after every start
    seeded: bool = False


#: What ``--set normaliser=`` is given to leave it out.
NO_NORMALISER = "none"


class ReadOptions(Struct, frozen=True):
    """What a reader may be told.

    - ``step``: of the checkpoint (None: the newest).
    - ``sensors``: the shapes of the agent's sensors, in their order: lists of entities [most, numbers], images C, H, W
      (empty: as far as the source tells).
    - ``trust_source``: whether a source may be loaded that runs what it says.
    - ``goals``: which of the sensors are goals, by their place.
    - ``activation``: the one between layers.
    - ``normaliser``: the file with the statistics that observations were normalised by (None: the one beside the
      source; ``NO_NORMALISER``: they are left out).
    - ``script``: which script saved a state dictionary.
    - ``repair``: which fault of an ONNX model's exporter is mended.
    - ``interface``: the file that states the interface (None: those beside the source; "none": none).
    """

    step: int | None = None
    sensors: tuple[tuple[int, ...], ...] = ()
    trust_source: bool = False
    goals: tuple[int, ...] = ()
    activation: str | None = None
    normaliser: str | None = None
    interface: str | None = None
    script: str | None = None
    repair: str | None = None
