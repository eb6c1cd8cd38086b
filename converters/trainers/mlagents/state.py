"""The actor of ML-Agents in a checkpoint."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from converters.files.torch_archive import Archive
from converters.files.unpickle import Tensor
from converters.trainers.pytorch.weights import Weights
from signatures.errors import NotAPolicyError

#: What a reader of a checkpoint can always do instead: ML-Agents writes the ONNX when it saves.
LET_IT_EXPORT = (
    "let ML-Agents export the ONNX: mlagents-learn <config> --resume --run-id <id> in the project it was trained in, "
    "stopped at once with Ctrl-C; then give the .onnx"
)
#: Parts of the saved actor that an exported policy does not have: the critic of 0.22 to 0.24, a shared critic's heads.
_NOT_POLICY = ("critic.", "value_heads.")
#: How a tensor's name begins in the checkpoints of trainers whose networks are not rebuilt.
_OTHERS = {
    "a2c_network.": "rl_games",
    **dict.fromkeys(("log_std_parameter", "policy_layer.", "net_container.", "state_preprocessor"), "skrl"),
    **dict.fromkeys(("actor.preprocess.", "model.model.model."), "Tianshou"),
    **dict.fromkeys(("encoder.actor_encoder.", "_logits._model.", "_hidden_layers.0._model."), "RLlib"),
    "action_parameterization.": "Sample Factory",
}


class State(Weights):
    """The tensors of ``Policy``; ``step_is_float``: its step counter is one of ML-Agents 0.20 and 0.21."""

    def __init__(self, archive: Archive) -> None:
        """Find the actor in a checkpoint. Raises NotAPolicyError where there is none."""
        value = archive.value
        policy = value.get("Policy") if isinstance(value, dict) else None
        if policy is None and isinstance(value, dict) and "version_number" in value:
            policy = value  # the actor's own state dictionary, saved by hand
        if not isinstance(policy, dict) or not _is_actor(policy):
            if maker := _other_trainer(value):
                raise NotAPolicyError(
                    f"is a checkpoint of {maker}, whose networks are not rebuilt",
                    why=f"it holds weights ({_content(value)}); which activations and layers they belong to stands in "
                    "the run's configuration and code",
                    fix=f"load it in {maker}, export the module that gives the action (torch.onnx.export, the "
                    "observation's normaliser included), and give the .onnx",
                )
            raise NotAPolicyError(
                "is no checkpoint of a policy whose network is known",
                why=f"it holds {_content(value)}, not the names that ML-Agents, rsl_rl or CleanRL give; a state "
                "dictionary does not say what is computed with it",
                fix="export the model to ONNX in its own project (torch.onnx.export), and give that; of "
                "Stable-Baselines3 give the .zip that model.save wrote",
            )
        super().__init__(archive, policy, holder="its Policy", maker="ML-Agents", fix=LET_IT_EXPORT)
        self.forget(*_NOT_POLICY)
        self.modules = sorted(str(k) for k in value) if policy is not value else []
        self.step_is_float = _step_is_float(value)


def _is_actor(policy: Mapping[Any, Any]) -> bool:
    names = [k for k in policy if isinstance(k, str)]
    return "version_number" in names and any(n.startswith("network_body.") for n in names)


def _other_trainer(value: Any) -> str:
    """Who else wrote it, by its tensors' names (rl_games 1.6, skrl 2, Tianshou 2, RLlib 2, Sample Factory 2)."""
    names = [n for n in value if isinstance(n, str)] if isinstance(value, dict) else []
    for part in ("model", "policy"):
        inner = value.get(part) if names else None
        names += [n for n in inner if isinstance(n, str)] if isinstance(inner, dict) else []
    return next((maker for start, maker in _OTHERS.items() if any(n.startswith(start) for n in names)), "")


def _content(value: Any) -> str:
    if not isinstance(value, dict):
        return f"a {type(value).__name__.lower()}" if not isinstance(value, Tensor) else "one tensor"
    return _listed(k for k in value if isinstance(k, str)) or "nothing that has a name"


def _listed(names: Iterable[str]) -> str:
    found = [n[:60] for n in names]
    return ", ".join(found[:6]) + (f" and {len(found) - 6} more" if len(found) > 6 else "")


def _step_is_float(value: Mapping[str, Any]) -> bool:
    steps = value.get("global_step")
    step = steps.get("_GlobalSteps__global_step") if isinstance(steps, dict) else None
    return isinstance(step, Tensor) and str(getattr(step.storage, "dtype", "")).startswith("float")
