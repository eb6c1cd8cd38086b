"""A path on the command line to policies: recognise, read, compile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.compiler.compile import compile_graph, explanations
from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.format import Format
from export_model.converters.formats.read import check_options, each_or_refused, fetch, read_models
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.policy.policy import Policy
from export_model.converters.policy.rules import RoleDecision
from export_model.signatures.errors import ExportModelError, naming

#: File names that say nothing of the policy: the folder's name, its behavior, does.
_NAMELESS = ("frozen_graph_def.pb", "saved_model.pb", "model.json", "checkpoint")


class Source(Struct, frozen=True):
    """A file or folder that was read: its models, and where they came from."""

    path: Path
    format: Format
    sha256: str
    size: int
    models: Sequence[SourceModel] = field(default_factory=tuple)

    def stem(self, model: SourceModel) -> str:
        """What a model's policy is called."""
        if model.name is not None:
            return model.name
        if self.path.name in _NAMELESS or self.path.is_dir():
            folder = self.path if self.path.is_dir() else self.path.parent
            return folder.resolve().name or self.path.stem
        return self.path.stem

    def compile_models(self, options: CompileOptions | None = None) -> Iterator[tuple[SourceModel, Policy]]:
        """Each model's policies; raises ExportModelError that names the file."""
        for model in self.models:
            yield from self._of_model(model, options)

    def compiled_or_refused(
        self, options: CompileOptions | None, refused: list[ExportModelError]
    ) -> list[tuple[SourceModel, Policy]]:
        """The policies of all models; of several, one that is refused goes to ``refused``, and the others stay."""
        if len(self.models) < 2:
            return list(self.compile_models(options))
        return each_or_refused(self.models, lambda model: self._of_model(model, options), refused)

    def _of_model(self, model: SourceModel, options: CompileOptions | None) -> list[tuple[SourceModel, Policy]]:
        with naming(self.path):
            policies = compile_graph(model.graph, self.stem(model), options, model.facts)
            return [(narrow_original(model, policy), policy) for policy in policies]

    def explain(self, model: SourceModel, options: CompileOptions | None) -> dict[str, tuple[RoleDecision, ...]]:
        """Why the tensors of a model's policies have their roles, by policy."""
        with naming(self.path):
            return explanations(model.graph, self.stem(model), options, model.facts)

    def policies(self, options: CompileOptions | None = None) -> list[Policy]:
        """All policies in it."""
        return [policy for _, policy in self.compile_models(options)]


def narrow_original(model: SourceModel, policy: Policy) -> SourceModel:
    """The model with no more of its original than a policy asks for. Raises UnsupportedOpError, GraphError."""
    if model.original is None:
        return model
    return replace(model, original=model.original.narrow(policy.source))


@contextmanager
def live_source(kind: str, given: object) -> Iterator[Source]:
    """A live object as a source; ``kind`` is ``session``, ``tf_function`` or ``keras_model``.

    It lasts as long as the context: what TensorFlow runs the original from lies in a temporary folder. Raises
    UsageError, and what ``read_source`` raises.
    """
    from export_model.converters.files.folders import scratch_folder
    from export_model.converters.formats.live.source import label, read_live

    with scratch_folder() as folder:
        place = Path(label(kind))
        with naming(place):
            live = read_live(kind, given, Path(folder))
        yield Source(place, live.format, live.sha256, live.size, [live.model])


def read_source(
    path: Path | str, options: ReadOptions | None = None, refused: list[ExportModelError] | None = None
) -> Source:
    """Read a source. Raises SourceError, NotAPolicyError, DamagedFileError or GraphError, each naming the file.

    With ``refused``, which gets the errors, a file of a folder that cannot be read does not refuse the others.
    """
    path = Path(path)
    options = options or ReadOptions()
    given, found = fetch(path)
    check_options(found, path, options)
    with naming(path):
        errors: list[ExportModelError] = []
        models = read_models(given, found, options, None if refused is None else errors)
        if refused is not None:
            refused += [error.at(str(path)) for error in errors]
        files = {f for model in models for f in model.files}
        return Source(path, found, given.digest(files), sum(f.stat().st_size for f in files), models)
