"""Policies of Stable-Baselines3 and sb3-contrib, whose settings (``data``) lie beside the weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from converters.trainers.stable_baselines3.normaliser import read_normaliser
from converters.trainers.stable_baselines3.policy import to_graph
from converters.trainers.trainer import Rebuilt, Saved, Trainer
from signatures.errors import NotAPolicyError


def _rebuild(saved: Saved, data: Mapping[str, Any]) -> Rebuilt:
    if not isinstance(saved.value, dict):
        raise NotAPolicyError(
            "its policy.pth must be a state dictionary",
            why="model.save writes one",
            fix="save the model again: model.save",
        )
    normaliser = None if saved.statistics is None else read_normaliser(*saved.statistics)
    return Rebuilt(*to_graph(data, saved.archive, saved.value, saved.activation, normaliser))


TRAINER = Trainer("Stable-Baselines3", lambda saved: saved.settings, _rebuild, by_names=False)
