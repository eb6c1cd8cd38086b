"""Checkpoints of rl_games (``nn/<name>.pth``; Isaac Lab, IsaacGymEnvs), with the ``agent.yaml`` of their run.

Source: rl_games/algos_torch/{network_builder,models,players,running_mean_std,sac_helper,torch_ext}.py of 1.6.5.
``torch_ext.save_checkpoint`` writes ``{"model": state, "epoch": …}``, of SAC ``{"actor": state, "critic": …}``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from export_model.converters.trainers.rl_games.policy import rebuild_actor_critic, rebuild_soft_actor
from export_model.converters.trainers.settings import needed_settings
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer

#: Where a run keeps its settings: Isaac Lab, rl_games itself, IsaacGymEnvs (below ``train``).
_FILES = ("params/agent.yaml", "agent.yaml", "config.yaml")
_KEYS = ("params", "train")
#: What torch.compile puts before each name, in checkpoints of training that was compiled.
_COMPILED = "_orig_mod."
_NETWORK = "a2c_network."


def _states_of(saved: Saved) -> dict[str, Mapping[Any, Any]] | None:
    """Return the state dictionaries of a checkpoint, by their keys; None where it is not of rl_games."""
    value = saved.value
    if not isinstance(value, dict):
        return None
    keys = ("model", "actor", "running_mean_std")
    states: dict[str, Mapping[Any, Any]] = {key: state for key in keys if (state := _without_compiled(value.get(key)))}
    if any(name.startswith(_NETWORK) for name in states.get("model", ())):
        return states
    if "critic_target" in value and any(name.startswith("trunk.") for name in states.get("actor", ())):
        return states
    return None


def _without_compiled(state: Any) -> dict[str, Any]:
    if not isinstance(state, dict):
        return {}
    return {k.removeprefix(_COMPILED): v for k, v in state.items() if isinstance(k, str)}


def _rebuild(saved: Saved, states: dict[str, Mapping[Any, Any]]) -> Rebuilt:
    settings, file = needed_settings(
        saved,
        "rl_games",
        _FILES,
        _KEYS,
        why="activations, memory and deviation are recorded only in the run's settings",
        fix="put the run's params/agent.yaml (Isaac Lab) or config.yaml next to the checkpoint, or give the .pth "
        "where the run left it",
    )
    params = settings.section("train") if "train" in settings else settings
    params = params.section("params")
    build = rebuild_actor_critic if "model" in states else rebuild_soft_actor
    graph, facts = build(saved, states, params)
    return Rebuilt(graph, facts, (file,))


TRAINER = Trainer("rl_games", _states_of, _rebuild)
