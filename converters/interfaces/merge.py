"""Several sources of one interface as one: the first that states something is believed, and contradictions are said."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from msgspec.structs import replace

from export_model.signatures.interface import Interface, Quantity, Term

#: Numbers that are equal as exporters round them (mjlab: three decimals).
_ROUNDED = 5.1e-4
#: Fields of a term that state something.
TERM_FIELDS = ("size", "elements", "unit", "scale", "offset", "clip", "history")


def merge(first: Interface, second: Interface) -> tuple[Interface, tuple[str, ...]]:
    """Return ``first`` with what only ``second`` states, and a note for each field in which they differ."""
    notes: list[str] = []
    observations = dict(first.observations)
    for name, terms in second.observations.items():
        observations[name] = _terms(observations.get(name, ()), terms, notes)
    if first.period and second.period and abs(first.period.seconds - second.period.seconds) > 1e-6:
        notes.append(_difference("the control period", first.period.source, second.period.source))
    other = [
        key for key in first.metadata.keys() & second.metadata.keys() if first.metadata[key] != second.metadata[key]
    ]
    notes += [
        f"metadata {key[:80]} is kept as the model has it; what is beside says otherwise" for key in sorted(other)
    ]
    merged = Interface(
        observations=observations,
        actions=_terms(first.actions, second.actions, notes),
        baked=(*first.baked, *second.baked),
        period=first.period or second.period,
        resets=(*first.resets, *second.resets),
        limits=_quantities(first.limits, second.limits),
        quantities=_quantities(first.quantities, second.quantities),
        kept=(*first.kept, *second.kept),
        metadata={**second.metadata, **first.metadata},
    )
    return merged, tuple(notes)


def _terms(first: Sequence[Term], second: Sequence[Term], notes: list[str]) -> tuple[Term, ...]:
    """The terms of the first, filled from those of the second where they are the same ones."""
    if not first or not second:
        return tuple(first or second)
    same = len(first) == len(second) and (len(first) == 1 or [t.name for t in first] == [t.name for t in second])
    if not same:
        notes.append(_difference("other terms", first[0].source, second[0].source))
        return tuple(first)
    return tuple(_fill(a, b, notes) for a, b in zip(first, second, strict=True))


def _fill(a: Term, b: Term, notes: list[str]) -> Term:
    taken: dict[str, Any] = {}
    for name in TERM_FIELDS:
        mine, theirs = getattr(a, name), getattr(b, name)
        if mine in (None, ()) and theirs not in (None, ()):
            size = taken.get("size", a.size)
            if not isinstance(theirs, tuple) or size is None or len(theirs) in (1, size):
                taken[name] = theirs
        elif theirs not in (None, ()) and not equal_values(mine, theirs):
            notes.append(_difference(f"{name} of {a.name}", a.source, b.source))
    return replace(a, **taken, source=f"{a.source}; {b.source}"[:600]) if taken else a


def equal_values(a: Any, b: Any) -> bool:
    """Whether two values of a field are one as exporters round them; one number stands for a list of it."""
    if isinstance(a, tuple) and isinstance(b, tuple):
        if len(a) == 1 < len(b):
            a = a * len(b)
        if len(b) == 1 < len(a):
            b = b * len(a)
        return len(a) == len(b) and all(map(equal_values, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= _ROUNDED
    return bool(a == b)


def _quantities(first: Iterable[Quantity], second: Iterable[Quantity]) -> tuple[Quantity, ...]:
    named = {q.name: q for q in first}
    return (*named.values(), *(q for q in second if q.name not in named))


def _difference(what: str, first: str, second: str) -> str:
    return f"{first} and {second} differ in {what}; the first is believed"[:1000]
