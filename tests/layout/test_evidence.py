"""Rules of evidence that ask how the action follows the numbers: positions, the newest frame, bounds of the action."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.layouts.layouts import Layout, plausible_layouts
from export_model.exporter.layout.evidence import NEWEST, SCALES, evidence_of, places_of
from tests.layout.networks import Network

LAB = "robot_lab, unitree_rl_lab"


def layout_of(width: int, stacked: str = "") -> Layout:
    return next(
        layout
        for layout in plausible_layouts(width, 12)
        if (layout.robot.key, layout.project) == ("go2", LAB) and stacked in ("", layout.stacked)
    )


def network_with(numbers: np.ndarray, factor: float, width: int) -> Network:
    """A random network that some numbers move more than the others."""
    trial = Network(width, 12, 0)
    trial._weights[0][numbers] *= factor
    return trial


@pytest.mark.parametrize(("name", "holds"), [("joint_pos", True), ("joint_vel", False), ("last_action", False)])
def test_what_moves_the_action_most_are_positions(name: str, holds: bool) -> None:
    layout = layout_of(45)
    trial = network_with(places_of(layout)[name], 5, 45)
    (found,) = [e for e in evidence_of(trial, layout) if e.term == "joint_pos"]
    assert found.holds is holds
    assert f"1 of {name}" in found.says
    assert not [e for e in evidence_of(Network(45, 12, 0), layout) if e.term == "joint_pos"]


@pytest.mark.parametrize("stacked", ["term by term", "frame by frame"])
@pytest.mark.parametrize(("end", "said"), [(0, "the first frame"), (-1, "the last frame")])
def test_the_newest_frame_moves_the_action_most(stacked: str, end: int, said: str) -> None:
    layout = layout_of(225, stacked)
    places = places_of(layout)
    assert sorted(np.concatenate([*places.values()])) == list(range(225))
    trial = network_with(np.concatenate([at.reshape(5, -1)[end] for at in places.values()]), 6, 225)
    (found,) = [e for e in evidence_of(trial, layout) if e.term == NEWEST]
    assert found.says.startswith(said)
    assert not [e for e in evidence_of(Network(225, 12, 0), layout) if e.term == NEWEST]


def test_places_are_those_of_the_mirror() -> None:
    """Term by term and frame by frame, the numbers of gravity keep, turn and keep their signs."""
    for stacked in ("term by term", "frame by frame"):
        layout = layout_of(225, stacked)
        signs = np.array(layout.mirrors()[0].signs)
        assert signs[places_of(layout)["projected_gravity"]].reshape(5, 3).tolist() == [[1, -1, 1]] * 5
        assert replace(layout, stacked=stacked) == layout


def test_bounds_of_the_action_are_named() -> None:
    class Bounded(Network):
        def act(self, observations: np.ndarray) -> np.ndarray:
            made: np.ndarray = np.clip(super().act(observations), -0.5, 0.5)
            return made

    (found,) = [e for e in evidence_of(Bounded(45, 12, 0), layout_of(45)) if e.term == SCALES]
    assert found.says == "the action stays within ±0.5 however large the observation is"
