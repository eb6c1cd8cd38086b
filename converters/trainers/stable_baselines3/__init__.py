"""Policies of Stable-Baselines3, sb3-contrib and SBX, whose settings (``data``) lie beside the weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from export_model.converters.trainers.stable_baselines3.normaliser import read_normaliser
from export_model.converters.trainers.stable_baselines3.policy import to_graph
from export_model.converters.trainers.stable_baselines3.sbx import is_sbx, read_sbx
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer
from export_model.signatures.errors import NotAPolicyError


def _rebuild(saved: Saved, data: Mapping[str, Any]) -> Rebuilt:
    archive, data = read_sbx(data) if is_sbx(data) else (saved.archive, data)
    if not isinstance(archive.value, dict) or not archive.value:
        raise NotAPolicyError(
            "its policy.pth must be a state dictionary",
            why="model.save writes one",
            fix="save the model again: model.save",
        )
    normaliser = None if saved.statistics is None else read_normaliser(*saved.statistics)
    graph, facts, modules = to_graph(data, archive, archive.value, saved.activation, normaliser)
    return Rebuilt(graph, facts, modules=modules)


TRAINER = Trainer("Stable-Baselines3", lambda saved: saved.settings, _rebuild, by_names=False)
