"""Where two files state the interface of one policy otherwise."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

from export_model.converters.interfaces.merge import TERM_FIELDS, equal_values
from export_model.signatures.interface import Interface, Quantity, Term

_QUANTITY_FIELDS = ("values", "clip", "elements", "unit")
#: What a field's numbers belong to, where there is one for each.
_OF_ELEMENTS = ("elements", "scale", "offset", "clip", "values")


def interface_differences(ours: Interface, theirs: Interface, inputs: Mapping[str, str]) -> Iterator[str]:
    """Yield a sentence for each field that both state and that differs; ``inputs``: name in ``ours`` → in ``theirs``.

    Terms are paired by their order, as their names are each project's own; numbers are equal as exporters round them.
    """
    observed = ((ours.observations.get(n, ()), theirs.observations.get(o, ())) for n, o in inputs.items())
    actions = tuple((*side.actions, *side.baked) for side in (ours, theirs))
    for first, second in chain(observed, [actions]):
        if first and second and len(first) == len(second):
            for a, b in zip(first, second, strict=True):
                yield from _fields(a, b, TERM_FIELDS)
    for mine, other in ((ours.quantities, theirs.quantities), (ours.limits, theirs.limits)):
        named = {q.name: q for q in other}
        for quantity in mine:
            if quantity.name in named:
                yield from _fields(quantity, named[quantity.name], _QUANTITY_FIELDS)
    periods = ours.period, theirs.period
    if periods[0] and periods[1] and abs(periods[0].seconds - periods[1].seconds) > 1e-6:
        yield _sentence("the control period", periods[1].seconds, periods[0].seconds, periods[1].source)


def _fields(ours: Term | Quantity, theirs: Term | Quantity, names: Iterable[str]) -> Iterator[str]:
    for name in names:
        mine, other = getattr(ours, name), getattr(theirs, name)
        if mine in (None, ()) or other in (None, ()) or equal_values(mine, other):
            continue
        places = _places(mine, other) if name in _OF_ELEMENTS else []
        for i in places[:3]:
            whose = f" ({ours.elements[i]})" if len(ours.elements) > i and name != "elements" else ""
            yield _sentence(f"{name}[{i}] of {ours.name}{whose}", other[i], mine[i], theirs.source)
        if not places:
            yield _sentence(f"{name} of {ours.name}", other, mine, theirs.source)


def _places(mine: Sequence[Any], other: Sequence[Any]) -> list[int]:
    """Where two lists of one length differ."""
    if len(mine) != len(other):
        return []
    return [i for i, pair in enumerate(zip(mine, other, strict=True)) if not equal_values(*pair)]


def _sentence(what: str, theirs: object, ours: object, source: str) -> str:
    return f"{what} is {theirs!r} ({source}), the reference's {ours!r}"[:600]
