"""What else speaks for which of the terms is which, where their mirrors are alike: rules that say what they saw."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from msgspec import Struct

from export_model.converters.layouts.conventions import BY_TERM
from export_model.converters.layouts.layouts import Layout, term_size
from export_model.exporter.layout.trial import Trial

#: Velocities of joints spread at least this many times as far as their positions, in radians.
_SPREADS = 2.0
#: Gravity's last number is -1 where the robot stands; a velocity's is about 0.
_DOWN, _SMALL = -0.6, 0.3


class Evidence(Struct, frozen=True):
    """What a rule saw of a term: whether it is what the layout says, and in which words."""

    term: str
    holds: bool
    says: str


def evidence_of(trial: Trial, layout: Layout) -> Iterator[Evidence]:
    """Yield what the policy's own normaliser says of the terms of a layout; nothing where it has none."""
    if trial.mean is None or trial.deviation is None:
        return
    places = first_frame(layout)
    mean = {name: trial.mean[place] for name, place in places.items()}
    spread = {name: float(np.median(trial.deviation[place])) for name, place in places.items()}
    if "projected_gravity" in places:
        down = float(mean["projected_gravity"][2])
        said = f"the normaliser's mean of its last number is {down:.2f}"
        if down < _DOWN or abs(down) < _SMALL:
            yield Evidence("projected_gravity", down < _DOWN, said)
    if {"joint_pos", "joint_vel"} <= places.keys():
        ratio = spread["joint_vel"] / max(spread["joint_pos"], 1e-9)
        said = f"the normaliser's deviations of joint_vel are {ratio:.1f} times those of joint_pos"
        if ratio >= _SPREADS or ratio <= 1 / _SPREADS:
            yield Evidence("joint_vel", ratio >= _SPREADS, said)


def first_frame(layout: Layout) -> dict[str, slice]:
    """Term → where the numbers of its first frame are."""
    start, found = 0, {}
    for name in layout.terms:
        size = term_size(name, len(layout.joints))
        found[name] = slice(start, start + size)
        start += size * (layout.frames if layout.stacked == BY_TERM else 1)
    return found
