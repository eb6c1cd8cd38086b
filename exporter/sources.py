"""A path on the command line to policies: recognise, read, compile."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from converters.frozen_graph.reader import read_graph
from converters.graph.compile import compile_graph
from converters.graph.options import CompileOptions
from converters.recognise import FROZEN_GRAPH, FileKind, not_readable, read_bytes, recognise
from signatures.errors import ExportModelError, GraphError
from signatures.graph import Graph
from signatures.spec import Policy


#: What Python and numpy raise where a damaged graph breaks something that a pass takes for granted.
_BROKEN = (
    *(ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError),
    *(MemoryError, RecursionError),
)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors inside name the file. A model file is untrusted: an error that nobody foresaw is one of them, too."""
    try:
        yield
    except ExportModelError as error:
        raise error.at(str(path)) from error.__cause__
    except _BROKEN as error:
        raise GraphError(
            "the graph cannot be understood",
            where=str(path),
            why=f"a step failed on something it did not expect ({type(error).__name__}: {error})",
            fix="if TensorFlow loads this file, please open an issue with it; else freeze the graph again",
        ) from error


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
        with naming(self.path):
            return compile_graph(self.graph, self.stem, options)


def read_source(path: Path | str) -> Source:
    """Read a source. Raises SourceError, NotAPolicyError, DamagedFileError or GraphError, each naming the file."""
    path = Path(path)
    data = read_bytes(path)
    kind = recognise(data, path.name)
    if kind.key != FROZEN_GRAPH.key:
        raise not_readable(kind, path)
    with naming(path):
        graph = read_graph(data)
    return Source(path, kind, hashlib.sha256(data).hexdigest(), len(data), graph)
