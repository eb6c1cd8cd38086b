"""What a policy's files earned when they played an environment, as parity.json keeps it.

``export-model play BUNDLE`` and ``export --env`` write it; ``verify``, the reports and the card show it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, Struct

from export_model.converters.files.fetch import read_bytes
from export_model.signatures.contract import PARITY, json_of
from export_model.signatures.errors import BundleError
from export_model.signatures.fields import Blank, Count, FieldError, Real, Text, one_of, read

EQUIVALENT, DIFFERENT, NOT_DECIDED = "EQUIVALENT", "DIFFERENT", "NOT DECIDED"
VERDICTS = (EQUIVALENT, DIFFERENT, NOT_DECIDED)
_Verdict = Annotated[str, one_of(VERDICTS)]
#: Of every interval that is kept.
CONFIDENCE = 0.95
#: One parity.json, and the environments in it.
_MOST_BYTES, _MOST_RECORDS = 16 << 20, 100


class Interval(Struct, frozen=True):
    """A mean with the interval that it lies in at CONFIDENCE."""

    mean: float
    low: float
    high: float

    @property
    def words(self) -> str:
        """``9.31 (9.12 to 9.5)``."""
        return f"{self.mean:.4g} ({self.low:.4g} to {self.high:.4g})"


class Player(Struct, frozen=True):
    """One file in one runtime, or the reference: what it earned in so many episodes."""

    name: str
    returns: Interval
    episodes: int
    #: of the reference there is none
    verdict: str = ""
    difference: Interval | None = None
    #: what is wrong or open; empty where it is equivalent
    sentence: str = ""

    @property
    def difference_words(self) -> str:
        """``+0.01 (-0.1 to 0.12)``; empty for the reference."""
        return "" if self.difference is None else self.difference.words

    @property
    def place(self) -> str:
        """``onnx.onnxruntime``."""
        return self.name.replace(" in ", ".")


class PlayRecord(Struct, frozen=True, kw_only=True):
    """All that played one environment."""

    environment: str
    verdict: str
    sentence: str
    seed: int
    deterministic: bool
    #: the margin as it was asked for, and in the unit of returns
    asked: str
    margin: float
    reference: Player
    players: tuple[Player, ...]

    @property
    def rows(self) -> tuple[Player, ...]:
        """The reference, then the others."""
        return (self.reference, *self.players)

    def to_dict(self) -> dict[str, Any]:
        """As in parity.json."""
        return {
            "environment": self.environment,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "seed": self.seed,
            "deterministic": self.deterministic,
            "confidence": CONFIDENCE,
            "margin": {"asked": self.asked, "value": self.margin},
            "reference": _player(self.reference),
            "players": [
                {
                    **_player(p),
                    "verdict": p.verdict,
                    "difference": 0.0 if p.difference is None else p.difference.mean,
                    "interval": [] if p.difference is None else [p.difference.low, p.difference.high],
                    "sentence": p.sentence,
                }
                for p in self.players
            ],
        }


def _player(player: Player) -> dict[str, Any]:
    own = player.returns
    return {
        "name": player.name,
        "episodes": player.episodes,
        "mean_return": own.mean,
        "return_interval": [own.low, own.high],
    }


class _Margin(Struct, frozen=True):
    asked: Text
    value: Real


class _Own(Struct, frozen=True):
    name: Text
    episodes: Annotated[int, Meta(ge=1, le=2**63 - 1)]
    mean_return: Real
    return_interval: tuple[Real, Real]

    @property
    def returns(self) -> Interval:
        return Interval(self.mean_return, *self.return_interval)


class _Compared(_Own, frozen=True):
    verdict: _Verdict
    difference: Real
    interval: tuple[Real, Real]
    sentence: Blank

    @property
    def player(self) -> Player:
        difference = Interval(self.difference, *self.interval)
        return Player(self.name, self.returns, self.episodes, self.verdict, difference, self.sentence)


class _Kept(Struct, frozen=True):
    """A record as parity.json has it."""

    environment: Text
    verdict: _Verdict
    sentence: Text
    seed: Count
    margin: _Margin
    reference: _Own
    players: Annotated[tuple[_Compared, ...], Meta(max_length=10_000)] = ()
    deterministic: bool = False


class _Report(Struct, frozen=True):
    played: Annotated[tuple[_Kept, ...], Meta(max_length=_MOST_RECORDS)] = ()


def read_plays(folder: Path) -> tuple[PlayRecord, ...]:
    """Return what the parity.json of a bundle says of playing; nothing without one. Raises BundleError."""
    file = folder / PARITY
    if not file.is_file():
        return ()
    try:
        report: _Report = read(json_of(read_bytes(file, most=_MOST_BYTES)), _Report)
    except FieldError as error:
        raise BundleError(
            f"cannot be read: {error}", where=str(file), fix="export the bundle again, or delete the file"
        ) from error
    return tuple(
        PlayRecord(
            environment=kept.environment,
            verdict=kept.verdict,
            sentence=kept.sentence,
            seed=kept.seed,
            deterministic=kept.deterministic,
            asked=kept.margin.asked,
            margin=kept.margin.value,
            reference=Player(kept.reference.name, kept.reference.returns, kept.reference.episodes),
            players=tuple(compared.player for compared in kept.players),
        )
        for kept in report.played
    )
