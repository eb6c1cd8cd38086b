"""One self-contained HTML page: no scripts, no fonts, nothing fetched. Light and dark follow the reader's system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from export_model.exporter import __version__
from export_model.exporter.markup import Markup, el
from export_model.exporter.reports import sections
from export_model.exporter.reports.entry import Entry
from export_model.exporter.reports.refused import place_of
from export_model.exporter.verify.report import Pair
from export_model.signatures.errors import ExportModelError

_PARTS = Path(__file__).parent
_CHIPS = {
    "passed": ("passed", "Passed"),
    "self-consistent": ("unverified", "Self-consistent"),
    "failed": ("failed", "Failed"),
    "not verified": ("unverified", "Not verified"),
}
_REFUSED = el("span", "Refused", class_="chip failed")
#: How much of what is allowed a difference takes, as a colour of the overview.
_HEAT = {
    "equal": "equal",
    "low": "a tenth of what is allowed, or less",
    "near": "within what is allowed",
    "rounding": "within what float32 rounding explains",
    "over": "disagrees",
}
#: In the order of the page; each gives nothing where it has nothing to say.
_SECTIONS: tuple[Callable[[Entry], Markup | None], ...] = (
    sections.failures,
    sections.returns,
    sections.agreement,
    sections.excuses,
    sections.spread,
    sections.memory,
    sections.policy_graph,
    sections.interface,
    sections.tensors,
    sections.worst_inputs,
    sections.tolerances,
    sections.runtimes,
    sections.files,
    sections.notes,
)


def page(entries: Sequence[Entry], refused: Sequence[ExportModelError] = ()) -> str:
    """The document for one or more policies, and for what was refused."""
    ordered = sorted(entries, key=lambda e: (e.report.passed is not False, e.report.passed is not None))
    names = [*map(place_of, refused), *(e.name for e in ordered)]
    alone = len(names) == 1
    eyebrow = el("h1" if alone else "p", "export-model · parity report", class_="eyebrow")
    title = f"{names[0]}{_origin(ordered)}: parity report" if alone else f"Parity report on {len(ordered)} policies"
    title += f", {len(refused)} refused" if refused and not alone else ""
    bundled = any(e.contract is not None for e in entries)
    data = " parity.json in the bundle holds the same as data." if bundled else ""
    header = el("header", eyebrow, None if alone else el("h1", title), None if alone else _overview(ordered, refused))
    policies = [_policy(e, number, alone=alone) for number, e in enumerate(ordered, 1)]
    main = el("main", [_refusal(error, number) for number, error in enumerate(refused, 1)], policies, _words())
    return document(title, header, main, el("footer", f"Written by export-model {__version__}.{data}"))


def document(title: str, *body: Markup) -> str:
    """Return a page with the style of all reports."""
    head = el(
        "head",
        el("meta", charset="utf-8"),
        el("meta", name="viewport", content="width=device-width, initial-scale=1"),
        el("meta", name="color-scheme", content="light dark"),
        el("title", title),
        el("style", Markup(_PARTS.joinpath("page.css").read_text(encoding="utf-8"))),
    )
    return f"<!DOCTYPE html>\n{el('html', head, el('body', *body), lang='en')}\n"


def _words() -> Markup:
    """What the words of a report mean."""
    return Markup("".join(_PARTS.joinpath("words.html").read_text(encoding="utf-8").splitlines()))


def _overview(entries: Sequence[Entry], refused: Sequence[ExportModelError]) -> Markup:
    """Policies by format and runtime: how much of what is allowed the worst difference takes, as a colour."""
    found = [{(p.format, p.runtime): p for p in e.report.pairs} for e in entries]
    pairs = list(dict.fromkeys(pair for rows in found for pair in rows))
    table = [
        (el("a", place_of(error), href=f"#refused-{n}"), _REFUSED, "–", *(_heat(None) for _ in pairs))
        for n, error in enumerate(refused, 1)
    ]
    table += [
        (
            el("a", e.name, href=f"#policy-{n}"),
            _chip(e),
            f"{len(e.report.failures)} of {len(e.report.comparisons)}",
            *(_heat(rows.get(pair)) for pair in pairs),
        )
        for n, (e, rows) in enumerate(zip(entries, found, strict=True), 1)
    ]
    two_lines = ([kind, el("br"), runtime] for kind, runtime in pairs)
    head = ("policy", "verdict", ["disagree-", el("br"), "ments"], *two_lines)
    return el(
        "div",
        sections.table(
            "Policies in this report: the largest share of the tolerance, by format and runtime", head, table
        ),
        el("p", [el("span", words, class_=f"heat {kind}") for kind, words in _HEAT.items()], class_="legend"),
        class_="overview",
    )


def _heat(pair: Pair | None) -> Markup:
    """The worst of a format in a runtime; the colour says how much of the tolerance it takes."""
    if pair is None:
        return el("td", "–", class_="number soft")
    if not pair.passed:
        return el("td", el("span", "✗"), class_="heat over")
    measured = [c for c in pair.worst.values() if c.measured]
    worst = max(measured, key=lambda c: c.share, default=None)
    if worst is None:
        return el("td", "✓", class_="heat equal")
    kind = "equal" if worst.share == 0 else "low" if worst.share <= 0.1 else "near"
    if any(c.rounding for c in measured):
        kind = "rounding"
    return el("td", worst.cell(), class_=f"heat {kind}")


def _policy(entry: Entry, number: int, *, alone: bool) -> Markup:
    says = entry.report.sentence.partition(": ")[2]
    title = el("div", el("h2", entry.name, id=f"title-{number}"), _chip(entry), class_="title")
    content = (
        el("p", f"{says[:1].upper()}{says[1:]}.", class_="lead"),
        sections.facts(entry),
        sections.again(entry),
        [section(entry) for section in _SECTIONS],
        list(entry.more),
    )
    if alone:
        return el("section", title, content, class_="policy only", aria_labelledby=f"title-{number}")
    # A link to what is inside of a closed part opens it.
    failed = "" if entry.report.passed is False else None
    return el(
        "details",
        el("summary", title),
        el("section", content, id=f"policy-{number}", aria_labelledby=f"title-{number}"),
        class_="policy",
        open=failed,
    )


def _origin(entries: Sequence[Entry]) -> str:
    """Return which file the only policy is from, in words; nothing where that is unknown."""
    found = [Path(e.contract.origin.path).name for e in entries if e.contract is not None]
    return f" from {found[0]}" if found else ""


def _refusal(error: ExportModelError, number: int) -> Markup:
    """What was refused, and why: a part of its own, which is open."""
    title = el("div", el("h2", place_of(error), id=f"refused-{number}"), _REFUSED, class_="title")
    return el("section", title, el("pre", error.message), class_="policy only", aria_labelledby=f"refused-{number}")


def _chip(entry: Entry) -> Markup:
    kind, text = _CHIPS[entry.report.verdict]
    if kind == "passed" and not entry.report.proven:  # green only where the original ran
        kind = "unverified"
    text = f"{text} in part" if entry.report.partial else text
    return el("span", text, class_=f"chip {kind}")
