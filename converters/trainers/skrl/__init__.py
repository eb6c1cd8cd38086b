"""Checkpoints of skrl (``checkpoints/agent_<n>.pt``; Isaac Lab), with the ``agent.yaml`` of their run.

Source: skrl/agents/torch/base.py (``write_checkpoint``), utils/runner/torch/runner.py, utils/model_instantiators/torch
and resources/preprocessors/torch of 1.4 and 2.1. ``{"policy": state, "value": state, "observation_preprocessor": …}``;
up to 1.4 the observations were called states, and so their preprocessor.
"""

from __future__ import annotations

from typing import Any

from export_model.converters.trainers.settings import needed_settings
from export_model.converters.trainers.skrl.policy import PREPROCESSORS, rebuild_policy
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer

_FILES = ("params/agent.yaml", "agent.yaml")


def _policy_of(saved: Saved) -> dict[Any, Any] | None:
    """Return the policy's state dictionary; None where the checkpoint is not of skrl."""
    value = saved.value
    state = value.get("policy") if isinstance(value, dict) else None
    if not isinstance(state, dict):
        return None
    generated = any(isinstance(name, str) and "_container." in name for name in state)
    beside = any(key in value for key in PREPROCESSORS)
    return state if generated or beside or "log_std_parameter" in state else None


def _rebuild(saved: Saved, state: dict[Any, Any]) -> Rebuilt:
    settings, file = needed_settings(
        saved,
        "skrl",
        _FILES,
        ("models",),
        why="layers and activations are recorded only in the run's settings (models)",
        fix="put the run's params/agent.yaml next to the checkpoint; a model of a custom class: "
        "export it there (torch.onnx.export), and give the .onnx",
    )
    graph, facts = rebuild_policy(saved, state, settings)
    return Rebuilt(graph, facts, (file,))


TRAINER = Trainer("skrl", _policy_of, _rebuild)
