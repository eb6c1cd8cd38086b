"""A path on the command line to policies: recognise, read, compile."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from converters.graph.compile import compile_graph
from converters.graph.options import CompileOptions
from converters.recognise import FileKind, not_readable, recognise_path
from converters.registry import reader
from converters.source import ReadOptions, SourceModel
from signatures.errors import ExportModelError
from signatures.spec import Policy

#: File names that say nothing of the policy: the folder's name, its behavior, does.
_NAMELESS = ("frozen_graph_def.pb", "saved_model.pb", "model.json", "checkpoint")


@dataclass(frozen=True)
class Source:
    """A file or folder that was read: its models, and where they came from."""

    path: Path
    kind: FileKind
    sha256: str
    size: int
    models: Sequence[SourceModel] = field(default_factory=tuple)

    def stem(self, model: SourceModel) -> str:
        """What a model's policy is called."""
        if model.name is not None:
            return model.name
        if self.path.name in _NAMELESS or self.path.is_dir():
            folder = self.path if self.path.is_dir() else self.path.resolve().parent
            return folder.resolve().name or self.path.stem
        return self.path.stem

    def compiled(self, options: CompileOptions | None = None) -> Iterator[tuple[SourceModel, Policy]]:
        """Each model's policies; raises ExportModelError that names the file."""
        for model in self.models:
            try:
                for policy in compile_graph(model.graph, self.stem(model), options, model.facts):
                    yield model, policy
            except ExportModelError as error:
                raise error.at(str(self.path)) from error

    def policies(self, options: CompileOptions | None = None) -> list[Policy]:
        """All policies in it."""
        return [policy for _, policy in self.compiled(options)]


def read_source(path: Path | str, options: ReadOptions | None = None) -> Source:
    """Read a source. Raises SourceError, NotAPolicyError, DamagedFileError or GraphError, each naming the file."""
    path = Path(path)
    kind = recognise_path(path)
    read = reader(kind.key)
    if read is None:
        raise not_readable(kind, path)
    try:
        models = read(path, options or ReadOptions())
    except ExportModelError as error:
        raise error.at(str(path)) from error
    files = sorted({f for model in models for f in model.files})
    return Source(path, kind, _digest(files), sum(f.stat().st_size for f in files), models)


def _digest(files: Sequence[Path]) -> str:
    """The sha256 of a single file, or of the hashes of several in the order of their names."""
    hashes = [hashlib.sha256(f.read_bytes()).hexdigest() for f in files]
    return hashes[0] if len(hashes) == 1 else hashlib.sha256("\n".join(hashes).encode()).hexdigest()
