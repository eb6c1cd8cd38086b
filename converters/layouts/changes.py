"""Small changes of a layout that its mirror can tell: two joints of one side exchanged, a joint or a term turned."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

from msgspec import Struct

from export_model.converters.layouts.layouts import Layout, Mirrors
from export_model.converters.layouts.terms import PER_JOINT, TERMS, Mirror, mirror_of_joints


class Change(Struct, frozen=True):
    """What would be otherwise, as a sentence with ``seem`` or ``seems``."""

    kind: str
    names: tuple[str, ...]
    text: str


def changes_of(layout: Layout) -> Iterator[tuple[Change, Mirrors]]:
    """Yield every small change with the mirrors of the layout that it leads to, each pair of mirrors once."""
    seen = {layout.mirrors()}
    for change, joints, turned in (*_exchanges(layout), *_turns(layout), *_terms(layout)):
        mirrors = layout.mirrors_with(joints, turned)
        if mirrors not in seen:
            seen.add(mirrors)
            yield change, mirrors


def _exchanges(layout: Layout) -> Iterator[tuple[Change, Mirror, str]]:
    """Two joints of one side in each other's place: each then mirrors as the joint that is really there."""
    robot, joints = layout.robot, layout.joints
    index = {joint: i for i, joint in enumerate(joints)}
    own = mirror_of_joints(robot, joints)
    for side in (robot.one_side, [robot.partner(j) for j in robot.one_side]):
        for a, b in combinations(side, 2):
            places, signs = list(own.places), list(own.signs)
            for here, real in ((a, b), (b, a)):
                partner = index[robot.partner(real)]
                for i, j in ((index[here], partner), (partner, index[here])):
                    places[i], signs[i] = j, robot.sign(real)
            alike = robot.sign(a) == robot.sign(b)
            either = f", or {robot.partner(a)} and {robot.partner(b)}," if alike else ""
            yield (
                Change("exchanged", (a, b), f"{a} and {b}{either} seem exchanged"),
                Mirror(tuple(places), tuple(signs)),
                "",
            )


def _turns(layout: Layout) -> Iterator[tuple[Change, Mirror, str]]:
    """One joint of a pair about the other direction than is known of the robot."""
    own = mirror_of_joints(layout.robot, layout.joints)
    for i, joint in enumerate(layout.joints):
        if own.places[i] >= i:
            signs = [-s if j in (i, own.places[i]) else s for j, s in enumerate(own.signs)]
            text = f"the sign of {joint} seems to be another"
            yield Change("turned", (joint,), text), Mirror(own.places, tuple(signs)), ""


def _terms(layout: Layout) -> Iterator[tuple[Change, Mirror, str]]:
    """A term with the other signs: a velocity where a rate of turning is said to be."""
    own = mirror_of_joints(layout.robot, layout.joints)
    for name in layout.terms:
        if TERMS[name].signs != PER_JOINT:
            yield Change("term", (name,), f"{name} seems to be another quantity"), own, name
