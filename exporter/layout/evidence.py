"""What else speaks for which of the terms is which, where their mirrors are alike: rules that say what they saw.

How the bounds were chosen: of 8 public policies with a normaliser the velocities of joints have means of at most 0.01
of their deviations, positions of at least 0.16 and the last action of 0.20, and the last action spreads at least twice
as far as positions. Of 19 without one, the most that a step of another term moves the action is 1.5 times what a step
of the positions does. tests/layout/held_out.py counts how often each rule speaks of others, and how often wrongly.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from msgspec import Struct

from export_model.converters.layouts.conventions import BY_TERM
from export_model.converters.layouts.layouts import Layout, term_size
from export_model.exporter.layout.trial import Trial

POSITIONS, VELOCITIES, ACTION, GRAVITY = "joint_pos", "joint_vel", "last_action", "projected_gravity"
#: What evidence is of that is no term: which frame is the newest, and how large the numbers are.
NEWEST, SCALES = "whether the newest frame is first", "scales"
#: Gravity's last number is -1 where the robot stands; a velocity's is about 0.
_DOWN, _SMALL = -0.6, 0.3
#: Means of velocities in deviations are at most, and those of positions and actions at least.
_STILL, _BENT = 0.04, 0.1
#: The last action spreads at least this many times as far as positions. How far velocities spread says nothing: they
#: may be scaled, and a public policy's actions (1.7) spread further than its velocities (0.2).
_SPREADS = 2.0
#: A step of the positions moves the action this many times as much as one of another term; of the newest frame, too.
_STEERS = 2.2
#: Random steps are this large where there is no normaliser, rows that take them, and how much is large for any policy.
_STEP, _ROWS, _LARGE = 0.2, 64, 1e3


class Evidence(Struct, frozen=True):
    """What a rule saw of a term: whether it is what the layout says, and in which words."""

    term: str
    holds: bool
    says: str


def evidence_of(trial: Trial, layout: Layout) -> Iterator[Evidence]:
    """Yield what the policy's own normaliser, and how its action follows its numbers, say of the terms of a layout."""
    places = places_of(layout)
    alike = {name: places[name] for name in (POSITIONS, VELOCITIES, ACTION) if name in places}
    if trial.mean is not None and trial.deviation is not None:
        yield from _of_normaliser(trial.mean, trial.deviation, places, alike)
    elif len(alike) > 1:
        yield from _of_steps({name: _move(trial, numbers) for name, numbers in alike.items()})
    if layout.frames > 1:
        yield from _of_frames(trial, layout)
    yield from _of_bounds(trial)


def _of_normaliser(
    mean: np.ndarray, deviation: np.ndarray, places: Mapping[str, np.ndarray], alike: Mapping[str, np.ndarray]
) -> Iterator[Evidence]:
    """Gravity points down, joints come back to where they were, and actions are larger than what they lead to."""
    if GRAVITY in places:
        down = float(mean[places[GRAVITY][2]])
        if down < _DOWN or abs(down) < _SMALL:
            said = f"the normaliser's mean of its last number is {down:.2f}"
            yield Evidence(GRAVITY, down < _DOWN, said)
    bent = {name: float(np.sqrt(np.mean((mean[at] / deviation[at]) ** 2))) for name, at in alike.items()}
    still = [name for name, ratio in bent.items() if ratio <= _STILL]
    if len(still) == 1 < len(bent) and min(v for k, v in bent.items() if k != still[0]) >= _BENT:
        seen = ", ".join(f"{ratio:.2f} of {name}" for name, ratio in bent.items())
        yield Evidence(VELOCITIES, still[0] == VELOCITIES, f"the normaliser's means are, in deviations, {seen}")
    spread = {name: float(np.median(deviation[at])) for name, at in alike.items()}
    rest = {name: value for name, value in spread.items() if name not in still}
    if len(still) == 1 and len(rest) == 2 and max(rest.values()) >= _SPREADS * min(rest.values()):
        seen = " and ".join(f"{value:.2g} of {name}" for name, value in rest.items())
        widest = max(rest, key=rest.__getitem__)
        said = f"actions spread further than positions, and the normaliser's deviations are {seen}"
        yield Evidence(ACTION, widest == ACTION, said)


def _of_steps(moved: Mapping[str, float]) -> Iterator[Evidence]:
    """Radians are few: a step of the positions moves the action most, where one of velocities is no larger."""
    first, second = sorted(moved.values(), reverse=True)[:2]
    if first >= _STEERS * second:
        seen = ", ".join(f"{value / first:.2g} of {name}" for name, value in moved.items())
        said = f"an equal step of each number moves the action, in parts of the most, {seen}"
        yield Evidence(POSITIONS, moved.get(POSITIONS) == first, said)


def _of_frames(trial: Trial, layout: Layout) -> Iterator[Evidence]:
    """The newest frame moves the action most."""
    ends = [
        np.concatenate([at.reshape(layout.frames, -1)[end] for at in places_of(layout).values()]) for end in (0, -1)
    ]
    first, last = (_move(trial, numbers) for numbers in ends)
    if max(first, last) >= _STEERS * min(first, last) > 0:
        newest, ratio = ("first", first / last) if first > last else ("last", last / first)
        yield Evidence(NEWEST, True, f"the {newest} frame moves the action {ratio:.1f} times as much as the other end")


def _of_bounds(trial: Trial) -> Iterator[Evidence]:
    """An action that stays within bounds however large the observation is."""
    bound, further = (
        float(np.abs(trial.act(trial.observations[:, :_ROWS] * far)).max()) for far in (_LARGE, 10 * _LARGE)
    )
    if 0 < bound == further:
        yield Evidence(SCALES, True, f"the action stays within ±{bound:.3g} however large the observation is")


def _move(trial: Trial, numbers: np.ndarray) -> float:
    """How far the action moves, for a random step of each of some numbers."""
    base = trial.observations[:, :_ROWS]
    signs = np.random.default_rng(3).choice([-1.0, 1.0], (1, base.shape[1], len(numbers)))
    spread = np.ones(trial.width) if trial.deviation is None else trial.deviation
    stepped = base.copy()
    stepped[..., numbers] += _STEP * signs * spread[numbers]
    return float(np.sqrt(np.mean((trial.act(stepped) - trial.act(base)) ** 2))) / _STEP


def places_of(layout: Layout) -> dict[str, np.ndarray]:
    """Term → its numbers in the observation, those of its first frame first."""
    sizes = {name: term_size(name, len(layout.joints)) for name in layout.terms}
    frame = sum(sizes.values())
    start, found = 0, {}
    for name, size in sizes.items():
        step, first = (size, start * layout.frames) if layout.stacked == BY_TERM else (frame, start)
        found[name] = np.concatenate([first + i * step + np.arange(size) for i in range(layout.frames)])
        start += size
    return found
