"""The interface of a policy: what its numbers mean beside their order, as far as a source states it.

- An observation's term is fed as ``clip(value - offset) * scale``, as Isaac Lab's and mjlab's observation managers
  compute it (clip, then scale).
- An action's term is applied as ``clip(action * scale + offset)``, as their action terms do.

Nothing is derived that no source states; each entry says which file and key it is from. What is ``baked`` is computed
by the graph already, and stands nowhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from msgspec import Struct, field

from signatures.fields import Field, without_none

#: Bounds of a contract's interface: terms in all, numbers of one list, characters of metadata.
MAX_TERMS, MAX_VALUES, MAX_METADATA_CHARACTERS = 4096, 1 << 16, 1 << 18
#: Text of a key that is not understood, in characters; what is longer is cut there.
MAX_KEPT_CHARACTERS = 1000
MAX_NAME_CHARACTERS = 120

#: Lowest and highest value; None: not bounded.
Range = tuple[float | None, float | None]


class Term(Struct, frozen=True):
    """Numbers that stand side by side in an observation or an action.

    ``size`` counts those of one frame, ``history`` the frames (1: the present alone); None where no source says it.
    ``scale``, ``offset`` and ``clip`` have one entry for all numbers, or one for each; none: nothing is stated.
    ``source`` is the file and the key.
    """

    name: str
    source: str
    size: int | None = None
    elements: tuple[str, ...] = ()
    unit: str | None = None
    scale: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()
    clip: tuple[Range, ...] = ()
    history: int | None = None

    @property
    def width(self) -> int | None:
        """Numbers that it takes in the tensor, all frames; None where that is not stated."""
        return None if self.size is None else self.size * (self.history or 1)

    @property
    def changes(self) -> bool:
        """Whether the caller has something to compute."""
        return bool(self.scale or self.offset or self.clip)

    def to_dict(self) -> dict[str, Any]:
        """As in policy.json."""
        return without_none(
            name=self.name,
            size=self.size,
            elements=list(self.elements) or None,
            unit=self.unit,
            scale=list(self.scale) or None,
            offset=list(self.offset) or None,
            clip=[list(pair) for pair in self.clip] or None,
            history=self.history,
            **{"from": self.source},
        )


class Quantity(Struct, frozen=True):
    """Numbers beside inputs and outputs that a caller needs: gains, a default pose; with ``clip``, limits."""

    name: str
    source: str
    values: tuple[float, ...] = ()
    clip: tuple[Range, ...] = ()
    elements: tuple[str, ...] = ()
    unit: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """As in policy.json."""
        return without_none(
            name=self.name,
            values=list(self.values) or None,
            clip=[list(pair) for pair in self.clip] or None,
            elements=list(self.elements) or None,
            unit=self.unit,
            **{"from": self.source},
        )


class Statement(Struct, frozen=True):
    """A sentence, or a key's text, and the file and key that it is from."""

    text: str
    source: str

    def to_dict(self) -> dict[str, Any]:
        """As in policy.json."""
        return {"text": self.text, "from": self.source}


class Interface(Struct, frozen=True):
    """What sources state of a policy's inputs and outputs, and of its control loop.

    - ``observations``: input → its terms, in order; ``actions``: the terms of the continuous action.
    - ``baked``: the actions' terms whose scale, offset and clip the graph applies; ``actions`` lacks them then.
    - ``period``: seconds from one decision to the next, and where that is stated.
    - ``resets``: what makes an episode begin, or what the memory starts from.
    - ``limits``, ``quantities``: limits and other numbers that a caller needs.
    - ``kept``: keys that are not understood, as text. ``metadata``: a model's own, unchanged.
    """

    observations: Mapping[str, tuple[Term, ...]] = field(default_factory=dict)
    actions: tuple[Term, ...] = ()
    baked: tuple[Term, ...] = ()
    period: tuple[float, str] | None = None
    resets: tuple[Statement, ...] = ()
    limits: tuple[Quantity, ...] = ()
    quantities: tuple[Quantity, ...] = ()
    kept: tuple[Statement, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)

    def __bool__(self) -> bool:
        """Whether anything is stated."""
        return self.to_dict() != {}

    def to_dict(self) -> dict[str, Any]:
        """As in policy.json, without what is empty."""
        return without_none(
            observations={n: _dicts(terms) for n, terms in self.observations.items() if terms} or None,
            actions=_dicts(self.actions) or None,
            baked=_dicts(self.baked) or None,
            period=None if self.period is None else {"seconds": self.period[0], "from": self.period[1]},
            resets=_dicts(self.resets) or None,
            limits=_dicts(self.limits) or None,
            quantities=_dicts(self.quantities) or None,
            kept=_dicts(self.kept) or None,
            metadata=dict(self.metadata) or None,
        )


def _dicts(entries: Iterable[Term | Quantity | Statement]) -> list[dict[str, Any]]:
    return [entry.to_dict() for entry in entries]


# ------------------------------------------------------------------ reading


def parse_interface(whole: Field, inputs: Sequence[str]) -> Interface | None:
    """The interface in a contract, None where it is missing. Raises FieldError that names the field."""
    if whole.missing:
        return None
    observations = whole["observations"].members()
    unknown = sorted(observations.keys() - set(inputs))
    if unknown:
        raise whole["observations"].error(f"names {unknown[0][:80]!r}, which is not an input")
    period = whole["period"]
    seconds = None if period.missing else float(period["seconds"].number())
    if seconds is not None and seconds <= 0:
        raise period["seconds"].error("must be above 0")
    return Interface(
        observations={name: _entries(terms, _term) for name, terms in observations.items()},
        actions=_entries(whole["actions"], _term),
        baked=_entries(whole["baked"], _term),
        period=None if seconds is None else (seconds, period["from"].text()),
        resets=_entries(whole["resets"], _statement),
        limits=_entries(whole["limits"], _quantity),
        quantities=_entries(whole["quantities"], _quantity),
        kept=_entries(whole["kept"], _statement),
        metadata=_metadata(whole["metadata"]),
    )


def _entries(entries: Field, make: Callable[[Field], Any]) -> tuple[Any, ...]:
    return tuple(make(entry) for entry in entries.items(MAX_TERMS))


def _term(entry: Field) -> Term:
    size, history = entry["size"], entry["history"]
    found = Term(
        name=entry["name"].text(),
        source=entry["from"].text(),
        size=None if size.missing else size.integer(1, 1 << 24),
        elements=tuple(e.text() for e in entry["elements"].items(MAX_VALUES)),
        unit=None if entry["unit"].missing else entry["unit"].text(),
        scale=_numbers(entry["scale"]),
        offset=_numbers(entry["offset"]),
        clip=_ranges(entry["clip"]),
        history=None if history.missing else history.integer(1, 1 << 16),
    )
    for key in ("elements", "scale", "offset", "clip"):
        count = len(getattr(found, key))
        if count > 1 and found.size is not None and count != found.size:
            raise entry[key].error(f"has {count} entries, and the term {found.size} numbers")
    return found


def _quantity(entry: Field) -> Quantity:
    return Quantity(
        entry["name"].text(),
        entry["from"].text(),
        _numbers(entry["values"]),
        _ranges(entry["clip"]),
        tuple(e.text() for e in entry["elements"].items(MAX_VALUES)),
        None if entry["unit"].missing else entry["unit"].text(),
    )


def _statement(entry: Field) -> Statement:
    return Statement(entry["text"].text(blank=True), entry["from"].text())


def _numbers(entry: Field) -> tuple[float, ...]:
    return tuple(float(number.number()) for number in entry.items(MAX_VALUES))


def _ranges(entry: Field) -> tuple[Range, ...]:
    return tuple(_range(pair) for pair in entry.items(MAX_VALUES))


def _range(entry: Field) -> Range:
    pair = entry.items(2)
    if len(pair) != 2:
        raise entry.error("must be a lowest and a highest value")
    low, high = (None if end.missing else float(end.number()) for end in pair)
    if low is not None and high is not None and low > high:
        raise entry.error("does not go up")
    return low, high


def _metadata(entry: Field) -> dict[str, str]:
    found: dict[str, str] = {}
    left = MAX_METADATA_CHARACTERS
    for key, value in (entry.value or {}).items() if isinstance(entry.value, dict | None) else [("", None)]:
        if not isinstance(value, str) or any("\ud800" <= c <= "\udfff" for c in key + value):
            raise entry.error("must be texts by their keys")
        left -= len(key) + len(value)
        found[key] = value
    if left < 0:
        raise entry.error(f"has more than {MAX_METADATA_CHARACTERS} characters")
    return found
