"""What is played in: many episodes side by side, each begun from a seed of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np
from msgspec import Struct

from export_model.exporter.play.environments import ENVIRONMENTS
from export_model.exporter.play.environments.base import Environment, Observation
from export_model.exporter.play.environments.tennis import BRAINS
from export_model.exporter.serve.scenes import SCENES, PageScene
from export_model.signatures.errors import UsageError
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature

Array = np.ndarray


class WorldView(Struct, frozen=True):
    """What the agents see, a row for each episode: ``observations`` by the policy's names of them."""

    observations: Mapping[str, Array]
    #: float32 [episodes, ΣB], 1 allows an action; None where all are allowed
    masks: Array | None = None


class StepOutcome(Struct, frozen=True):
    """What came of a step: ``rewards`` float64, ``ended`` and ``success`` bool, [episodes] each."""

    view: WorldView
    rewards: Array
    ended: Array
    success: Array


class World(Protocol):
    """Episodes side by side. A row whose episode has ended goes on being played, and nothing of it counts."""

    #: what reports call it
    name: str
    #: what a reader of a report should know of it
    notes: tuple[str, ...]

    def begin(self, episodes: int, seed: int) -> WorldView:
        """Begin so many episodes; the same seed begins the same ones."""

    def step(self, continuous: Array | None, discrete: Array | None) -> StepOutcome:
        """Advance all by one decision: float32 [episodes, size], int64 [episodes, branches]."""


#: The world for a policy; raises UsageError where the policy does not fit it.
MakeWorld = Callable[[PolicySignature], World]
#: What the other player of a world for two does: its actions, from what it sees.
Decide = Callable[[Observation], Array]


class OwnWorld:
    """One of the environments of this package; in one for two, ``partner`` plays the other side."""

    def __init__(
        self, scene: PageScene, signature: PolicySignature, partner: Decide, notes: tuple[str, ...] = ()
    ) -> None:
        self.name, self.notes = scene.name, notes
        (self._observation,) = (s.name for s in signature.observations)
        self._masked = any(s.role is Role.MASKS for s in signature.inputs)
        self._brain = None if scene.side is None else BRAINS[scene.side == "right"]
        self._partner = partner
        self._environment: Environment | None = None

    def begin(self, episodes: int, seed: int) -> WorldView:
        """Begin so many episodes, by the environment's own generator."""
        self._environment = ENVIRONMENTS[self.name](episodes)
        seen, _ = self._environment.reset(seed=seed)
        return self._view(seen)

    def step(self, continuous: Array | None, discrete: Array | None) -> StepOutcome:
        """Advance all by one decision."""
        assert self._environment is not None, "begin comes before step"
        action = discrete if continuous is None else continuous
        taken: object = action
        if self._brain is not None:
            taken = {self._brain: action, self._other: self._partner(self._seen[self._other])}
        seen, rewards, terminated, truncated, info = self._environment.step(taken)
        if self._brain is not None:
            rewards = rewards[:, BRAINS.index(self._brain)]
        return StepOutcome(self._view(seen), rewards, terminated | truncated, info["success"])

    @property
    def _other(self) -> str:
        return BRAINS[1 - BRAINS.index(str(self._brain))]

    def _view(self, seen: Observation) -> WorldView:
        self._seen = seen
        own = seen if self._brain is None else seen[self._brain]
        return WorldView({self._observation: own["state"]}, own.get("action_masks") if self._masked else None)


def own_scene(name: str, signature: PolicySignature) -> PageScene:
    """Return the environment of this package that a policy fits. Raises UsageError."""
    scenes = [s for s in SCENES if s.name == name]
    found = next((s for s in scenes if s.fits(signature)), None)
    if found is None:
        raise UsageError(
            f"--env {name}: the policy does not fit the environment",
            why=f"the environment needs {' or '.join(s.shapes_text for s in scenes)}; the policy is {signature.flow}",
            fix="choose an environment that the policy was trained in",
        )
    return found
