"""The actor of ML-Agents' PyTorch trainers, 0.20 to 1.1."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from export_model.converters.trainers.mlagents.policy import rebuild
from export_model.converters.trainers.mlagents.state import State, actor_in
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer


def _rebuild(saved: Saved, policy: Mapping[Any, Any]) -> Rebuilt:
    saved.refuse_activation("ML-Agents", "its networks have Swish")
    return rebuild(State(saved.archive, policy), saved.given, saved.sensors, saved.goals)


TRAINER = Trainer("ML-Agents", lambda saved: actor_in(saved.value), _rebuild)
