"""The plausible layouts of a policy in classes that mirror alike, ranked by score, and what is decided of them.

A class is decided where its score is low, lower than that of every other class and of orders of joints by chance by a
margin, and where no small change of it fits better.

How the bounds were chosen: of 34 public policies the true class is first in all, 27 are decided. Without
their class, or their robot, none is decided; with ``BETTER`` at 0.8 one is, with two terms exchanged. Of 200 random
networks the best score is 0.82, and 0.91 of the next; of 68 public policies with rows and columns in random order 0.85.
tests/layout holds the project's own walkers to them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.layouts.changes import Change, changes_of
from export_model.converters.layouts.layouts import Layout, Mirrors
from export_model.exporter.layout.trial import Trial

#: A score above this is nobody's; the best may have this share of the next best, and a small change of it that fits
#: better must leave this share or more.
HIGHEST, MARGIN, BETTER = 0.7, 0.75, 0.9
#: Orders of the joints by chance that the best is compared with.
_SHUFFLED = 8


class LayoutClass(Struct, frozen=True):
    """Layouts that no mirror tells apart, and their score."""

    members: tuple[Layout, ...]
    mirrors: Mirrors
    score: float

    def says(self, fact: str) -> tuple[str, ...]:
        """What its members say of ``robot``, ``order``, ``stacking``, ``terms`` or ``project``, each once."""
        return tuple(dict.fromkeys(_FACTS[fact](member) for member in self.members))


_FACTS: Mapping[str, Callable[[Layout], str]] = {
    "robot": lambda layout: layout.robot.key,
    "order": lambda layout: ", ".join(layout.joints),
    "order name": lambda layout: layout.order,
    "stacking": lambda layout: layout.stacking,
    "terms": lambda layout: ", ".join(layout.terms),
    "project": lambda layout: layout.project,
}


class Ranking(Struct, frozen=True):
    """Classes, the best first; the best score by chance; the small change of the best that fits best."""

    classes: tuple[LayoutClass, ...]
    chance: float
    change: Change | None = None
    changed: float = 1.0

    @property
    def best(self) -> LayoutClass | None:
        """The class that fits best, None where no layout has these widths."""
        return self.classes[0] if self.classes else None

    @property
    def next(self) -> float:
        """The best score of what is not the best class."""
        return min([c.score for c in self.classes[1:2]] + [self.chance])

    @property
    def why_open(self) -> str:
        """Why the best class is not decided; nothing where it is."""
        if self.best is None:
            return "no known layout has these widths"
        score = self.best.score
        if score > HIGHEST:
            return f"the best score, {score:.2f}, is above {HIGHEST}: hardly symmetric, or none of these layouts"
        if score > MARGIN * self.next:
            return f"the best score, {score:.2f}, is not {MARGIN} of the next, {self.next:.2f}"
        if self.change is not None and self.changed < BETTER * score:
            return f"{self.change.text}: {score:.2f} would become {self.changed:.2f}"
        return ""


def rank_layouts(trial: Trial, layouts: Iterable[Layout]) -> Ranking:
    """Rank what is plausible of a policy."""
    members: dict[Mirrors, list[Layout]] = {}
    for layout in layouts:
        members.setdefault(layout.mirrors(), []).append(layout)
    scores = trial.scores(list(members))
    found = [LayoutClass(tuple(m), key, s) for (key, m), s in zip(members.items(), scores, strict=True)]
    classes = tuple(sorted(found, key=lambda c: c.score))
    if not classes:
        return Ranking((), 1.0)
    ranking = Ranking(classes, chance_score(trial, classes[0].members[0]))
    if ranking.why_open:
        return ranking
    change, changed = best_change(trial, classes[0].members[0])
    return replace(ranking, change=change, changed=changed)


def chance_score(trial: Trial, layout: Layout) -> float:
    """The best score of orders of the layout's joints that are drawn."""
    rng = np.random.default_rng(1)
    drawn = [tuple(layout.joints[i] for i in rng.permutation(len(layout.joints))) for _ in range(_SHUFFLED)]
    own = layout.mirrors()
    others = [m for joints in drawn if (m := replace(layout, joints=joints).mirrors()) != own]
    return min(trial.scores(others), default=1.0)


def best_change(trial: Trial, layout: Layout) -> tuple[Change | None, float]:
    """The small change of a layout that fits best, and its score."""
    changes = list(changes_of(layout))
    scores: Sequence[float] = trial.scores([mirrors for _, mirrors in changes])
    number = int(np.argmin(scores)) if scores else -1
    return (changes[number][0], scores[number]) if scores else (None, 1.0)
