"""What the consumer that a bundle was made for (``--for``) does with it: its checkers, and our model of its players."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from export_model.converters.files.fetch import read_bytes
from export_model.exporter.verify.findings import Accepted, Finding, Played
from export_model.exporter.verify.tolerances import Tolerance

if TYPE_CHECKING:
    from export_model.converters.consumers.unity.checker import UnityVerdict

#: The mode of inference that all releases have: Deterministic Inference off.
_MODE = "stochastic"


def consumers(name: str | None, files: Mapping[str, Path], *, memory: bool = False) -> Iterator[Finding]:
    """A finding for each release of ML-Agents that checks or plays what profile ``name`` writes; ``files`` by format.

    It is judged with Deterministic Inference off, the mode that all releases have, and with the agent that the file
    is made for. The checks of releases 1 to 16 are not known; release 20 reads their models too, but for those with a
    ``memory``, which are asked of the players alone. Raises UsageError where this version has no such profile,
    DamagedFileError for a file that is broken.
    """
    if name is None:
        return
    from export_model.converters.consumers.profiles import profile
    from export_model.converters.consumers.unity.checker import check_file
    from export_model.converters.consumers.unity.consumers import consumer

    wanted = profile(name)
    for loader in wanted.loaders:
        from export_model.converters.consumers.robots.byte_array import SOURCE
        from export_model.converters.consumers.robots.loaders import LOADERS, file_interface

        program = LOADERS[loader]
        main = files[program.format]
        near = {f.name: read_bytes(f) for f in (main, main.with_name(SOURCE)) if f.is_file()}
        faults = [f"{rule.says} ({rule.evidence})" for rule in program.faults(file_interface(program, near, main.name))]
        yield _finding(Accepted, program.format, loader, faults)
    for release in dict.fromkeys((*wanted.checkers, *wanted.players)):
        asked = consumer(release)
        for key in (k for k in asked.formats if k in files):
            checks = release in wanted.checkers and not (memory and key in wanted.own_names)
            plays = release in wanted.players
            if not checks and not plays:
                continue
            verdict = check_file(files[key], asked)
            if checks:
                yield _finding(Accepted, key, release, _import_faults(verdict))
            if plays:
                yield _finding(
                    Played, key, release, _player_faults(verdict) + ([] if checks else _import_faults(verdict))
                )


def _finding(kind: type[Accepted], key: str, release: str, wrong: list[str]) -> Finding:
    reason = "; ".join(dict.fromkeys(wrong))[:600]
    return kind(
        format=key,
        runtime=release,
        output="*",
        max_abs_diff=0.0,
        max_rel_diff=0.0,
        tolerance=Tolerance(0.0, 0.0),
        passed=not wrong,
        worst_input=None,
        reason=reason,
    )


def _import_faults(verdict: UnityVerdict) -> list[str]:
    """Return what speaks against a file in its import and its checks."""
    modes = [m for mode, m in verdict.modes.items() if mode == _MODE]
    thrown = [
        t.message for t in (verdict.refused, *(t for m in modes for t in (m.load, m.check_throws))) if t is not None
    ]
    listed = [f.message for m in modes for f in m.checks]
    return [*thrown, *listed, *(f.message for f in verdict.misread)]


def _player_faults(verdict: UnityVerdict) -> list[str]:
    """Return what our model of the player finds wrong with a file."""
    modes = [m for mode, m in verdict.modes.items() if mode == _MODE]
    return [f"{p.outcome.value}: {p.message}" for m in modes for p in m.played if p.fails]
