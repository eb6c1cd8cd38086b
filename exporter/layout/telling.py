"""``export-model layout``: what the weights tell of a policy's layout, and whether what is stated of it agrees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct

from export_model.converters.layouts.layouts import Layout, plausible_layouts
from export_model.converters.layouts.robots import Robot
from export_model.converters.layouts.stated import stated_layouts
from export_model.converters.layouts.terms import TERMS
from export_model.converters.policy.policy import Policy
from export_model.exporter.layout.evidence import NEWEST, SCALES, Evidence, evidence_of
from export_model.exporter.layout.ranking import (
    BETTER,
    HIGHEST,
    MARGIN,
    LayoutClass,
    Ranking,
    best_change,
    chance_score,
    rank_layouts,
)
from export_model.exporter.layout.trial import Trial

DECIDED, OPEN, AGREES, DISAGREES = "decided", "open", "agrees", "disagrees"
#: Exit status of each.
STATUS: Mapping[str, int] = {DECIDED: 0, AGREES: 0, DISAGREES: 1, OPEN: 3}
#: Scores that differ less are equal: of two explanations the smaller one is then given.
_EQUAL = 0.01


class Statement(Struct, frozen=True):
    """What is stated of a layout beside the weights: where, its score, the best of all others, and what seems wrong."""

    source: str
    layout: Layout
    score: float
    next: float
    verdict: str
    says: str


class Told(Struct, frozen=True):
    """What was found out about a policy."""

    policy: str
    ranking: Ranking
    evidence: tuple[Evidence, ...] = ()
    stated: Statement | None = None

    @property
    def verdict(self) -> str:
        """``agrees``, ``disagrees`` where something is stated and it is clear; else ``decided`` or ``open``."""
        if self.stated is not None:
            return self.stated.verdict
        return OPEN if self.ranking.why_open else DECIDED

    @property
    def layout(self) -> Layout | None:
        """The layout that is decided, as far as its class says the same; the stated one where that agrees."""
        if self.stated is not None:
            return self.stated.layout if self.stated.verdict == AGREES else None
        return None if self.ranking.why_open or self.ranking.best is None else self.ranking.best.members[0]

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        best, ranking = self.ranking.best, self.ranking
        return {
            "schema": 1,
            "policy": self.policy,
            "verdict": self.verdict,
            "decided": decided_facts(self),
            "closed": closed_facts(self),
            "open": open_facts(self),
            "layout": None if self.layout is None else layout_dict(self.layout),
            "score": None if best is None else round(best.score, 4),
            "next": None if best is None else round(ranking.next, 4),
            "chance": None if best is None else round(ranking.chance, 4),
            "why_open": ranking.why_open,
            "evidence": [{"term": e.term, "holds": e.holds, "says": e.says} for e in self.evidence],
            "stated": None if self.stated is None else _stated_dict(self.stated),
            "classes": [
                {"score": round(c.score, 4), "members": [layout_dict(m) for m in c.members]} for c in ranking.classes
            ],
        }


def layout_dict(layout: Layout) -> dict[str, Any]:
    """A layout for a program."""
    return {
        "robot": layout.robot.key,
        "order": layout.order,
        "joints": list(layout.joints),
        "terms": list(layout.terms),
        "frames": layout.frames,
        "stacked": layout.stacked if layout.frames > 1 else None,
        "project": layout.project,
    }


def _stated_dict(stated: Statement) -> dict[str, Any]:
    return {
        "source": stated.source,
        "layout": layout_dict(stated.layout),
        "score": round(stated.score, 4),
        "next": round(stated.next, 4),
        "verdict": stated.verdict,
        "says": stated.says,
    }


def tell_layout(policy: Policy, robots: Sequence[Robot]) -> Told:
    """Try the plausible layouts of a policy, and what is stated beside it. Raises UsageError where it has no row."""
    trial = Trial(policy)
    ranking = rank_layouts(trial, plausible_layouts(trial.width, trial.actions, robots))
    stated = None
    if policy.signature.interface is not None:
        meant = stated_layouts(policy.signature.interface, trial.vector.name, robots, trial.actions, trial.width)
        stated = judge_layout(trial, ranking, meant) if meant else None
    layout = stated.layout if stated else (ranking.best.members[0] if ranking.best else None)
    evidence = () if layout is None else tuple(evidence_of(trial, layout))
    return Told(policy.name, ranking, evidence, stated)


def judge_layout(trial: Trial, ranking: Ranking, meant: Sequence[Layout]) -> Statement:
    """Hold what is stated against all other layouts; of several that it may mean, the one that fits best is meant."""
    scores = trial.scores([layout.mirrors() for layout in meant])
    score, layout = min(zip(scores, meant, strict=True), key=lambda pair: pair[0])
    other = next((c for c in ranking.classes if c.mirrors != layout.mirrors()), None)
    change, changed = best_change(trial, layout)
    best = min([changed, *([other.score] if other else [])])
    says, verdict = "", OPEN
    if change is not None and changed < BETTER * score and (other is None or changed <= other.score + _EQUAL):
        says = f"{change.text} ({score:.2f} → {changed:.2f})"
    elif other is not None and other.score < BETTER * score:
        says = f"{_difference(layout, other)} ({score:.2f} → {other.score:.2f})"
    if best <= HIGHEST and best <= MARGIN * score:
        verdict = DISAGREES
    chance = min(chance_score(trial, layout), other.score if other else 1.0)
    if not says and score <= HIGHEST and score <= MARGIN * chance:
        verdict = AGREES
    return Statement(layout.project, layout, score, chance, verdict, says)


def _difference(stated: Layout, other: LayoutClass) -> str:
    """What another class says otherwise, of its member that is most like what is stated."""

    def alike(member: Layout) -> int:
        return sum(
            (
                member.joints == stated.joints,
                member.stacking == stated.stacking,
                member.terms == stated.terms,
                member.robot.key == stated.robot.key,
            )
        )

    near = max(other.members, key=alike)
    words = []
    if near.stacking != stated.stacking:
        words.append(f"histories seem {near.stacked}")
    if near.robot.key != stated.robot.key:
        words.append(f"the robot seems to be {near.robot.title}")
    elif near.joints != stated.joints:
        words.append(f"the joints seem to be ordered {near.order}")
    if near.terms != stated.terms:
        words.append(f"the terms seem to be {', '.join(near.terms)}")
    return "; ".join(words) or "another layout fits better"


# ------------------------------------------------------------------ what is decided, and what stays open


def decided_facts(told: Told) -> dict[str, str]:
    """What all members of the decided class share."""
    best = told.ranking.best
    if told.layout is None or best is None:
        return {}
    members = best.members if told.stated is None else (told.stated.layout,)
    found = LayoutClass(members, best.mirrors, best.score)
    facts = {
        "robot, of those known": found.says("robot"),
        "joint order": found.says("order name"),
        "stacking": found.says("stacking"),
        "terms, but for those that mirror alike": found.says("terms"),
    }
    return {what: said[0] for what, said in facts.items() if len(said) == 1 and said[0]}


def open_facts(told: Told) -> list[dict[str, Any]]:
    """What the weights do not tell: each with what it may be, and what else speaks for one."""
    layout, best = told.layout, told.ranking.best
    if layout is None or best is None:
        return []
    found: list[dict[str, Any]] = []
    for what, fact in (("robot", "robot"), ("terms", "terms")) if told.stated is None else ():
        if len(members := best.says(fact)) > 1:
            found.append({"what": what, "members": list(members), "evidence": []})
    closed = {fact["term"] for fact in closed_facts(told)}
    for group in alike_terms(layout):
        left = [name for name in group if name not in closed]
        if len(left) > 1 or len(group) == len(left):
            says = [f"{e.says}: {'as' if e.holds else 'against'} this order" for e in told.evidence if e.term in left]
            by = f"this order is that of {layout.project}"
            found.append({"what": "which is which", "members": left, "evidence": [*says, by]})
    by = f"this order is {layout.order}"
    found += [{"what": "which is which", "members": list(g), "evidence": [by]} for g in alike_joints(layout)]
    never = ["left and right as a whole", SCALES, *([NEWEST] if layout.frames > 1 else [])]
    seen = {what: [e.says for e in told.evidence if e.term == what] for what in never}
    return [*found, *({"what": what, "members": [], "evidence": says} for what, says in seen.items())]


def closed_facts(told: Told) -> list[dict[str, str]]:
    """Which of the terms that mirror alike is which, as far as rules of evidence say it and none says otherwise."""
    names = [name for group in (alike_terms(told.layout) if told.layout else ()) for name in group]
    found = {name: [e for e in told.evidence if e.term == name] for name in names}
    return [
        {"term": name, "says": "; ".join(e.says for e in rules)}
        for name, rules in found.items()
        if rules and all(e.holds for e in told.evidence if e.term in names)
    ]


def alike_joints(layout: Layout) -> list[tuple[str, ...]]:
    """Pairs of joints whose sign the mirror changes, or keeps, each by one of its joints."""
    groups: dict[int, list[str]] = {1: [], -1: []}
    for joint in layout.joints:
        if layout.joints.index(layout.robot.partner(joint)) >= layout.joints.index(joint):
            groups[layout.robot.sign(joint)].append(joint)
    return [tuple(joints) for joints in groups.values() if len(joints) > 1]


def alike_terms(layout: Layout) -> list[tuple[str, ...]]:
    """Terms of a layout that mirror alike, so that nothing of a mirror says which is which."""
    groups: dict[object, list[str]] = {}
    for name in layout.terms:
        term = TERMS[name]
        groups.setdefault((term.signs, term.places), []).append(name)
    return [tuple(names) for names in groups.values() if len(names) > 1]
