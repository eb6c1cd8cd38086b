"""Terms of observations, each with how it mirrors in the plane between left and right.

A vector of the base keeps x and z and changes y; a rate of turning keeps y and changes x and z, as an axis of rotation
does. A gait's clock mirrors into the other half of its period, where sine and cosine have the other sign.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from msgspec import Struct

from export_model.converters.layouts.robots import Robot

#: Of each joint that the policy moves.
PER_JOINT = "joints"


class LayoutTerm(Struct, frozen=True):
    """A term by its name here.

    - ``signs``: one for each number, or ``PER_JOINT``.
    - ``places``: whose place each number takes, where it is not its own.
    - ``called``: what projects call it.
    """

    name: str
    signs: str
    says: str
    places: tuple[int, ...] = ()
    called: tuple[str, ...] = ()


def _grid(rows: int, columns: int, *, lateral_first: bool) -> tuple[int, ...]:
    """Places of a grid of heights mirrored: ``rows`` along x, ``columns`` along y."""
    numbers = np.arange(rows * columns)
    grid = numbers.reshape((columns, rows)).T if lateral_first else numbers.reshape((rows, columns))
    mirrored = grid[:, ::-1]
    return tuple(int(n) for n in (mirrored.T if lateral_first else mirrored).ravel())


_HEIGHTS = 17 * 11

TERMS: Mapping[str, LayoutTerm] = {
    term.name: term
    for term in (
        LayoutTerm(
            "base_lin_vel",
            "+-+",
            "the base's velocity, in its own frame",
            called=(
                "lin_vel",
                "linear_velocity",
            ),
        ),
        LayoutTerm(
            "base_ang_vel",
            "-+-",
            "its rate of turning",
            called=(
                "ang_vel",
                "angular_velocity",
                "gyro",
            ),
        ),
        LayoutTerm(
            "projected_gravity",
            "+-+",
            "which way is down, in its own frame",
            called=(
                "gravity_vec",
                "gravity",
                "gravity_orientation",
            ),
        ),
        LayoutTerm("base_euler", "-+-", "roll, pitch and yaw"),
        LayoutTerm(
            "velocity_commands",
            "+--",
            "velocity forwards and sideways and rate of turning that are wanted",
            called=(
                "commands",
                "command",
                "velocity_command",
                "keyboard_velocity_commands",
                "generated_commands",
                "cmd",
            ),
        ),
        LayoutTerm("command_lin_vel", "+-", "velocity that is wanted"),
        LayoutTerm("command_ang_vel", "-", "rate of turning that is wanted"),
        LayoutTerm(
            "joint_pos",
            PER_JOINT,
            "positions of the joints",
            called=(
                "joint_pos_rel",
                "dof_pos",
                "joint_positions",
            ),
        ),
        LayoutTerm(
            "joint_vel",
            PER_JOINT,
            "velocities of the joints",
            called=(
                "joint_vel_rel",
                "dof_vel",
                "joint_velocities",
            ),
        ),
        LayoutTerm(
            "last_action",
            PER_JOINT,
            "the action of the step before",
            called=(
                "actions",
                "action",
                "prev_action",
            ),
        ),
        LayoutTerm("gait_phase", "--", "sine and cosine of the gait's clock", called=("phase",)),
        LayoutTerm("gait_phase_of_legs", "++++", "cosine of each leg's clock, then sine", (1, 0, 3, 2)),
        LayoutTerm("cos_phase", "++", "cosine of each leg's clock", (1, 0)),
        LayoutTerm("sin_phase", "++", "sine of each leg's clock", (1, 0)),
        LayoutTerm("foot_contacts", "++++", "whether each of four feet touches the ground", (1, 0, 3, 2)),
        LayoutTerm("heights", "+" * _HEIGHTS, "17 × 11 heights, along y first", _grid(17, 11, lateral_first=False)),
        LayoutTerm("height_scan", "+" * _HEIGHTS, "17 × 11 heights, along x first", _grid(17, 11, lateral_first=True)),
    )
}


#: What a term is called anywhere → its name here.
NAMES: Mapping[str, str] = {word: term.name for term in TERMS.values() for word in (term.name, *term.called)}


class Mirror(Struct, frozen=True):
    """A mirror of a vector: number ``i`` of the image is ``signs[i]`` times number ``places[i]``."""

    places: tuple[int, ...]
    signs: tuple[int, ...]

    def apply(self, rows: np.ndarray) -> np.ndarray:
        """The images of vectors [..., n]."""
        image: np.ndarray = rows[..., list(self.places)] * np.array(self.signs, rows.dtype)
        return image

    def joined(self, other: Mirror) -> Mirror:
        """The mirror of two vectors side by side."""
        start = len(self.places)
        return Mirror((*self.places, *(start + p for p in other.places)), (*self.signs, *other.signs))


NOTHING = Mirror((), ())


def mirror_of_joints(robot: Robot, joints: Sequence[str]) -> Mirror:
    """The mirror of a number for each joint."""
    index = {joint: i for i, joint in enumerate(joints)}
    return Mirror(tuple(index[robot.partner(j)] for j in joints), tuple(robot.sign(j) for j in joints))


def mirror_of_term(term: LayoutTerm, joints: Mirror, *, turned: bool = False) -> Mirror:
    """The mirror of one frame of a term; ``turned``: with the other signs."""
    if term.signs == PER_JOINT:
        return joints
    kept = "-" if turned else "+"
    signs = tuple(1 if sign == kept else -1 for sign in term.signs)
    return Mirror(term.places or tuple(range(len(signs))), signs)
