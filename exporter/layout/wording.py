"""What was told of a layout, for the terminal."""

from __future__ import annotations

from export_model.exporter.layout.ranking import LayoutClass
from export_model.exporter.layout.telling import (
    AGREES,
    DECIDED,
    DISAGREES,
    Told,
    closed_facts,
    decided_facts,
    open_facts,
)
from export_model.exporter.tables import paragraph, table

#: Classes that are shown, and members of each that are named.
_MOST_CLASSES, _MOST_MEMBERS = 5, 4


def layout_text(told: Told) -> str:
    """The classes, what is decided, what is open and why; what is stated is judged in the last line."""
    ranking = told.ranking
    lines = []
    if ranking.classes:
        rows = [_row(c) for c in ranking.classes[:_MOST_CLASSES]]
        rows.append(["orders of the joints by chance", "", "", f"{ranking.chance:.2f}"])
        more = len(ranking.classes) - _MOST_CLASSES
        lines += [table(("robot and joint order", "terms of", "frames", "score"), rows), ""]
        lines += [f"and {more} more (--json has all)", ""] if more > 0 else []
        lines.append("score: 0 symmetric, 1 unrelated; layouts that mirror alike are one row")
    facts = "; ".join(f"{what}: {said}" for what, said in decided_facts(told).items())
    if facts:
        lines.append(paragraph(facts, "decided: ", "  "))
    lines += [paragraph(f"{fact['term']} ({fact['says']})", "by its evidence: ", "  ") for fact in closed_facts(told)]
    for fact in open_facts(told):
        members = f": {', '.join(fact['members'])}" if fact["members"] else ""
        says = f" ({'; '.join(fact['evidence'])})" if fact["evidence"] else ""
        lines.append(paragraph(f"{fact['what']}{members}{says}", "open: ", "  "))
    if told.layout is None and told.stated is None:
        lines.append(paragraph(ranking.why_open, "not decided: ", "  "))
    return "\n".join(lines)


def _row(found: LayoutClass) -> list[str]:
    robots = found.says("robot")
    more = f" and {len(robots) - _MOST_MEMBERS} more" if len(robots) > _MOST_MEMBERS else ""
    return [
        f"{', '.join(robots[:_MOST_MEMBERS])}{more}: {'; '.join(found.says('order name'))}",
        "; ".join(found.says("project")),
        "; ".join(found.says("stacking")),
        f"{found.score:.2f}",
    ]


def verdict_text(told: Told) -> str:
    """One sentence."""
    stated, best = told.stated, told.ranking.best
    if stated is None:
        assert best is not None or told.verdict != DECIDED
        return f"decided ({best.score:.2f}; next {told.ranking.next:.2f})" if best and told.layout else "not decided"
    where = f"what {stated.source} states"
    if stated.verdict == AGREES:
        return f"{where} agrees ({stated.score:.2f}; best other {stated.next:.2f})"
    if stated.verdict == DISAGREES:
        return f"{where} does not fit: {stated.says}"
    says = f"; {stated.says}" if stated.says else ""
    return f"{where} is neither confirmed nor refuted ({stated.score:.2f}; best other {stated.next:.2f}){says}"
