"""An interface in words, for terminals, pages, comments of code and cards."""

from __future__ import annotations

from collections.abc import Sequence

from export_model.signatures.fields import printable
from export_model.signatures.interface import Interface, Quantity, Range, Statement, Term
from export_model.signatures.spec import PolicySignature

#: Entries of a list that are shown, where not all are.
FEW, ALL = 6, 1 << 20
#: Keys that are listed in words.
MOST_KEPT = 12
#: Columns of the tables of terms.
HEAD = ("term", "numbers", "unit", "{}", "stated in")


def numbers_text(values: Sequence[float], most: int = FEW) -> str:
    """``0.25``, where all are equal, else ``[0.5, 0.25, ... 27 more]``."""
    if len(set(values)) == 1:
        return f"{values[0]:.6g}"
    shown = [f"{v:.6g}" for v in values[:most]]
    more = len(values) - len(shown)
    return f"[{', '.join(shown)}{f', ... {more} more' if more else ''}]"


def ranges_text(ranges: Sequence[Range], most: int = FEW) -> str:
    """``-1 to 1``, where all are equal, else a list of them."""
    texts = [f"{_end(low, '-inf')} to {_end(high, 'inf')}" for low, high in ranges]
    if len(set(texts)) == 1:
        return texts[0]
    more = len(texts) - most
    return f"[{', '.join(texts[:most])}{f', ... {more} more' if more > 0 else ''}]"


def _end(value: float | None, open_end: str) -> str:
    return open_end if value is None else f"{value:.6g}"


def formula(term: Term, *, acted: bool, most: int = FEW) -> str:
    """What a caller computes: ``clip(value - offset) * scale`` of an observation, ``action * scale + offset``."""
    if not term.changes:
        return ""
    scale = f" * {numbers_text(term.scale, most)}" if term.scale else ""
    clip = f", within {ranges_text(term.clip, most)}" if term.clip else ""
    if acted:
        offset = f" + {numbers_text(term.offset, most)}" if term.offset else ""
        return f"action{scale}{offset}{clip}"
    inner = f"value - {numbers_text(term.offset, most)}" if term.offset else "value"
    return f"({inner}{clip}){scale}" if (clip or term.offset) and scale else f"{inner}{clip}{scale}"


def rows(terms: Sequence[Term], *, acted: bool, most: int = FEW) -> list[list[str]]:
    """A row of ``HEAD`` for each term."""
    return [
        [
            printable(term.name),
            _count(term, most),
            term.unit or "",
            formula(term, acted=acted, most=most),
            printable(term.source),
        ]
        for term in terms
    ]


def _count(term: Term, most: int) -> str:
    names = ", ".join(term.elements[:most]) + (", ..." if len(term.elements) > most else "") if most else ""
    size = "" if term.size is None else str(term.size)
    frames = f" * {term.history} frames" if (term.history or 1) > 1 else ""
    return f"{size}{frames}{f' ({names})' if names else ''}".strip()


def tables(signature: PolicySignature, most: int = FEW) -> list[tuple[str, tuple[str, ...], list[list[str]]]]:
    """(tensor, head, rows) of each observation's terms and of the action's."""
    interface = signature.interface
    if interface is None:
        return []
    observed = (*HEAD[:3], "feed", HEAD[4])
    found: list[tuple[str, tuple[str, ...], list[list[str]]]] = [
        (name, observed, rows(terms, acted=False, most=most)) for name, terms in interface.observations.items()
    ]
    head = next((h.name for h in signature.heads if h.is_continuous), "action")
    if interface.actions and (any(t.changes for t in interface.actions) or not interface.baked):
        found.append((head, (*HEAD[:3], "apply", HEAD[4]), rows(interface.actions, acted=True, most=most)))
    if interface.baked:
        found.append((head, (*HEAD[:3], "in the graph already", HEAD[4]), rows(interface.baked, acted=True, most=most)))
    return found


def term_lines(signature: PolicySignature, name: str) -> list[str]:
    """Lines of a comment on an observation or the action ``name``, with all numbers."""
    interface = signature.interface
    if interface is None:
        return []
    if name in interface.observations:
        return [_line(t, "feed", acted=False) for t in interface.observations[name]]
    head = next((h for h in signature.heads if h.is_continuous), None)
    if head is None or name not in (head.name, None if head.plain is None else head.plain.name):
        return []
    lines = [_line(t, "in the graph already, apply nothing:", acted=True) for t in interface.baked]
    return lines or [_line(t, "apply", acted=True) for t in interface.actions]


def _line(term: Term, verb: str, *, acted: bool) -> str:
    words = [w for w in (_count(term, 0), term.unit or "") if w]
    what = formula(term, acted=acted, most=ALL)
    size = f" ({', '.join(words)})" if words else ""
    return printable(f"{term.name}{size}{f': {verb} {what}' if what else ''}")


def loop_lines(interface: Interface | None, most: int = FEW) -> list[str]:
    """Sentences on the control loop: its rate, what ends an episode, limits, other numbers."""
    if interface is None:
        return []
    lines = []
    if interface.period is not None:
        seconds, source = interface.period.seconds, interface.period.source
        lines.append(f"a decision every {seconds:.6g} s ({1 / seconds:.6g} a second; {printable(source)})")
    lines += [f"{_statement_text(s)} ({printable(s.source)})" for s in interface.resets]
    lines += [f"limit of {_quantity(q, most)}" for q in interface.limits]
    lines += [_quantity(q, most) for q in interface.quantities]
    return lines


def _statement_text(statement: Statement) -> str:
    return printable(statement.text)


def _quantity(quantity: Quantity, most: int) -> str:
    values = numbers_text(quantity.values, most) if quantity.values else ""
    limits = ranges_text(quantity.clip, most) if quantity.clip else ""
    names = ", ".join(quantity.elements[:most]) + (", ..." if len(quantity.elements) > most else "")
    unit = f" {quantity.unit}" if quantity.unit else ""
    text = f"{quantity.name}: {values}{limits}{unit}" if values or limits else f"{quantity.name}: {names}"
    of = f" of {names}" if names and (values or limits) else ""
    return printable(f"{text}{of} ({quantity.source})")


def kept_text(interface: Interface | None) -> str:
    """The keys that are not understood, by their places."""
    places = [] if interface is None else [printable(s.source) for s in interface.kept]
    more = f" and {len(places) - MOST_KEPT} more (--json has all)" if len(places) > MOST_KEPT else ""
    return ", ".join(places[:MOST_KEPT]) + more
