"""``inspect --unity``: what Unity would say to a file and do with it, for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from export_model.converters.consumers.unity.checker import ModeVerdict, UnityVerdict, check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS, consumer
from export_model.converters.consumers.unity.findings import Complaint, Thrown
from export_model.converters.consumers.unity.players import PLAYERS
from export_model.converters.consumers.unity.playing import PlayEvent
from export_model.converters.consumers.unity.settings import Brain, parse_actions, parse_sensors, read_brain
from export_model.exporter.tables import paragraph
from export_model.signatures.errors import UsageError
from export_model.signatures.fields import printable

_MODES = {"stochastic": "Deterministic Inference off", "deterministic": "Deterministic Inference on"}
_READ = (".onnx", ".nn")


def check_for_unity(
    source: Path, releases: Sequence[str], sensors: str = "", actions: str = "", brain: Path | None = None
) -> list[UnityVerdict]:
    """Hold a file (or the ``.onnx`` and ``.nn`` of a folder) against every release that is named, or ``all``.

    Raises UsageError for options that contradict each other, SourceError for what is no model of Unity's.
    """
    names = [name.strip() for given in releases for name in given.split(",") if name.strip()]
    wanted = list(CONSUMERS.values()) if "all" in names else []
    wanted += [consumer(name) for name in names if name != "all"]
    agent = _agent(sensors, actions, brain)
    verdicts = list[UnityVerdict]()
    for path in _files(source):  # the last first: its profile is what a refused file is to be exported for
        said = {release: check_file(path, release, agent) for release in reversed(dict.fromkeys(wanted))}
        verdicts += [said[release] for release in dict.fromkeys(wanted)]
    return verdicts


def all_accept(verdicts: Sequence[UnityVerdict]) -> bool:
    """Whether every release accepts every file and its player plays it, with Deterministic Inference off."""
    return all(verdict.accepted["stochastic"] for verdict in verdicts)


def unity_report(verdicts: Sequence[UnityVerdict]) -> dict[str, Any]:
    """For ``--json``."""
    return {
        "schema": 1,
        "accepted": all_accept(verdicts),
        "verdicts": [{"path": str(verdict.path), **verdict.to_dict()} for verdict in verdicts],
    }


def unity_text(verdicts: Sequence[UnityVerdict]) -> str:
    """For the terminal."""
    return "\n\n".join(_verdict_text(verdict) for verdict in verdicts)


def _agent(sensors: str, actions: str, brain: Path | None) -> Brain | None:
    if brain is not None and (sensors or actions):
        raise UsageError(
            "--brain-parameters says what --sensors and --actions say", fix="give the file, or the two options"
        )
    if brain is not None:
        return read_brain(brain)
    if not sensors and not actions:
        return None
    if not sensors or not actions:
        raise UsageError(
            "--sensors and --actions are given together",
            why="the checks compare both",
            fix="for example --sensors 8,3x84x84 --actions continuous:2; without either, the file's own are taken",
        )
    continuous, branches = parse_actions(actions)
    sensed = parse_sensors(sensors)
    size = sum(sensor.shape[0] for sensor in sensed if len(sensor.shape) == 1)
    return Brain(continuous, branches, size, 1, sensed)


def _files(source: Path) -> list[Path]:
    found = sorted(p for p in source.iterdir() if p.suffix.lower() in _READ) if source.is_dir() else [source]
    if not found:
        raise UsageError(f"{source} holds no .onnx and no .nn", fix="export one with --for unity6")
    return found


# ------------------------------------------------------------------ text


def _verdict_text(verdict: UnityVerdict) -> str:
    lines = [printable(f"{verdict.path}: {_summary(verdict)} by {verdict.consumer.title}")]
    if verdict.refused is not None:
        lines += ["  importing it:", *_thrown_lines(verdict.refused)]
    else:
        assumed = " (assumed from the file)" if verdict.assumed else ""
        lines += [printable(f"  the agent{assumed}: {_agent_text(verdict.brain)}")]
        same = len({(m.load, m.checks, m.check_throws) for m in verdict.modes.values()}) == 1
        for mode, found in list(verdict.modes.items())[: 1 if same else None]:
            lines += _mode_lines("" if same else f", {_MODES[mode]}", found, verdict.consumer.checks is not None)
    if verdict.misread:
        lines.append(f"  what {verdict.consumer.runtime} reads wrongly:")
        lines += [line for finding in verdict.misread for line in _finding_lines("misread", finding)]
    if verdict.refused is None:
        lines += _player_lines(verdict)
    return "\n".join(lines)


def _summary(verdict: UnityVerdict) -> str:
    yes = [_MODES[mode] for mode, said in verdict.accepted.items() if said]
    if len(yes) == len(verdict.accepted):
        return "accepted"
    if yes:
        return f"accepted with {yes[0]} only"
    return "not accepted (checked, but not played)" if any(verdict.checked.values()) else "not accepted"


def _player_lines(verdict: UnityVerdict) -> list[str]:
    """What the model of the player finds, which is no checker: it may fail on what the Inspector says nothing to."""
    modes = verdict.modes
    same = len({mode.played for mode in modes.values()}) == 1
    source = PLAYERS[verdict.consumer.name].played
    title = "the model of the player" + ("" if source == "run" else f" ({source})")
    lines = []
    for mode, found in list(modes.items())[: 1 if same else None]:
        where = title if same else f"{title}, {_MODES[mode]}"
        lines.append(f"  {where}:{'' if found.played else ' plays it'}")
        if found.load is not None:
            lines[-1] += " nothing is played, loading throws"
            continue
        for played in found.played:
            lines += _finding_lines(played.outcome.value, played)
            lines += paragraph(played.exception, " " * 6 + "throws: ", " " * 10).split("\n") if played.exception else []
    return lines


def _mode_lines(title: str, found: ModeVerdict, known: bool) -> list[str]:
    """``known``: so are the checks of the release."""
    lines = [f"  loading for running{title}: {'ok' if found.load is None else ''}".rstrip()]
    if found.load is not None:
        lines += _thrown_lines(found.load)
    if found.check_throws is not None and found.check_throws == found.load:
        return [*lines, f"  the Inspector{title}: the same exception in place of a list"]
    if not known:
        return [*lines, "  the Inspector: the checks of this release are not known"]
    listed = [line for finding in found.checks for line in _finding_lines(finding.severity.value, finding)]
    if found.check_throws is not None:
        listed = _thrown_lines(found.check_throws)
    return [*lines, f"  the Inspector{title}: {'' if listed else 'nothing to say'}".rstrip(), *listed]


def _finding_lines(kind: str, said: Complaint | Thrown | PlayEvent) -> list[str]:
    """A finding or an exception: what, where and what to do."""
    lines = []
    for head, text in ((f"{kind}: ", said.message), ("  where: ", said.where), ("  fix: ", said.fix)):
        for number, part in enumerate(text.rstrip("\n").split("\n")):
            if part.strip():
                indent = " " * 4 + (head if number == 0 else " " * 4)
                lines += paragraph(part, indent, " " * 8).split("\n")
    return lines


def _thrown_lines(thrown: Thrown) -> list[str]:
    return _finding_lines(f"throws {thrown.exception}", thrown)


def _agent_text(brain: Brain) -> str:
    actions = [f"{brain.continuous} continuous"] if brain.continuous else []
    actions += [f"branches {', '.join(map(str, brain.branches))}"] if brain.branches else []
    sensors = [f"{s.name} {'x'.join(map(str, s.shape))}" for s in brain.sensors]
    return f"actions {' and '.join(actions) or 'none'}; sensors {', '.join(sensors) or 'none'}"
