"""Which policies have an environment that the page can draw: by name, observations and actions."""

from __future__ import annotations

import re
from collections.abc import Sequence

from msgspec import Struct

from export_model.signatures.errors import UsageError
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature

AUTO, NONE = "auto", "none"


class PageScene(Struct, frozen=True):
    """``page/scenes/<id>.mjs``. ``side`` is the part of a scene that two policies play in."""

    id: str
    name: str
    observations: int
    continuous: int = 0
    branches: tuple[int, ...] = ()
    memory: bool = False
    side: str | None = None

    def fits(self, signature: PolicySignature) -> bool:
        """Whether a policy observes and does what this environment gives and takes."""
        seen = [(s.role, s.shape) for s in signature.observations]
        plain = {Role.MASKS, Role.PREV_ACTION, Role.NOISE, Role.MEMORY_IN, Role.VECTOR}
        sizes = {"continuous": self.continuous, "discrete": 0}
        head = signature.outputs[0].shape
        return (
            seen == [(Role.VECTOR, (None, self.observations))]
            and {s.role for s in signature.inputs} <= plain
            and signature.action_space == ("continuous" if self.continuous else "discrete")
            and signature.branches == self.branches
            and (not sizes[signature.action_space] or head[-1] == self.continuous)
            and (signature.memory is not None) <= self.memory
        )

    @property
    def shapes_text(self) -> str:
        """The shapes, for an error."""
        does = f"{self.continuous} continuous actions" if self.continuous else f"branches {list(self.branches)}"
        return f"{self.observations} observations, {does}"


SCENES = (
    PageScene("ball3d", "3DBall", 8, continuous=2),
    PageScene("gridworld", "GridWorld", 6, branches=(4,)),
    PageScene("hallway", "Hallway", 4, branches=(3,), memory=True),
    PageScene("tennis", "Tennis", 5, branches=(3,), side="left"),
    PageScene("tennis", "Tennis", 5, continuous=1, side="right"),
    PageScene("crawler2d", "Crawler2D", 26, continuous=8),
)
"""The environments of exporter/play/environments: after examples of ML-Agents, but for Crawler2D. That is the name and
shape of no example, so that a policy of ML-Agents' Crawler, which another physics made, does not end here.
"""


def scene_of(name: str, signature: PolicySignature, asked: str = AUTO) -> PageScene | None:
    """The scene for a policy called ``name``; None: there is none. Raises UsageError where ``asked`` does not fit."""
    if asked == NONE:
        return None
    if asked == AUTO:
        bare = _bare(name)
        return next((s for s in SCENES if _bare(s.name) in bare and s.fits(signature)), None)
    named = [s for s in SCENES if s.id == asked]
    found = next((s for s in named if s.fits(signature)), None)
    if found is None:
        raise UsageError(
            f"--scene {asked}: the policy does not fit the environment",
            why=f"it takes {' or '.join(s.shapes_text for s in named)}",
            fix="leave --scene out, or --scene none for the panel",
        )
    return found


def other_side(name: str) -> Sequence[str]:
    """What the bundle of the other player may be called: Tennis-LeftBrain → Tennis-RightBrain."""
    swaps = (("Left", "Right"), ("Right", "Left"), ("left", "right"), ("right", "left"))
    return [name.replace(a, b) for a, b in swaps if a in name]


def _bare(name: str) -> str:
    return re.sub("[^a-z0-9]", "", name.casefold())
