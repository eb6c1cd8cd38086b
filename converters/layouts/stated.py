"""What an interface states of a layout: the files beside a policy, or one of the user's, as layouts to try."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence

from export_model.converters.layouts.conventions import BY_FRAME, BY_TERM
from export_model.converters.layouts.layouts import Layout
from export_model.converters.layouts.robots import Robot
from export_model.converters.layouts.terms import NAMES
from export_model.signatures.interface import Interface, Quantity, Term

#: How an order is called that a file states, and a term of one frame where frames stand one after the other.
STATED, _FRAME = "as stated", re.compile(r"(.+) \(frame (\d+) of (\d+)\)")
#: The quantity of Unitree's deploy.yaml that states the order of joints by numbers.
_PLACES = "place of each joint in the robot's own order"


def frame_name(name: str, frame: int, frames: int) -> str:
    """The name of a term's one frame, from 1."""
    return f"{name} (frame {frame} of {frames})"


def stated_layouts(
    interface: Interface, observation: str, robots: Sequence[Robot], actions: int, width: int
) -> list[Layout]:
    """The layouts that an interface may mean, none where it states no order of terms, or terms that are not known.

    Without names of joints any robot with ``actions`` joints may be meant, in the order of its model file.
    """
    terms = interface.observations.get(observation, ())
    read = _terms(terms)
    if read is None:
        return []
    names, frames, stacked = read
    if (
        len({term.elements for term in (*terms, *interface.actions, *interface.baked) if len(term.elements) == actions})
        > 1
    ):
        return []  # joints in another order than the actions: no layout here has two
    found = [
        Layout(robot, STATED, joints, names, frames=frames, stacked=stacked, project=terms[0].source)
        for robot, joints in _joints(interface, terms, robots, actions)
    ]
    return [layout for layout in found if layout.width == width]


def _terms(terms: Sequence[Term]) -> tuple[tuple[str, ...], int, str] | None:
    """Names of terms, frames and their stacking; None where one is not known, or frames differ from term to term."""
    apart = [_FRAME.fullmatch(term.name) for term in terms]
    frames = {term.history or 1 for term in terms}
    if not terms or len(frames) != 1:
        return None
    if all(apart):
        count = int(apart[0][3]) if apart[0] else 1
        plain = [m[1] for m in apart if m][: len(terms) // count]
        stacked, number = BY_FRAME, count
    else:
        plain, stacked, number = [term.name for term in terms], BY_TERM, frames.pop()
    names = tuple(NAMES.get(name.lower(), "") for name in plain)
    return None if "" in names else (names, number, stacked)


def _joints(
    interface: Interface, terms: Iterable[Term], robots: Sequence[Robot], actions: int
) -> Iterator[tuple[Robot, tuple[str, ...]]]:
    """The robots that may be meant, each with its joints in the stated order."""
    able = [robot for robot in robots if len(robot.joints) == actions]
    entries: tuple[Term | Quantity, ...] = (*interface.actions, *interface.baked, *terms, *interface.quantities)
    named = next((e.elements for e in entries if len(e.elements) == actions), ())
    places = next((q.values for q in interface.quantities if q.name == _PLACES), ())
    for robot in able:
        own = {_plain(joint): joint for joint in robot.joints}
        if named:
            joints = tuple(own.get(_plain(name), "") for name in named)
            if set(joints) == set(robot.joints):
                yield robot, joints
        elif not places:
            yield robot, robot.joints
        elif len({*places}) == len(places) == actions:
            ranks = sorted(places)  # slots of a robot that may have more joints, in its own order
            for order in (robot.joints, *robot.orders.values()):
                yield robot, tuple(order[ranks.index(place)] for place in places)


def _plain(name: str) -> str:
    """A joint's name without what exporters add to it."""
    return name.lower().removesuffix("_joint")
