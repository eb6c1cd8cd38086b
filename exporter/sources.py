"""A path on the command line to policies: recognise, read, compile."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from converters.frozen_graph.reader import read_graph
from converters.graph.compile import CompileOptions, compile_graph
from converters.recognise import FROZEN_GRAPH, FileKind, not_readable, read_bytes, recognise
from signatures.errors import ExportModelError
from signatures.graph import Graph
from signatures.spec import Policy


@dataclass(frozen=True)
class Source:
    """A model file that was read: its graph, and where it came from."""

    path: Path
    kind: FileKind
    sha256: str
    size: int
    graph: Graph

    @property
    def stem(self) -> str:
        """What its policy is called. ``frozen_graph_def.pb`` says nothing: the folder's name, its behaviour, does."""
        if self.path.name in ("frozen_graph_def.pb", "saved_model.pb"):
            return self.path.resolve().parent.name or self.path.stem
        return self.path.stem

    def policies(self, options: CompileOptions | None = None) -> list[Policy]:
        """The policies in it; raises ExportModelError that names the file."""
        try:
            return compile_graph(self.graph, self.stem, options)
        except ExportModelError as error:
            raise error.at(str(self.path)) from error


def read_source(path: Path | str) -> Source:
    """Read a source. Raises SourceError, NotAPolicyError, DamagedFileError or GraphError, each naming the file."""
    path = Path(path)
    data = read_bytes(path)
    kind = recognise(data, path.name)
    if kind.key != FROZEN_GRAPH.key:
        raise not_readable(kind, path)
    try:
        graph = read_graph(data)
    except ExportModelError as error:
        raise error.at(str(path)) from error
    return Source(path, kind, hashlib.sha256(data).hexdigest(), len(data), graph)
