"""What play found, as JUnit XML, as Markdown, and as a page."""

from __future__ import annotations

from collections.abc import Sequence

from export_model.exporter import __version__
from export_model.exporter.markup import Markup, el
from export_model.exporter.play import pictures
from export_model.exporter.play.report import PlayReport, figure, signed_text
from export_model.exporter.reports import sections
from export_model.exporter.reports.entry import Entry
from export_model.exporter.reports.junit import junit_file, play_suite, suites_of
from export_model.exporter.reports.markdown import PLAY_MARKS, code, text
from export_model.exporter.reports.page import document
from export_model.exporter.reports.write import Documents
from export_model.exporter.verify.plays import CONFIDENCE, DIFFERENT, EQUIVALENT, NOT_DECIDED

_CHIPS = {
    EQUIVALENT: ("passed", "Equivalent"),
    DIFFERENT: ("failed", "Different"),
    NOT_DECIDED: ("unverified", "Not decided"),
}
_HEAD = (
    "format",
    "runtime",
    "mean return",
    "difference",
    f"{CONFIDENCE:.0%} interval",
    "equal episodes",
    "decisions/s",
    "verdict",
)


def play_documents(report: PlayReport) -> Documents:
    """Return what makes the reports that are asked for."""
    return Documents(lambda: junit(report), lambda: html(report), lambda: markdown(report))


def junit(report: PlayReport) -> bytes:
    """A suite of returns, a case for everything that played; then the suites of the replay."""
    return junit_file([play_suite(report.policy, report.record), *suites_of(Entry(report.replay))])


def markdown(report: PlayReport) -> str:
    """A summary for a CI job's page."""
    lines = [
        f"### {PLAY_MARKS[report.verdict]} {code(report.policy)} in {code(report.environment)}",
        "",
        text(report.sentence),
        "",
    ]
    for finding in report.replay.failures:
        first, *rest = finding.explanation()
        lines += [f"- ❌ {text(first)}", *(f"  - {text(line)}" for line in rest)]
    lines += [
        f"- {PLAY_MARKS[p.compared.verdict]} {text(f'{p.where}: {p.sentence}')}" for p in report.played if p.sentence
    ]
    rows = [[code(cells[0]), code(cells[1]), *cells[2:]] for cells in _rows(report)]
    own = report.episodes
    mean = [code(report.reference), "", figure(own.returns.mean()), "", "", "", f"{own.rate:,.0f}", "reference"]
    lines += ["", *(f"| {' | '.join(cells)} |" for cells in (_HEAD, ["---"] * len(_HEAD), mean, *rows)), ""]
    lines += [f"- {text(note)}" for note in (*report.notes, *report.replay.notes)]
    return "\n".join(lines).rstrip() + "\n"


def html(report: PlayReport) -> str:
    """One self-contained page."""
    kind, word = _CHIPS[report.verdict]
    says = report.sentence.partition(": ")[2]
    replay = Entry(report.replay)
    content = el(
        "section",
        el(
            "div",
            el("h2", f"{report.policy} in {report.environment}"),
            el("span", word, class_=f"chip {kind}"),
            class_="title",
        ),
        el("p", f"{says[:1].upper()}{says[1:]}.", class_="lead"),
        _facts(report),
        returns_section(report),
        sections.failures(replay),
        sections.agreement(replay),
        sections.memory(replay),
        sections.tolerances(replay),
        sections.runtimes(replay),
        sections.notes(replay),
        class_="policy only",
    )
    eyebrow = el("h1", "export-model · play", class_="eyebrow")
    footer = el("footer", f"Written by export-model {__version__}. play --json gives the same as data.")
    return document(
        f"{report.policy} in {report.environment}: play", el("header", eyebrow), el("main", content), footer
    )


def _facts(report: PlayReport) -> Markup:
    own, options = report.episodes, report.options
    found = [
        ("Reference", report.reference),
        ("Mean return", f"{figure(own.returns.mean())}, deviation {figure(own.returns.std(ddof=1))}"),
        ("Margin", f"± {figure(report.margin)} ({options.margin})"),
        (
            "Episodes",
            f"{options.episodes} from seed {options.seed}, {'without chance' if options.deterministic else 'drawn'}",
        ),
        ("Mean length", f"{figure(own.lengths.mean())} steps, success {own.success.mean():.0%}"),
        ("Recorded steps", str(report.recorded)),
    ]
    return el("dl", [el("div", el("dt", k), el("dd", v)) for k, v in found], class_="facts")


def returns_section(report: PlayReport) -> Markup:
    """What everything earned: a table, the intervals beside the margin, returns beside each other, survival."""
    rows = []
    for cells, played in zip(_rows(report), report.played, strict=True):
        bad = played.compared.verdict == DIFFERENT
        rows.append(
            [
                *cells[:-1],
                el("td", cells[-1], class_="fail" if bad else "ok" if played.compared.verdict == EQUIVALENT else None),
            ]
        )
    table = sections.table(
        "What each earned beside the reference, in episodes that begin alike", _HEAD, rows, range(2, len(_HEAD) - 1)
    )
    drawn = [
        (
            "Mean difference and its interval",
            pictures.intervals(report),
            "Dashed: the margin. An interval has to be within it.",
        ),
        ("Returns", pictures.returns(report), "From the 5th to the 95th percentile of episodes; the dot is the mean."),
        ("Survival", pictures.survival(report), "The share of episodes that still go on after so many steps."),
    ]
    figures = [
        el(
            "figure",
            el("h4", title),
            el("div", picture, class_="scroll", tabindex=0, role="region", aria_label=title),
            el("figcaption", caption),
        )
        for title, picture, caption in drawn
    ]
    notes = el("ul", [el("li", note) for note in report.notes], class_="plain") if report.notes else None
    return sections.section("Returns", notes, table, el("div", figures, class_="figures"))


def _rows(report: PlayReport) -> list[Sequence[str]]:
    rows: list[Sequence[str]] = []
    for p in report.played:
        c = p.compared
        interval = f"{signed_text(c.low)} to {signed_text(c.high)}"
        equal, rate = f"{c.equal} of {c.episodes}", f"{p.episodes.rate:,.0f}"
        rows.append(
            [
                p.format,
                p.runtime,
                figure(p.episodes.returns.mean()),
                signed_text(c.difference),
                interval,
                equal,
                rate,
                c.verdict,
            ]
        )
    return rows
