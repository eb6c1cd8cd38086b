"""Pictures as inline SVG, without scripts: spread of differences, drift of the memory, the policy's layers.

Colours and fonts come from the page's style sheet, so that light and dark follow the reader.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

from export_model.exporter.markup import Markup, el, svg
from export_model.exporter.reports.layers import Block
from export_model.exporter.reports.layout import layout
from export_model.exporter.verify.difference import BINS, FIRST, LAST
from export_model.exporter.verify.findings import Finding

_BAR, _STRIP, _ZERO_GAP = 17.0, 46.0, 18.0
#: Lines have this many colours; a second round of them is dashed.
_COLOURS = 6


def histograms(output: str, comparisons: Sequence[Finding]) -> Markup:
    """One strip per comparison of ``output``: how many elements differ by how much, the bound in the middle."""
    names = [f"{c.format} · {c.runtime}" for c in comparisons]
    left = 2.0
    right = left + BINS * _BAR + _ZERO_GAP
    first, last = _decades(comparisons)
    wide = (right - left - _BAR - _ZERO_GAP) / (last - first)
    bottom = 8 + _STRIP * len(comparisons)

    def edge(exponent: float) -> float:
        """Where the decade from 10^exponent begins; equal elements stand apart, to its left."""
        return left + _BAR + _ZERO_GAP + (exponent - first) * wide

    parts: list[Markup] = []
    for decade in range(math.ceil(first), math.floor(last) + 1, 1 + int(last - first) // 8):
        x = edge(decade)
        parts.append(el("line", class_="grid", x1=x, x2=x, y1=6.0, y2=bottom))
        parts.append(_tick(_power(decade), x, bottom + 14))
    parts.append(_tick("0", left + _BAR / 2, bottom + 14))
    for row, (c, name) in enumerate(zip(comparisons, names, strict=True)):
        base = 8 + _STRIP * (row + 1) - 2
        parts.append(el("text", name, class_="label", x=left, y=base - 25))
        parts.append(el("line", class_="axis", x1=left, x2=right, y1=base, y2=base))
        total, most = sum(c.histogram), max(c.histogram)
        for place, count in enumerate(c.histogram):
            if count:
                # Square roots: a few elements that are far off must be seen beside thousands that are not.
                height = max(2.0, 20 * math.sqrt(count / most))
                bar = el(
                    "rect",
                    el("title", f"{count} of {total} elements: {_bin_text(place)}"),
                    class_="bar" if c.passed else "bar bad",
                    x=(edge(FIRST + place - 1) if place else left) + 1,
                    y=base - height,
                    width=(wide if place else _BAR) - 2,
                    height=height,
                )
                parts.append(bar)
        if c.tolerance.atol > 0:
            x = edge(min(max(math.log10(c.tolerance.atol), first), last))
            parts.append(el("line", class_="bound", x1=x, x2=x, y1=base - 20, y2=base))
    described = f"{output}: histogram of absolute differences for {len(comparisons)} comparisons, in decades"
    return svg(parts, width=right + 12, height=bottom + 22, aria_label=described)


def _decades(comparisons: Sequence[Finding]) -> tuple[float, float]:
    """The axis from which to which power of ten: all that differs is on it, and the bound is its middle."""
    bounds = [math.log10(c.tolerance.atol) for c in comparisons if c.tolerance.atol > 0]
    filled = [FIRST + place - 1 for c in comparisons for place, count in enumerate(c.histogram) if place and count]
    low, high = min(filled, default=FIRST), max(filled, default=LAST) + 1
    if not bounds:
        return low, max(high, low + 2)
    middle = min(max(bounds[0], FIRST), LAST + 1)
    half = max(middle - low, high - middle, 3.0)
    return middle - half, middle + half


def drift(output: str, comparisons: Sequence[Finding], pairs: Sequence[tuple[str, str]]) -> Markup:
    """Lines of the worst difference per step with the memory fed back, on a logarithmic axis.

    A line has the colour of its (format, runtime) in ``pairs``, the same in every chart.
    """
    steps = max(len(c.drift) for c in comparisons)
    shown = [d for c in comparisons for d in c.drift if math.isfinite(d) and d > 0]
    shown += [c.tolerance.atol for c in comparisons if c.tolerance.atol > 0]
    low, high = math.floor(math.log10(min(shown, default=1e-8))), math.ceil(math.log10(max(shown, default=1e-4)))
    low, high = low - 1, max(high, low + 1)  # the lowest line is zero's
    left, right, top, bottom = 40.0, 314.0, 12.0, 160.0

    def x(step: int) -> float:
        return left + (right - left) * (step / max(steps - 1, 1))

    def y(value: float) -> float:
        place = math.log10(value) if 0 < value < math.inf else high if value else low
        return bottom - (bottom - top) * (min(max(place, low), high) - low) / (high - low)

    parts: list[Markup] = []
    every = max(1, math.ceil((high - low) / 6))
    for decade in range(high, low - 1, -every):
        here = y(10.0**decade)
        parts.append(el("line", class_="grid", x1=left, x2=right, y1=here, y2=here))
        parts.append(_tick(_power(decade) if decade > low else "0", left - 6, here + 4, "end"))
    marked = range(0, steps, max(1, math.ceil(steps / 8)))
    parts += [_tick(str(s + 1), x(s), bottom + 16) for s in marked]
    parts.append(_tick("step", (left + right) / 2, bottom + 30))
    bound = max(c.tolerance.atol for c in comparisons)
    if bound > 0:
        parts.append(el("line", class_="bound", x1=left, x2=right, y1=y(bound), y2=y(bound)))
    for c in comparisons:
        colour = colour_of(pairs.index((c.format, c.runtime)))
        points = [(x(i), y(d if math.isfinite(d) else 10.0**high)) for i, d in enumerate(c.drift)]
        title = el("title", f"{c.format} in {c.runtime}: {', '.join(f'{d:.1e}' for d in c.drift)}")
        parts.append(
            el("polyline", title, class_=f"line {colour}", points=" ".join(f"{a:.1f},{b:.1f}" for a, b in points))
        )
        parts += [el("circle", class_=f"dot {colour}", cx=a, cy=b, r=2.5) for a, b in points]
    described = f"{output}: worst difference per step with the memory fed back"
    return svg(parts, width=right + 8, height=bottom + 38, aria_label=described)


def colour_of(number: int) -> str:
    """The class of a line's colour, dashed from the seventh on."""
    return f"c{number % _COLOURS}" + (" dashed" if number >= _COLOURS else "")


def diagram(blocks: Sequence[Block]) -> Markup:
    """The layers of a policy as boxes, from its inputs at the top to its outputs at the bottom."""
    parts, width, height, described = diagram_parts(blocks)
    return svg(parts, width=width, height=height, aria_label=described)


def diagram_parts(blocks: Sequence[Block]) -> tuple[list[Markup], float, float, str]:
    """(elements, width, height, description) of such a picture."""
    titles = [b.title if len(b.title) <= 34 else f"{b.title[:33]}…" for b in blocks]
    placed = layout([b.before for b in blocks], [max(84.0, 7.3 * len(t) + 26) for t in titles])
    parts: list[Markup] = []
    for chain in placed.edges:
        points = [placed.places[i] for i in chain]
        path = []
        for a, b in itertools.pairwise(points):
            start = placed.y(a) + (20 if a.item is not None else 0)
            end = placed.y(b) - (20 if b.item is not None else 0)
            middle = (start + end) / 2
            path.append(f"M{a.x:.1f} {start:.1f}C{a.x:.1f} {middle:.1f} {b.x:.1f} {middle:.1f} {b.x:.1f} {end:.1f}")
        parts.append(el("path", class_="edge", d="".join(path)))
    for place in placed.places:
        if place.item is None:
            continue
        block, y = blocks[place.item], placed.y(place)
        tip = el("title", block.detail or block.title)
        box = el(
            "rect",
            x=round(place.x - place.width / 2, 1),
            y=y - 18,
            width=place.width,
            height=36,
            rx=18 if block.kind != "layer" else 6,
        )
        text = el("text", titles[place.item], x=round(place.x, 1), y=y + 4.5, text_anchor="middle")
        parts.append(el("g", tip, box, text, class_=f"box {block.kind}"))
    names = {kind: ", ".join(b.title for b in blocks if b.kind == kind) for kind in ("input", "output")}
    layers = " → ".join(b.title for b in blocks if b.kind == "layer")
    described = f"Layers from {names['input']} to {names['output']}: {layers}"
    height = placed.height
    return parts, math.ceil(placed.width), height, described


def _tick(text: str, x: float, y: float, anchor: str = "middle") -> Markup:
    return el("text", text, class_="tick", x=x, y=y, text_anchor=anchor)


def _power(exponent: int) -> Markup:
    return Markup(f'10<tspan dy="-4" font-size="8">{str(exponent).replace("-", "−")}</tspan>')


def _bin_text(place: int) -> str:
    if place == 0:
        return "equal"
    low = FIRST + place - 1
    return f"below 1e{low + 1}" if place == 1 else f"1e{low} or more" if low == LAST else f"1e{low} to 1e{low + 1}"
