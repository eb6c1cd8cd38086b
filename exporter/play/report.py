"""What play says of a policy, as data and as lines for the terminal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.exporter.play.episodes import Episodes
from export_model.exporter.play.equivalence import mean_interval, scale_of
from export_model.exporter.play.match import PlayedArtifact
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.tables import table
from export_model.exporter.verify.plays import (
    CONFIDENCE,
    DIFFERENT,
    EQUIVALENT,
    NOT_DECIDED,
    Interval,
    Player,
    PlayRecord,
)
from export_model.exporter.verify.report import ParityReport


class PlayReport(Struct, frozen=True):
    """The replay of recorded states, and the returns of everything that played beside the reference's."""

    policy: str
    environment: str
    options: PlayOptions
    margin: float
    #: what played as the reference, and its episodes
    reference: str
    episodes: Episodes
    played: tuple[PlayedArtifact, ...]
    replay: ParityReport
    #: steps that were recorded and fed to everything
    recorded: int
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<PlayReport {self.sentence}>"

    @property
    def passed(self) -> bool | None:
        """Whether all agree in the replay and are EQUIVALENT; None where something was not decided."""
        verdicts = [p.compared.verdict for p in self.played]
        if self.replay.passed is False or DIFFERENT in verdicts:
            return False
        return None if NOT_DECIDED in verdicts or not verdicts or self.replay.passed is None else True

    @property
    def undecided(self) -> tuple[PlayedArtifact, ...]:
        """What more episodes would decide."""
        return tuple(p for p in self.played if p.compared.verdict == NOT_DECIDED)

    @property
    def verdict(self) -> str:
        """The word for all of it."""
        return {True: EQUIVALENT, False: DIFFERENT, None: NOT_DECIDED}[self.passed]

    @property
    def sentence(self) -> str:
        """The verdict with its reason."""
        where = f"{self.policy} in {self.environment}"
        others = [p for p in self.played if p.compared.verdict == DIFFERENT]
        parts = []
        if self.replay.passed is False:
            failed = dict.fromkeys(c.where for c in self.replay.failures)
            parts.append(f"in the replay of recorded states {len(failed)} differ ({', '.join(failed)})")
        if others:
            parts.append(f"{len(others)} of {len(self.played)} earn another return ({_names(others)})")
        if not parts and self.undecided:
            parts.append(f"{len(self.undecided)} of {len(self.played)} need more episodes ({_names(self.undecided)})")
        if not parts:
            count = len(self.played)
            parts.append(
                f"{count} of {count} agree in {self.recorded} recorded steps and earn what {self.reference} does, "
                f"{figure(self.episodes.returns.mean())} ± {figure(self.margin)} in {self.options.episodes} episodes"
                if self.passed
                else "nothing played"
            )
        return f"{where}: {self.verdict}, {'; '.join(parts)}"

    @property
    def record(self) -> PlayRecord:
        """What parity.json keeps of it."""
        options, own = self.options, self.episodes
        return PlayRecord(
            environment=self.environment,
            verdict=self.verdict,
            sentence=self.sentence,
            seed=options.seed,
            deterministic=options.deterministic,
            asked=options.margin,
            margin=self.margin,
            reference=Player(self.reference, mean_interval(own.returns), len(own.returns)),
            players=tuple(_player(p) for p in self.played),
        )

    def lines(self) -> Iterator[str]:
        """A table of everything that played, then what is wrong or open."""
        replayed = {(p.format, p.runtime): p.word for p in self.replay.pairs}
        difference = f"difference ({CONFIDENCE:.0%} interval)"
        head = ("player", "replay", "mean return", difference, "equal", "per second", "verdict")
        own, rows = self.episodes, []
        rows.append([self.reference, "", figure(own.returns.mean()), "", "", f"{own.rate:,.0f}", "reference"])
        for p in self.played:
            c = p.compared
            word = replayed.get((p.format, p.runtime), "-")
            interval = f"{signed_text(c.difference)} ({signed_text(c.low)} to {signed_text(c.high)})"
            equal = f"{c.equal} of {c.episodes}"
            mean, rate = figure(p.episodes.returns.mean()), f"{p.episodes.rate:,.0f}"
            rows.append([p.where, word, mean, interval, equal, rate, c.verdict])
        playing = {(p.format, p.runtime) for p in self.played}
        kept = {"weights", "source"}  # no artefacts: what rounding changed, and an original that died
        silent = [p for p in self.replay.pairs if (p.format, p.runtime) not in playing and p.format not in kept]
        rows += [[f"{p.format} in {p.runtime}", p.word, "", "", "", "", "did not play"] for p in silent]
        yield from table(head, rows).splitlines()
        for finding in self.replay.failures:
            yield from finding.explanation()
        yield from (f"{p.where}: {p.sentence}" for p in self.played if p.sentence)

    def to_dict(self) -> dict[str, Any]:
        """The content of play.json (play.schema.json)."""
        return {
            "schema": 1,
            "policy": self.policy,
            "environment": self.environment,
            "passed": self.passed,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "episodes": self.options.episodes,
            "seed": self.options.seed,
            "deterministic": self.options.deterministic,
            "most": self.options.most,
            "confidence": CONFIDENCE,
            "margin": {
                "asked": self.options.margin,
                "value": self.margin,
                "scale": scale_of(self.episodes.returns),
            },
            "reference": {"name": self.reference, "recorded_steps": self.recorded, **_summary(self.episodes)},
            "played": [_entry(p) for p in self.played],
            "replay": self.replay.to_dict(),
            "notes": list(self.notes),
        }


def _player(played: PlayedArtifact) -> Player:
    compared, returns = played.compared, played.episodes.returns
    difference = Interval(compared.difference, compared.low, compared.high)
    mean = mean_interval(returns)
    return Player(played.where, mean, len(returns), compared.verdict, difference, played.sentence)


def _entry(played: PlayedArtifact) -> dict[str, Any]:
    c = played.compared
    return {
        "format": played.format,
        "runtime": played.runtime,
        "verdict": c.verdict,
        "difference": c.difference,
        "interval": [c.low, c.high],
        "deviation": c.deviation,
        "equal_episodes": c.equal,
        "episodes_needed": c.needed,
        "episodes": c.episodes,
        "reference_mean_return": float(played.reference.returns.mean()),
        **_summary(played.episodes),
    }


def _summary(episodes: Episodes) -> dict[str, Any]:
    return {
        "mean_return": float(episodes.returns.mean()),
        "mean_length": float(episodes.lengths.mean()),
        "success_rate": float(episodes.success.mean()),
        "decisions_per_second": round(episodes.rate, 1),
        "returns": [float(r) for r in episodes.returns],
        "lengths": [int(n) for n in episodes.lengths],
    }


def _names(played: tuple[PlayedArtifact, ...] | list[PlayedArtifact]) -> str:
    return ", ".join(f"{p.format} in {p.runtime}" for p in played)


def figure(value: float | np.floating[Any]) -> str:
    """Return a number with four digits."""
    return f"{float(value):.4g}"


def signed_text(value: float) -> str:
    """Return a difference with its sign; 0 has none."""
    return "0" if value == 0 else f"{value:+.3g}"
