"""Where the boxes of a small directed graph go: rows from top to bottom, few crossings (after Sugiyama)."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec import Struct

_GAP, _ROW = 22.0, 70.0
#: Width that an edge takes in a row that it only passes.
_PASSING = 14.0
_SWEEPS = 12
_MARGIN = 22.0


class BoxPlace(Struct):
    """A box, or (``item`` None) a point that a long edge passes: centre, width, row, places above it."""

    item: int | None
    row: int
    width: float
    above: list[int]
    x: float = 0.0


class BoxLayout(Struct, frozen=True):
    """Places by index; ``edges`` are chains of places from a box down to a box. Sizes are pixels."""

    places: list[BoxPlace]
    edges: list[list[int]]
    width: float
    rows: int

    def y(self, place: BoxPlace) -> float:
        """The centre of a row."""
        return _MARGIN + place.row * _ROW

    @property
    def height(self) -> float:
        """From above the first row to below the last."""
        return 2 * _MARGIN + (self.rows - 1) * _ROW


def layout(before: Sequence[set[int]], widths: Sequence[float]) -> BoxLayout:
    """Place boxes, in topological order, under the boxes in their ``before``."""
    rows = _rows(before)
    places = [BoxPlace(i, rows[i], widths[i], []) for i in range(len(before))]
    edges = []
    for i, sources in enumerate(before):
        for source in sorted(sources):
            chain = [source]
            for row in range(rows[source] + 1, rows[i]):
                places.append(BoxPlace(None, row, _PASSING, [chain[-1]]))
                chain.append(len(places) - 1)
            places[i].above.append(chain[-1])
            edges.append([*chain, i])
    below: list[list[int]] = [[] for _ in places]
    for i, place in enumerate(places):
        for source in place.above:
            below[source].append(i)
    by_row = [[i for i, p in enumerate(places) if p.row == r] for r in range(max(rows, default=-1) + 1)]
    _order(by_row, places, below)
    width = _across(by_row, places, below)
    return BoxLayout(places, edges, width, len(by_row))


def _rows(before: Sequence[set[int]]) -> list[int]:
    """Longest way from the top; then boxes without sources move down to just above their first reader."""
    rows: list[int] = []
    for sources in before:
        rows.append(1 + max((rows[s] for s in sources), default=-1))
    for i, sources in enumerate(before):
        readers = [rows[j] for j, other in enumerate(before) if i in other]
        if not sources and readers:
            rows[i] = min(readers) - 1
    return rows


def _order(by_row: list[list[int]], places: list[BoxPlace], below: list[list[int]]) -> None:
    """Sort each row by the mean place of its neighbours, downwards and upwards in turn."""
    for sweep in range(_SWEEPS):
        down = sweep % 2 == 0
        rank = {i: n for row in by_row for n, i in enumerate(row)}
        for row in by_row if down else by_row[::-1]:
            means = {}
            for n, i in enumerate(row):
                near = places[i].above if down else below[i]
                means[i] = sum(rank[j] for j in near) / len(near) if near else float(n)
            row.sort(key=means.__getitem__)
            rank.update({i: n for n, i in enumerate(row)})


def _across(by_row: list[list[int]], places: list[BoxPlace], below: list[list[int]]) -> float:
    """Set every x near its neighbours' mean without overlaps; returns the width of the whole."""
    for row in by_row:
        x = 0.0
        for i in row:
            places[i].x = x + places[i].width / 2
            x += places[i].width + _GAP
        for i in row:
            places[i].x -= x / 2
    for sweep in range(2 * _SWEEPS):
        down = sweep % 2 == 0
        for row in by_row if down else by_row[::-1]:
            wish = []
            for i in row:
                near = (places[i].above if down else below[i]) or [i]
                wish.append(sum(places[j].x for j in near) / len(near))
            _spread([places[i] for i in row], wish)
    left = min((p.x - p.width / 2 for p in places), default=0.0)
    for place in places:
        place.x -= left - 2
    return max((p.x + p.width / 2 for p in places), default=0.0) + 2


def _spread(row: list[BoxPlace], wish: list[float]) -> None:
    """Move a row to its wishes, in order, ``_GAP`` apart: neighbours that would overlap share their error."""
    groups: list[tuple[list[BoxPlace], float]] = []  # places side by side, and the centre that they want together
    for place, x in zip(row, wish, strict=True):
        group, centre = [place], x
        while groups and groups[-1][1] + _extent(groups[-1][0]) / 2 + _GAP > centre - _extent(group) / 2:
            other, middle = groups.pop()
            centre = (middle * len(other) + centre * len(group)) / (len(other) + len(group))
            group = [*other, *group]
        groups.append((group, centre))
    for group, centre in groups:
        x = centre - _extent(group) / 2
        for place in group:
            place.x = x + place.width / 2
            x += place.width + _GAP


def _extent(group: list[BoxPlace]) -> float:
    return sum(p.width for p in group) + _GAP * (len(group) - 1)
