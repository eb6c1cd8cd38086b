"""Layouts: a robot's joints in an order, the terms of its observation, how frames are stacked, and mirrors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TypeAlias

from msgspec import Struct

from export_model.converters.layouts.conventions import BY_FRAME, BY_TERM, CONVENTIONS, Convention
from export_model.converters.layouts.robots import ROBOTS, Robot
from export_model.converters.layouts.terms import NOTHING, PER_JOINT, TERMS, Mirror, mirror_of_joints, mirror_of_term

#: The mirror of the observation, and that of the action.
Mirrors: TypeAlias = tuple[Mirror, Mirror]


class Layout(Struct, frozen=True):
    """One way to read a policy's numbers: joints in an order, terms in an order, frames, and who writes it so."""

    robot: Robot
    order: str
    joints: tuple[str, ...]
    terms: tuple[str, ...]
    frames: int
    stacked: str
    project: str

    @property
    def width(self) -> int:
        """Numbers of the observation."""
        return self.frames * sum(term_size(name, len(self.joints)) for name in self.terms)

    @property
    def stacking(self) -> str:
        """``5 frames, term by term``; nothing for the present alone."""
        return f"{self.frames} frames, {self.stacked}" if self.frames > 1 else ""

    def mirrors(self) -> Mirrors:
        """The mirrors of the observation and of the action."""
        return self.mirrors_with(mirror_of_joints(self.robot, self.joints))

    def mirrors_with(self, joints: Mirror, turned: str = "") -> Mirrors:
        """The same with another mirror of the joints, and the term ``turned`` with all signs changed."""
        parts = [mirror_of_term(TERMS[name], joints, turned=name == turned) for name in self.terms]
        by_term = [part for part in parts for _ in range(self.frames)]
        observation = NOTHING
        for part in by_term if self.stacked == BY_TERM else parts * self.frames:
            observation = observation.joined(part)
        return observation, joints


def term_size(name: str, joints: int) -> int:
    """Numbers of one frame of a term."""
    signs = TERMS[name].signs
    return joints if signs == PER_JOINT else len(signs)


def plausible_layouts(
    width: int, actions: int, robots: Sequence[Robot] = ROBOTS, conventions: Iterable[Convention] = CONVENTIONS
) -> Iterator[Layout]:
    """Yield the layouts of known conventions, for robots with ``actions`` joints, that have ``width`` numbers."""
    conventions = tuple(conventions)
    for robot in robots:
        if len(robot.joints) != actions:
            continue
        for order, joints in robot.all_orders().items():
            for convention in conventions:
                frame = sum(term_size(name, actions) for name in convention.terms)
                frames, rest = divmod(width, frame)
                if rest or not (frames in convention.frames or (frames > 1 and max(convention.frames) > 1)):
                    continue
                for stacked in convention.stacked if frames > 1 else (BY_FRAME,):
                    yield Layout(
                        robot,
                        order,
                        joints,
                        convention.terms,
                        frames=frames,
                        stacked=stacked,
                        project=convention.project,
                    )
