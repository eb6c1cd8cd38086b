"""Environments by name: those of this package, Gymnasium's, and the user's own code."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from export_model.exporter.acting.loading import load_policy
from export_model.exporter.play.environments import ENVIRONMENTS
from export_model.exporter.play.environments.base import Observation
from export_model.exporter.play.environments.tennis import follow_ball
from export_model.exporter.play.gymnasium_world import gymnasium_maker, own_maker
from export_model.exporter.play.worlds import Decide, MakeWorld, OwnWorld, World, own_scene
from export_model.exporter.serve.scenes import SCENES, other_side
from export_model.signatures.contract import POLICY
from export_model.signatures.errors import UsageError
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature


def world_maker(env: str, place: Path, partner: Path | str | None = None) -> MakeWorld:
    """Return what makes the world called ``env`` for a policy at ``place``. Raises UsageError where there is none."""
    name = next((n for n in ENVIRONMENTS if n.casefold() == env.casefold()), None)
    if partner is not None and all(s.side is None for s in SCENES if s.name == name):
        raise UsageError(f"--partner does not go with --env {env}", why="one policy plays there", fix="leave it out")
    if name is None:
        return own_maker(env) if ":" in env else gymnasium_maker(env, list(ENVIRONMENTS))

    def make(signature: PolicySignature) -> World:
        scene = own_scene(name, signature)
        if scene.side is None:
            return OwnWorld(scene, signature, _nobody)
        return OwnWorld(scene, signature, *_partner(place, scene.side, partner))

    return make


def _partner(place: Path, side: str, partner: Path | str | None) -> tuple[Decide, tuple[str, ...]]:
    """Return the player of the other side, and what a report says of it."""
    beside = [place.absolute().parent / name for name in other_side(place.absolute().name)]
    found = next((p for p in beside if (p / POLICY).is_file()), None) if partner is None else Path(partner)
    if found is None:
        other = "RightBrain" if side == "left" else "LeftBrain"
        return lambda seen: follow_ball(other, seen), (f"the other side, {other}, is a player that follows the ball",)
    policy = load_policy(found)
    masked = policy.takes(Role.MASKS)

    def decide(seen: Observation) -> np.ndarray:
        masks = seen.get("action_masks") if masked else None
        return policy.decide(seen["state"], masks=masks, deterministic=True).action

    return decide, (f"the other side is {policy.name}, in {policy.runtime}, without chance",)


def _nobody(seen: Observation) -> np.ndarray:
    raise AssertionError("one policy plays alone")
