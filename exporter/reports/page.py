"""One self-contained HTML page: no scripts, no fonts, nothing fetched. Light and dark follow the reader's system."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from exporter.reports import sections
from exporter.reports.entry import Entry
from exporter.reports.markup import Markup, el
from exporter.reports.summary import verdict
from exporter.version import __version__

_CHIPS = {
    "passed": ("passed", "Passed"),
    "self-consistent": ("passed", "Self-consistent"),
    "failed": ("failed", "Failed"),
    "not verified": ("unverified", "Not verified"),
}
#: In the order of the page; each gives nothing where it has nothing to say.
_SECTIONS: tuple[Callable[[Entry], Markup | None], ...] = (
    sections.failures,
    sections.agreement,
    sections.spread,
    sections.memory,
    sections.policy_graph,
    sections.tensors,
    sections.worst_inputs,
    sections.tolerances,
    sections.runtimes,
    sections.files,
    sections.notes,
)


def page(entries: Sequence[Entry]) -> str:
    """The document for one or more policies."""
    ordered = sorted(entries, key=lambda e: (e.report.passed is not False, e.report.passed is not None))
    alone = len(ordered) == 1
    eyebrow = el("h1" if alone else "p", "export-model · parity report", class_="eyebrow")
    title = f"{ordered[0].name}: parity report" if alone else f"Parity report on {len(ordered)} policies"
    head = el(
        "head",
        el("meta", charset="utf-8"),
        el("meta", name="viewport", content="width=device-width, initial-scale=1"),
        el("meta", name="color-scheme", content="light dark"),
        el("title", title),
        el("style", Markup((Path(__file__).parent / "page.css").read_text(encoding="utf-8"))),
    )
    body = el(
        "body",
        el("header", eyebrow, None if alone else el("h1", title), None if alone else _overview(ordered)),
        el("main", [_policy(e, number, alone=alone) for number, e in enumerate(ordered, 1)]),
        el("footer", f"Written by export-model {__version__}. parity.json in the bundle holds the same as data."),
    )
    return f"<!DOCTYPE html>\n{el('html', head, body, lang='en')}\n"


def _overview(entries: Iterable[Entry]) -> Markup:
    rows = [
        (el("a", e.name, href=f"#policy-{n}"), _chip(e), f"{len(e.report.failures)} of {len(e.report.comparisons)}")
        for n, e in enumerate(entries, 1)
    ]
    return sections.table("Policies in this report", ("policy", "verdict", "disagreements"), rows)


def _policy(entry: Entry, number: int, *, alone: bool) -> Markup:
    says = verdict(entry.report).partition(": ")[2]
    return el(
        "section",
        el("div", el("h2", entry.name, id=f"title-{number}"), _chip(entry), class_="title"),
        el("p", f"{says[:1].upper()}{says[1:]}.", class_="lead"),
        sections.facts(entry),
        [section(entry) for section in _SECTIONS],
        class_="policy only" if alone else "policy",
        id=f"policy-{number}",
        aria_labelledby=f"title-{number}",
    )


def _chip(entry: Entry) -> Markup:
    kind, text = _CHIPS[entry.report.verdict]
    return el("span", text, class_=f"chip {kind}")
