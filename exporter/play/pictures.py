"""Pictures of what was earned, as inline SVG in the style of the reports' page."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from export_model.exporter.markup import Markup, el, svg
from export_model.exporter.play.equivalence import PERCENTILES
from export_model.exporter.play.report import PlayReport, figure, signed_text
from export_model.exporter.reports.charts import colour_of
from export_model.exporter.verify.plays import DIFFERENT

_LEFT, _RIGHT, _ROW = 8.0, 314.0, 34.0
#: Points of a survival curve.
_POINTS = 60


def intervals(report: PlayReport) -> Markup:
    """Return the interval of each mean difference, between dashed lines at the margin."""
    played = report.played
    ends = [abs(v) for p in played for v in (p.compared.low, p.compared.high)]
    x = _scale(-1.15 * max([report.margin, *ends, 1e-12]), 1.15 * max([report.margin, *ends, 1e-12]))
    bottom = _ROW * len(played) + 10
    parts = [el("line", class_="axis", x1=x(0), x2=x(0), y1=4, y2=bottom)]
    for bound in (-report.margin, report.margin):
        parts.append(el("line", class_="bound", x1=x(bound), x2=x(bound), y1=4, y2=bottom))
        parts.append(_tick(signed_text(bound), x(bound), bottom + 14))
    for row, p in enumerate(played):
        c, y = p.compared, _ROW * row + 28
        bad = " bad" if c.verdict == DIFFERENT else ""
        title = el(
            "title",
            f"{p.where}: {signed_text(c.difference)}, from {signed_text(c.low)} to {signed_text(c.high)}, {c.verdict}",
        )
        parts.append(el("text", p.where, class_="label", x=_LEFT, y=y - 10))
        parts.append(_bar(title, x(c.low), x(c.high), y, bad))
        parts.append(el("circle", class_="dot c0", cx=x(c.difference), cy=y, r=3))
    described = f"Intervals of the mean difference of {len(played)} players beside a margin of {figure(report.margin)}"
    return svg(parts, width=_RIGHT + 8, height=bottom + 22, aria_label=described)


def returns(report: PlayReport) -> Markup:
    """Return how far the returns of each player usually lie apart, the reference first."""
    players = [(f"reference, {report.reference}", report.episodes), *((p.where, p.episodes) for p in report.played)]
    spans = [np.percentile(e.returns, PERCENTILES) for _, e in players]
    ends = [float(v) for span, (_, e) in zip(spans, players, strict=True) for v in (*span, e.returns.mean())]
    low, high = min(ends), max(ends)
    room = 0.08 * (high - low) or max(1.0, 0.01 * abs(high))
    x = _scale(low - room, high + room)
    bottom, parts = _ROW * len(players) + 10, []
    for row, ((name, episodes), span) in enumerate(zip(players, spans, strict=True)):
        y, mean = _ROW * row + 28, float(episodes.returns.mean())
        title = el("title", f"{name}: mean {figure(mean)}, from {figure(span[0])} to {figure(span[1])}")
        parts.append(el("text", name, class_="label", x=_LEFT, y=y - 10))
        parts.append(_bar(title, x(float(span[0])), x(float(span[1])), y))
        parts.append(el("circle", class_="dot c0", cx=x(mean), cy=y, r=3))
    parts += [_tick(figure(v), x(v), bottom + 14) for v in dict.fromkeys((low, high))]
    return svg(parts, width=_RIGHT + 8, height=bottom + 22, aria_label=f"Returns of {len(players)} players")


def survival(report: PlayReport) -> Markup:
    """Return the share of episodes that still go on, by step, a line for each player."""
    players = [(f"reference, {report.reference}", report.episodes), *((p.where, p.episodes) for p in report.played)]
    longest = max(int(e.lengths.max()) for _, e in players)
    left, top, bottom = 40.0, 8.0, 150.0
    x = _scale(0, longest, left)
    parts = []
    for share in (0.0, 0.5, 1.0):
        y = bottom - (bottom - top) * share
        parts.append(el("line", class_="grid", x1=left, x2=_RIGHT, y1=y, y2=y))
        parts.append(_tick(f"{share:.0%}", left - 6, y + 4, "end"))
    steps = np.unique(np.linspace(0, longest, _POINTS).astype(int))
    for number, (name, episodes) in enumerate(players):
        alive = [(float(x(int(s))), bottom - (bottom - top) * float((episodes.lengths > s).mean())) for s in steps]
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in alive)
        title = el("title", f"{name}: {figure(episodes.lengths.mean())} steps on average")
        parts.append(el("polyline", title, class_=f"line {colour_of(number)}", points=points))
    parts += [_tick("0", x(0), bottom + 16), _tick(str(longest), x(longest), bottom + 16, "end")]
    parts.append(_tick("step", (left + _RIGHT) / 2, bottom + 16))
    return svg(
        parts, width=_RIGHT + 8, height=bottom + 24, aria_label=f"Share of episodes by step, of {len(players)} players"
    )


def _scale(low: float, high: float, left: float = _LEFT) -> Callable[[float], float]:
    wide = (high - low) or 1.0
    return lambda value: round(left + (_RIGHT - left) * min(max((value - low) / wide, 0.0), 1.0), 2)


def _bar(title: Markup, start: float, end: float, y: float, more: str = "") -> Markup:
    return el("rect", title, class_=f"bar{more}", x=start, y=y - 4, width=max(end - start, 2.0), height=8)


def _tick(text: str, x: float, y: float, anchor: str = "middle") -> Markup:
    if not math.isfinite(x):
        x = _LEFT
    return el("text", text, class_="tick", x=x, y=y, text_anchor=anchor)
