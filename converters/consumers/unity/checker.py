"""What Unity would do with a file: importing it, loading it for running, the Inspector's list, and playing it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.consumers.unity import barracuda_model, importing, rules, sentis_model
from export_model.converters.consumers.unity.assumed import assumed_brain, nn_ranks, onnx_ranks
from export_model.converters.consumers.unity.constructs import INPUT, OUTPUT, constructs
from export_model.converters.consumers.unity.consumers import CONSUMERS, Consumer, Engine
from export_model.converters.consumers.unity.findings import Complaint, Severity, Thrown, UnityThrows
from export_model.converters.consumers.unity.model import CheckedModel
from export_model.converters.consumers.unity.onnx_file import OnnxFile, read_onnx_file
from export_model.converters.consumers.unity.players import PLAYERS, PlayOutcome
from export_model.converters.consumers.unity.playing import PlayEvent, play, throws
from export_model.converters.consumers.unity.readings import Reading, misreadings
from export_model.converters.consumers.unity.scene import Scene
from export_model.converters.consumers.unity.settings import Brain
from export_model.converters.files.fetch import Fetched, read_bytes
from export_model.converters.formats.barracuda import format as nn_format
from export_model.converters.formats.recognise import recognise_path
from export_model.converters.formats.registry import BARRACUDA, ONNX
from export_model.signatures.errors import ExportModelError, SourceError

#: Deterministic Inference of Behavior Parameters: off and on.
MODES = {"stochastic": False, "deterministic": True}
_NN_FORMATS = range(16, 21)
#: Barracuda takes its format's number from the first eight bytes, which hold a magic number too.
_MAGIC = 255
_Result = TypeVar("_Result")


class ModeVerdict(Struct, frozen=True):
    """What happens with Deterministic Inference off, or on.

    ``load`` is what loading for running throws; ``checks`` the Inspector's list, in its order, and ``check_throws`` the
    exception that takes its place; ``fetched`` the outputs that a player fetches, or the exception of finding them.
    ``played`` is what the player trips over.
    """

    load: Thrown | None
    checks: tuple[Complaint, ...]
    check_throws: Thrown | None = None
    fetched: tuple[str, ...] | Thrown = ()
    played: tuple[PlayEvent, ...] = ()

    @property
    def checked(self) -> bool:
        """Whether it loads and the Inspector's list is empty."""
        return self.load is None and self.check_throws is None and not self.checks

    @property
    def plays(self) -> bool:
        """Whether the model of the player plays it."""
        return not any(played.fails for played in self.played)

    @property
    def accepted(self) -> bool:
        """Whether the checker accepts it and the player plays it."""
        return self.checked and self.plays

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        fetched = self.fetched.to_dict() if isinstance(self.fetched, Thrown) else list(self.fetched)
        return {
            "accepted": self.accepted,
            "checked": self.checked,
            "plays": self.plays,
            "played": [p.to_dict() for p in self.played],
            "load": None if self.load is None else self.load.to_dict(),
            "check": [f.to_dict() for f in self.checks],
            "check_throws": None if self.check_throws is None else self.check_throws.to_dict(),
            "fetched": fetched,
        }


class UnityVerdict(Struct, frozen=True):
    """What one release says to one file with one set of Behavior Parameters.

    ``refused`` is what the import throws; ``modes`` is empty then. ``misread`` is what of the graph its importer takes
    for something else. ``assumed``: nobody gave the parameters, they were taken from the file.
    """

    path: Path
    consumer: Consumer
    brain: Brain
    refused: Thrown | None
    modes: Mapping[str, ModeVerdict] = field(default_factory=dict)
    misread: tuple[Complaint, ...] = ()
    assumed: bool = False

    @property
    def accepted(self) -> Mapping[str, bool]:
        """Mode → whether the checker accepts the file in it and the player plays it."""
        return {mode: mode in self.modes and self.modes[mode].accepted for mode in modes_of(self.consumer)}

    @property
    def checked(self) -> Mapping[str, bool]:
        """Mode → whether the checker accepts the file in it; nothing where the checker is not known."""
        known = () if self.consumer.checks is None else modes_of(self.consumer)
        return {mode: mode in self.modes and self.modes[mode].checked for mode in known}

    @property
    def plays(self) -> Mapping[str, bool]:
        """Mode → whether the model of the player plays the file."""
        return {mode: mode in self.modes and self.modes[mode].plays for mode in modes_of(self.consumer)}

    @property
    def played(self) -> tuple[PlayEvent, ...]:
        """What the player trips over, in either mode, each once."""
        return tuple(dict.fromkeys(played for mode in self.modes.values() for played in mode.played))

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "release": self.consumer.name,
            "package": self.consumer.package,
            "runtime": self.consumer.runtime,
            "brain": self.brain.to_dict(),
            "brain_assumed": self.assumed,
            "accepted": dict(self.accepted),
            "checked": dict(self.checked),
            "plays": dict(self.plays),
            "player": PLAYERS[self.consumer.name].played,
            "import": None if self.refused is None else self.refused.to_dict(),
            **{mode: verdict.to_dict() for mode, verdict in self.modes.items()},
            "overlooked": [
                {"severity": "warning", "message": p.message, "where": p.where, "fix": p.fix}
                for p in self.played
                if p.outcome not in (PlayOutcome.REFUSED, PlayOutcome.LOADING)
            ],
            "misread": [f.to_dict() for f in self.misread],
        }


def modes_of(consumer: Consumer) -> tuple[str, ...]:
    """The modes of inference that a release has."""
    return tuple(mode for mode, deterministic in MODES.items() if consumer.deterministic or not deterministic)


def check_file(path: Path, consumer: Consumer, brain: Brain | None = None) -> UnityVerdict:
    """Hold a file against the rules of a release; without ``brain``, with the agent that it seems made for.

    Raises SourceError for a file that is neither ONNX nor ``.nn``, DamagedFileError for one that cannot be read.
    """
    found = recognise_path(Fetched(path))
    if found is BARRACUDA or (path.suffix.lower() == ".nn" and found is not ONNX):
        return _check_nn_file(path, consumer, brain)
    if found is not ONNX:
        raise SourceError(
            "must be an .onnx or a .nn",
            where=str(path),
            why="Unity's importers read these two",
            fix=f"export it with --for {consumer.profile}, and check what that writes",
        )
    return check_onnx(read_onnx_file(path), path, consumer, brain)


def check_onnx(file: OnnxFile, path: Path, consumer: Consumer, brain: Brain | None = None) -> UnityVerdict:
    """The same of an ONNX that is parsed already; ``path`` is what the verdict names."""
    refused, wrong = importing.refusal(file, consumer), _misread(file, consumer)
    if refused is not None:
        return UnityVerdict(path, consumer, brain or Brain(), refused, misread=wrong, assumed=brain is None)
    model: CheckedModel
    if consumer.engine is Engine.BARRACUDA:
        model = barracuda_model.of_onnx(file, consumer)
    else:
        model = sentis_model.of_onnx(file, consumer)
    return _verdict_on_import(
        path, consumer, brain=brain, model=model, ranks=onnx_ranks(file, model), file=file, wrong=wrong
    )


def _check_nn_file(path: Path, consumer: Consumer, brain: Brain | None) -> UnityVerdict:
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
    return check_nn(nn_format.parse(data), path, consumer, brain)


def check_nn(parsed: nn_format.NnModel, path: Path, consumer: Consumer, brain: Brain | None = None) -> UnityVerdict:
    """The same of a ``.nn`` that is parsed already, by a release on Barracuda."""
    return _verdict_on_import(
        path, consumer, brain, barracuda_model.of_nn(parsed, consumer), nn_ranks(parsed), nn=parsed
    )


def _verdict_on_import(
    path: Path,
    consumer: Consumer,
    brain: Brain | None,
    model: CheckedModel,
    ranks: Sequence[int],
    file: OnnxFile | None = None,
    wrong: tuple[Complaint, ...] = (),
    nn: nn_format.NnModel | None = None,
) -> UnityVerdict:
    """The verdict on a model that was imported; ``ranks`` are the numbers of axes of its inputs."""
    # a release that lays pictures out wrongly is no witness of what the agent sees
    seen = model if file is None or consumer.reads_version else barracuda_model.of_onnx(file, CONSUMERS["R20"])
    agent = brain or assumed_brain(seen, ranks)
    modes = {}
    for name in modes_of(consumer):
        judged = _mode(model, consumer, agent, MODES[name], file)
        modes[name] = replace(judged, played=_play(judged, consumer, model, agent, file, nn))
    return UnityVerdict(
        path=path, consumer=consumer, brain=agent, refused=None, modes=modes, misread=wrong, assumed=brain is None
    )


def _mode(
    model: CheckedModel, consumer: Consumer, brain: Brain, deterministic: bool, file: OnnxFile | None
) -> ModeVerdict:
    if isinstance(model, sentis_model.SentisModel) and file is not None:
        thrown = sentis_model.failure(file, consumer) or _try(lambda: model.load(deterministic))
        if thrown is not None:
            return ModeVerdict(thrown, (), thrown, thrown)
    checks = _try(lambda: rules.check(model, brain, deterministic, consumer))
    fetched = _try(lambda: model.fetched_outputs(deterministic))
    load = _try(lambda: rules.version_error(model, consumer.profile)) if consumer.reads_version else None
    if isinstance(load, Complaint):
        load = Thrown("UnityAgentsException", load.message, load.where, load.fix)
    if isinstance(checks, Thrown):
        return ModeVerdict(load, (), checks, fetched)
    return ModeVerdict(load, tuple(checks), None, fetched)


def _play(
    judged: ModeVerdict,
    consumer: Consumer,
    model: CheckedModel,
    brain: Brain,
    file: OnnxFile | None,
    nn: nn_format.NnModel | None,
) -> tuple[PlayEvent, ...]:
    for thrown in (judged.load, judged.fetched):
        if isinstance(thrown, Thrown):
            return (throws(PlayOutcome.LOADING, thrown),)
    assert not isinstance(judged.fetched, Thrown)
    return play(Scene(consumer, model, brain, judged.fetched, file, nn))


def _try(step: Callable[[], _Result]) -> _Result | Thrown:
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


def _misread(file: OnnxFile, consumer: Consumer) -> tuple[Complaint, ...]:
    """The constructs of a file that its importer does not read rightly: one finding per kind, with its places.

    Most of these give no error in Unity. Empty where the shapes of the file contradict each other.
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
        Complaint(
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
