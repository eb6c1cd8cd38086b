"""What a policy's files earned when they played an environment, as parity.json keeps it.

``export-model play BUNDLE`` and ``export --env`` write it; ``verify``, the reports and the card show it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec import Struct

from converters.files.fetch import read_bytes
from signatures.contract import PARITY, json_of
from signatures.errors import BundleError
from signatures.fields import Field, FieldError

EQUIVALENT, DIFFERENT, NOT_DECIDED = "EQUIVALENT", "DIFFERENT", "NOT DECIDED"
VERDICTS = (EQUIVALENT, DIFFERENT, NOT_DECIDED)
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


def read_plays(folder: Path) -> tuple[PlayRecord, ...]:
    """Return what the parity.json of a bundle says of playing; nothing without one. Raises BundleError."""
    file = folder / PARITY
    if not file.is_file():
        return ()
    try:
        whole = Field(json_of(read_bytes(file, most=_MOST_BYTES)))
        return tuple(_record(entry) for entry in whole["played"].items(_MOST_RECORDS))
    except FieldError as error:
        raise BundleError(
            f"cannot be read: {error}", where=str(file), fix="export the bundle again, or delete the file"
        ) from error


def _record(entry: Field) -> PlayRecord:
    margin = entry["margin"]
    return PlayRecord(
        environment=entry["environment"].text(),
        verdict=entry["verdict"].one_of(VERDICTS),
        sentence=entry["sentence"].text(),
        seed=entry["seed"].integer(0),
        deterministic=entry["deterministic"].truth(),
        asked=margin["asked"].text(),
        margin=float(margin["value"].number()),
        reference=_read_player(entry["reference"]),
        players=tuple(_read_compared(p) for p in entry["players"].items(10_000)),
    )


def _read_compared(entry: Field) -> Player:
    own = _read_player(entry)
    return Player(
        own.name,
        own.returns,
        own.episodes,
        entry["verdict"].one_of(VERDICTS),
        _interval(entry["difference"], entry["interval"]),
        entry["sentence"].text(blank=True),
    )


def _read_player(entry: Field) -> Player:
    mean = _interval(entry["mean_return"], entry["return_interval"])
    return Player(entry["name"].text(), mean, entry["episodes"].integer(1))


def _interval(mean: Field, ends: Field) -> Interval:
    numbers = [float(end.number()) for end in ends.items(2)]
    if len(numbers) != 2:
        raise ends.error("must be two numbers")
    return Interval(float(mean.number()), *numbers)
