"""The list of trainers: all that there is to register. A room's ``TRAINER`` says what it recognises and rebuilds."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from typing import Any

from export_model.converters.files.unpickle import PickledTensor
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer
from export_model.signatures.errors import NotAPolicyError, UsageError

#: Rooms of ``converters/trainers``, in the order in which they are asked.
ROOMS = (
    "rllib",
    "brax",
    "stable_baselines3",
    "mlagents",
    "fast_td3",
    "rsl_rl",
    "rl_games",
    "skrl",
    "sample_factory",
    "scripts",
)
TRAINERS: tuple[Trainer, ...] = tuple(
    importlib.import_module(f"export_model.converters.trainers.{room}").TRAINER for room in ROOMS
)
#: How a tensor's name begins in the checkpoints of trainers whose networks are not rebuilt (Tianshou 2, RLlib 2).
_OTHERS: Mapping[str, str] = {
    **dict.fromkeys(("actor.preprocess.", "model.model.model."), "Tianshou"),
    **dict.fromkeys(("encoder.actor_encoder.", "_logits._model.", "_hidden_layers.0._model."), "RLlib"),
}


def rebuild(saved: Saved) -> Rebuilt:
    """The policy of the first trainer that knows what was saved.

    Raises NotAPolicyError where none does, UsageError where it has no scripts and one is named, and what it raises.
    """
    for trainer in TRAINERS:
        found = trainer.recognise(saved)
        if found is not None:
            if saved.script is not None and not trainer.scripts:
                raise UsageError(
                    f"--script says nothing about a checkpoint of {trainer.label}",
                    why="the names in it tell what computes it",
                    fix="leave it out",
                )
            return trainer.rebuild(saved, found)
    raise _unknown_error(saved.value)


def _unknown_error(value: Any) -> NotAPolicyError:
    if maker := _other_trainer(value):
        return NotAPolicyError(
            f"is a checkpoint of {maker}, whose networks are not rebuilt",
            why=f"it holds weights ({_content(value)}); their layers and activations are recorded only in the "
            "run's configuration and code",
            fix=f"load it in {maker}, export the module that gives the action (torch.onnx.export, the "
            "observation's normaliser included), and give the .onnx",
        )
    *labels, last = (t.label for t in TRAINERS if t.by_names)
    return NotAPolicyError(
        "must be a checkpoint of a policy whose network is known",
        why=f"it holds {_content(value)}, not the names that {', '.join(labels)} or {last} give; a state "
        "dictionary does not say what is computed with it",
        fix="export the model to ONNX in its own project (torch.onnx.export), and give that; of "
        "Stable-Baselines3 give the .zip that model.save wrote",
    )


def _other_trainer(value: Any) -> str:
    """Who else wrote it, by its tensors' names."""
    names = [n for n in value if isinstance(n, str)] if isinstance(value, dict) else []
    for part in ("model", "policy"):
        inner = value.get(part) if names else None
        names += [n for n in inner if isinstance(n, str)] if isinstance(inner, dict) else []
    return next((maker for start, maker in _OTHERS.items() if any(n.startswith(start) for n in names)), "")


def _content(value: Any) -> str:
    if not isinstance(value, dict):
        return f"a {type(value).__name__.lower()}" if not isinstance(value, PickledTensor) else "one tensor"
    return _first_names(k for k in value if isinstance(k, str)) or "nothing that has a name"


def _first_names(names: Iterable[str]) -> str:
    found = [n[:60] for n in names]
    return ", ".join(found[:6]) + (f" and {len(found) - 6} more" if len(found) > 6 else "")
