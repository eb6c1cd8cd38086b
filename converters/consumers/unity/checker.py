"""What Unity would say to a file: importing it, loading it for running, and the Inspector's list."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import Any, TypeVar

from converters.consumers.unity import barracuda_model, importing, rules, sentis_model
from converters.consumers.unity.assumed import assumed_brain, nn_ranks, onnx_ranks
from converters.consumers.unity.constructs import INPUT, OUTPUT, constructs
from converters.consumers.unity.consumers import Consumer, Engine
from converters.consumers.unity.findings import Finding, Severity, Thrown, UnityThrows
from converters.consumers.unity.model import CheckedModel
from converters.consumers.unity.onnx_file import OnnxFile, read_onnx_file
from converters.consumers.unity.overlooked import overlooked
from converters.consumers.unity.readings import Reading, misreadings
from converters.consumers.unity.settings import Brain
from converters.files.fetch import Fetched, read_bytes
from converters.formats.barracuda import format as nn_format
from converters.formats.recognise import recognised
from signatures.errors import ExportModelError, SourceError
from signatures.records import dataclass

#: Deterministic Inference of Behavior Parameters: off and on.
MODES = {"stochastic": False, "deterministic": True}
_NN_FORMATS = range(16, 21)
#: Barracuda takes its format's number from the first eight bytes, which hold a magic number too.
_MAGIC = 255
_Result = TypeVar("_Result")


@dataclass(frozen=True, slots=True)
class ModeVerdict:
    """What happens with Deterministic Inference off, or on.

    ``load`` is what loading for running throws; ``checks`` the Inspector's list, in its order, and ``check_throws`` the
    exception that takes its place; ``fetched`` the outputs that a player fetches, or the exception of finding them.
    """

    load: Thrown | None
    checks: tuple[Finding, ...]
    check_throws: Thrown | None = None
    fetched: tuple[str, ...] | Thrown = ()

    @property
    def accepted(self) -> bool:
        """Whether it loads and the Inspector's list is empty."""
        return self.load is None and self.check_throws is None and not self.checks

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        fetched = self.fetched.to_dict() if isinstance(self.fetched, Thrown) else list(self.fetched)
        return {
            "accepted": self.accepted,
            "load": None if self.load is None else self.load.to_dict(),
            "check": [f.to_dict() for f in self.checks],
            "check_throws": None if self.check_throws is None else self.check_throws.to_dict(),
            "fetched": fetched,
        }


@dataclass(frozen=True, slots=True)
class UnityVerdict:
    """What one release says to one file with one set of Behavior Parameters.

    ``refused`` is what the import throws; ``modes`` is empty then. ``overlooked`` is what Unity does not say and a
    player trips over, ``misread`` what of the graph its importer takes for something else. ``assumed``: nobody gave
    the parameters, they were taken from the file.
    """

    path: Path
    consumer: Consumer
    brain: Brain
    refused: Thrown | None
    modes: Mapping[str, ModeVerdict] = field(default_factory=dict)
    overlooked: tuple[Finding, ...] = ()
    misread: tuple[Finding, ...] = ()
    assumed: bool = False

    @property
    def accepted(self) -> Mapping[str, bool]:
        """Mode → whether the file is accepted in it."""
        return {mode: mode in self.modes and self.modes[mode].accepted for mode in MODES}

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "release": self.consumer.name,
            "package": self.consumer.package,
            "runtime": self.consumer.runtime,
            "brain": self.brain.to_dict(),
            "brain_assumed": self.assumed,
            "accepted": dict(self.accepted),
            "import": None if self.refused is None else self.refused.to_dict(),
            **{mode: verdict.to_dict() for mode, verdict in self.modes.items()},
            "overlooked": [f.to_dict() for f in self.overlooked],
            "misread": [f.to_dict() for f in self.misread],
        }


def check_file(path: Path, consumer: Consumer, brain: Brain | None = None) -> UnityVerdict:
    """Hold a file against the rules of a release; without ``brain``, with the agent that it seems made for.

    Raises SourceError for a file that is neither ONNX nor ``.nn``, DamagedFileError for one that cannot be read.
    """
    kind = recognised(Fetched(path)).key
    if kind == "nn" or (path.suffix.lower() == ".nn" and kind != "onnx"):
        return _check_nn(path, consumer, brain)
    if kind != "onnx":
        raise SourceError(
            "is no .onnx and no .nn",
            where=str(path),
            why="Unity's importers read these two",
            fix=f"export it with --for {consumer.profile}, and check what that writes",
        )
    file = read_onnx_file(path)
    refused, wrong = importing.refusal(file, consumer), _misread(file, consumer)
    if refused is not None:
        return UnityVerdict(path, consumer, brain or Brain(), refused, misread=wrong, assumed=brain is None)
    model: CheckedModel
    if consumer.engine is Engine.BARRACUDA:
        model = barracuda_model.of_onnx(file)
    else:
        model = sentis_model.of_onnx(file, consumer)
    return _imported(path, consumer, brain, model, onnx_ranks(file, model), file, wrong)


def _check_nn(path: Path, consumer: Consumer, brain: Brain | None) -> UnityVerdict:
    data = read_bytes(path)
    version = int.from_bytes(data[:8], "little", signed=True) % _MAGIC
    refused = None
    if consumer.engine is not Engine.BARRACUDA:
        text, fix = f"{consumer.runtime} does not read .nn", f"export it with --for {consumer.profile}"
        refused = Thrown("no importer", text, str(path), fix, worded=False)
    elif version not in _NN_FORMATS:
        fix = "export it with --to nn, or with --for barracuda-3: both write a version that is read"
        refused = Thrown("NotSupportedException", f"Format version not supported: {version}", str(path), fix)
    if refused is not None:
        return UnityVerdict(path, consumer, brain or Brain(), refused, assumed=brain is None)
    parsed = nn_format.parse(data)
    return _imported(path, consumer, brain, barracuda_model.of_nn(parsed), nn_ranks(parsed))


def _imported(
    path: Path,
    consumer: Consumer,
    brain: Brain | None,
    model: CheckedModel,
    ranks: Sequence[int],
    file: OnnxFile | None = None,
    wrong: tuple[Finding, ...] = (),
) -> UnityVerdict:
    """The verdict on a model that was imported; ``ranks`` are the numbers of axes of its inputs."""
    agent = brain or assumed_brain(model, ranks)
    modes = {name: _mode(model, consumer, agent, deterministic, file) for name, deterministic in MODES.items()}
    fetched = {name: mode.fetched for name, mode in modes.items() if mode.load is None}  # past loading
    silent = [name for name, mode in modes.items() if mode.accepted]
    unsaid = overlooked(model, agent, fetched, silent, consumer, file)
    return UnityVerdict(path, consumer, agent, None, modes, unsaid, wrong, brain is None)


def _mode(
    model: CheckedModel, consumer: Consumer, brain: Brain, deterministic: bool, file: OnnxFile | None
) -> ModeVerdict:
    if isinstance(model, sentis_model.SentisModel) and file is not None:
        thrown = sentis_model.failure(file, consumer) or _tried(lambda: model.load(deterministic))
        if thrown is not None:
            return ModeVerdict(thrown, (), thrown, thrown)
    checks = _tried(lambda: rules.check(model, brain, deterministic, consumer.profile))
    fetched = _tried(lambda: model.fetched(deterministic))
    load = _tried(lambda: rules.version_error(model, consumer.profile))
    if isinstance(load, Finding):
        load = Thrown("UnityAgentsException", load.message, load.where, load.fix)
    if isinstance(checks, Thrown):
        return ModeVerdict(load, (), checks, fetched)
    return ModeVerdict(load, tuple(checks), None, fetched)


def _tried(step: Callable[[], _Result]) -> _Result | Thrown:
    """What a step gives, or what it throws."""
    try:
        return step()
    except UnityThrows as raised:
        return raised.thrown


_SAYS = {
    Reading.WRONG: "gives other numbers, without an error",
    Reading.REFUSED: "is refused",
    Reading.FAILS: "throws when it runs",
    Reading.LOST: "is left out",
}


def _misread(file: OnnxFile, consumer: Consumer) -> tuple[Finding, ...]:
    """The constructs of a file that its importer does not read rightly: one finding per kind, with its places; empty
    where the shapes of the file contradict each other. Most of them give no error at all.
    """
    if file.has_negative_lengths:
        return ()  # ONNX's shape inference would abort the process
    try:
        model = constructs(file.model)
    except (ExportModelError, ValueError, TypeError, LookupError):
        return ()
    found: dict[tuple[Reading, str, str], list[str]] = {}
    for reading in misreadings(model, [consumer.runtime]):
        op = {INPUT: "an input", OUTPUT: "an output"}.get(reading.construct.op, reading.construct.op)
        found.setdefault((reading.rule.reading, op, reading.rule.says), []).append(reading.construct.name)
    return tuple(
        Finding(
            Severity.ERROR,
            f"{op} {_SAYS[kind]}: {says}",
            _places(names),
            f"--for {consumer.profile} writes it in a form that {consumer.runtime} reads",
        )
        for (kind, op, says), names in found.items()
    )


def _places(names: list[str]) -> str:
    shown = ", ".join(names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"
