"""One HTML page about a log: the verdict, the causes, and how far each step was from the policy, over time."""

from __future__ import annotations

import math

import numpy as np

from export_model.exporter import __version__
from export_model.exporter.logs.check import LogReport
from export_model.exporter.logs.recording import Array
from export_model.exporter.logs.wording import report_lines, sentence
from export_model.exporter.markup import Markup, el, svg
from export_model.exporter.reports.page import document
from export_model.exporter.reports.sections import section, table

#: Points of a line: of more steps, the worst of each stretch.
MOST_POINTS = 600
#: Shares of what is allowed that the chart shows, as powers of ten.
LOWEST, HIGHEST = -4, 8
LEFT, RIGHT, TOP, BOTTOM = 44.0, 720.0, 12.0, 200.0


def log_page(report: LogReport) -> str:
    """The document: no scripts, nothing fetched."""
    title = f"{report.policy}: {report.log}"
    kind = "passed" if report.fits else "failed"
    verdict = el("p", el("span", "Fits" if report.fits else "Different", class_=f"chip {kind}"), " ", sentence(report))
    charts = [section(f"{name}, step by step", _chart(report, name)) for name in report.shares]
    return document(
        title,
        el("header", el("p", "export-model · log", class_="eyebrow"), el("h1", title)),
        el("main", el("article", verdict, _causes(report), charts, _words_section(report))),
        el("footer", f"Written by export-model {__version__}."),
    )


def _causes(report: LogReport) -> Markup | None:
    rows = [("cause", c) for c in report.causes] + [("explains as much", c) for c in report.others]
    if not rows:
        return None
    lines = [
        [c.where, c.kind.replace("_", " "), c.says + ("" if word == "cause" else f" ({word})")] for word, c in rows
    ]
    return section("What explains it", table("causes", ("where", "kind", "what"), lines))


def _words_section(report: LogReport) -> Markup:
    return section("In words", el("ul", [el("li", line.strip()) for line in report_lines(report)]))


def _chart(report: LogReport, name: str) -> Markup:
    """The largest share of what is allowed, per step, as logged and with the causes, on a logarithmic axis."""
    parts: list[Markup] = []
    for decade in range(LOWEST, HIGHEST + 1, 2):
        y = _y(10.0**decade)
        parts.append(el("line", class_="grid", x1=LEFT, x2=RIGHT, y1=y, y2=y))
        parts.append(el("text", f"1e{decade}", class_="tick", x=LEFT - 6, y=y + 4, text_anchor="end"))
    parts.append(el("line", class_="bound", x1=LEFT, x2=RIGHT, y1=_y(1.0), y2=_y(1.0)))
    steps = report.steps
    ticks = sorted({0, steps // 4, steps // 2, 3 * steps // 4, steps - 1})
    parts += [el("text", str(t), class_="tick", x=_x(t, steps), y=BOTTOM + 16, text_anchor="middle") for t in ticks]
    lines = [("as it was logged", report.shares[name], "c0")]
    if name in report.shares_explained:
        lines.append(("with the causes", report.shares_explained[name], "c1"))
    for title, shares, colour in lines:
        points = " ".join(f"{_x(step, steps):.1f},{_y(share):.1f}" for step, share in _worst_of_stretches(shares))
        parts.append(el("polyline", el("title", f"{name} {title}"), class_=f"line {colour}", points=points))
    said = f"{name}: share of what is allowed, per step; 1 is the bound"
    return el("figure", svg(parts, width=RIGHT + 8, height=BOTTOM + 26, aria_label=said), el("figcaption", said))


def _x(step: int, steps: int) -> float:
    return LEFT + (RIGHT - LEFT) * step / max(steps - 1, 1)


def _y(share: float) -> float:
    place = math.log10(share) if share > 0 else LOWEST
    return BOTTOM - (BOTTOM - TOP) * (min(max(place, LOWEST), HIGHEST) - LOWEST) / (HIGHEST - LOWEST)


def _worst_of_stretches(shares: Array) -> list[tuple[int, float]]:
    """(step, share): all of them, or the worst of each stretch."""
    width = max(1, -(-len(shares) // MOST_POINTS))
    found = []
    for first in range(0, len(shares), width):
        part = shares[first : first + width]
        worst = first + int(np.argmax(part))
        found.append((worst, float(shares[worst])))
    return found
