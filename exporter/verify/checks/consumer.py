"""What the consumer that a bundle was made for (``--for``) does with it: its checkers, and our model of its players."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from exporter.verify.findings import Accepted, Finding
from exporter.verify.tolerances import Tolerance

if TYPE_CHECKING:
    from converters.consumers.unity.checker import UnityVerdict

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
    from converters.consumers.profiles import profile
    from converters.consumers.unity.checker import check_file
    from converters.consumers.unity.consumers import consumer

    wanted = profile(name)
    for release in dict.fromkeys((*wanted.checkers, *wanted.players)):
        asked = consumer(release)
        plays = release in wanted.players
        for key in (k for k in ("onnx", "nn") if k in files and k in asked.formats):
            if plays or not (memory and key in wanted.own_names):
                wrong = _wrong(check_file(files[key], asked), plays)
                yield Accepted(
                    key, release, "*", 0.0, 0.0, Tolerance(0.0, 0.0), not wrong, None, "; ".join(wrong)[:600]
                )


def _wrong(verdict: UnityVerdict, plays: bool) -> list[str]:
    """What speaks against a file: of its import, its checks, and where a release ``plays`` it, of the player."""
    modes = [m for mode, m in verdict.modes.items() if mode == _MODE]
    thrown = [
        t.message for t in (verdict.refused, *(t for m in modes for t in (m.load, m.check_throws))) if t is not None
    ]
    listed = [f.message for m in modes for f in m.checks]
    played = [f"{p.outcome.value}: {p.message}" for m in modes for p in m.played if plays and p.fails]
    return list(dict.fromkeys((*thrown, *listed, *(f.message for f in verdict.misread), *played)))
