"""Lines in an SVG: what the benchmarks draw of what they measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _TOP = 640, 360, 64, 48, 16
_RIGHT = 24
_COLOURS = ("#2563eb", "#d97706", "#059669", "#dc2626", "#7c3aed")


@dataclass(frozen=True)
class Line:
    """A name, and its points in the order of x."""

    name: str
    points: Sequence[tuple[float, float]]


def plot(lines: Sequence[Line], across: str, up: str) -> str:
    """The SVG: both axes begin at zero, every point is marked and has its value."""
    widest = max((x for line in lines for x, _ in line.points), default=1)
    highest = _round(max((y for line in lines for _, y in line.points), default=1))

    def place(x: float, y: float) -> tuple[float, float]:
        inner, tall = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _BOTTOM - _TOP
        return _LEFT + inner * x / (widest * 1.05), _HEIGHT - _BOTTOM - tall * y / highest

    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" '
        'font-family="sans-serif" font-size="12">',
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="#ffffff"/>',
    ]
    for tick in range(6):
        value = highest * tick / 5
        _, y = place(0, value)
        parts.append(f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}" stroke="#e5e7eb"/>')
        parts.append(f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end" fill="#374151">{value:g}</text>')
    text = 'text-anchor="middle" fill="#111827"'
    numbers = sorted({x for line in lines for x, _ in line.points})
    parts += [f'<text x="{place(x, 0)[0]:.1f}" y="{_HEIGHT - 30}" {text}>{x:g}</text>' for x in numbers]
    parts += [
        f'<text x="{(_LEFT + _WIDTH - _RIGHT) / 2}" y="{_HEIGHT - 10}" {text}>{escape(across)}</text>',
        f'<text transform="translate(14 {_HEIGHT / 2}) rotate(-90)" {text}>{escape(up)}</text>',
    ]
    for number, line in enumerate(lines):
        colour = _COLOURS[number % len(_COLOURS)]
        places = [place(x, y) for x, y in line.points]
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        parts.append(f'<path d="M{path}" fill="none" stroke="{colour}" stroke-width="2"/>')
        for (x, y), (_, value) in zip(places, line.points, strict=True):
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}"/>')
            parts.append(f'<text x="{x - 6:.1f}" y="{y - 7:.1f}" text-anchor="end" fill="{colour}">{value:.3g}</text>')
        parts.append(f'<text x="{_LEFT + 12}" y="{_TOP + 14 + 16 * number}" fill="{colour}">{escape(line.name)}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def _round(value: float) -> float:
    """The next number of one digit and a half: where an axis ends."""
    scale = 10 ** math.floor(math.log10(value)) if value > 0 else 1
    return next(step * scale for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10, 15) if step * scale >= value * 1.1)
