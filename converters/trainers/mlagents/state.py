"""The actor of ML-Agents in a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from export_model.converters.files.unpickle import PickledTensor
from export_model.converters.trainers.pytorch.weights import TensorFile, Weights
from export_model.signatures.roles import VERSION_NUMBER

#: What a reader of a checkpoint can always do instead: ML-Agents writes the ONNX when it saves.
LET_IT_EXPORT = (
    "let ML-Agents export the ONNX: mlagents-learn <config> --resume --run-id <id> in the project it was trained in, "
    "stopped at once with Ctrl-C; then give the .onnx"
)
#: Parts of the saved actor that an exported policy does not have: the critic of 0.22 to 0.24, a shared critic's heads.
_NOT_POLICY = ("critic.", "value_heads.")


class State(Weights):
    """The tensors of ``Policy``; ``step_is_float``: its step counter is one of ML-Agents 0.20 and 0.21."""

    def __init__(self, archive: TensorFile, policy: Mapping[Any, Any]) -> None:
        """The actor ``policy`` (``actor_in``) of a checkpoint."""
        value = archive.value
        super().__init__(archive, policy, holder="its Policy", maker="ML-Agents", fix=LET_IT_EXPORT)
        self.forget(*_NOT_POLICY)
        self.modules = sorted(str(k) for k in value) if policy is not value else []
        self.step_is_float = _step_is_float(value)


def actor_in(value: Any) -> Mapping[Any, Any] | None:
    """The actor's state dictionary in what was saved, or saved by hand; None where it is none of ML-Agents."""
    policy = value.get("Policy") if isinstance(value, dict) else None
    if policy is None and isinstance(value, dict) and VERSION_NUMBER in value:
        policy = value
    names = [k for k in policy if isinstance(k, str)] if isinstance(policy, dict) else []
    is_actor = VERSION_NUMBER in names and any(n.startswith("network_body.") for n in names)
    return policy if is_actor else None


def _step_is_float(value: Mapping[str, Any]) -> bool:
    steps = value.get("global_step")
    step = steps.get("_GlobalSteps__global_step") if isinstance(steps, dict) else None
    return isinstance(step, PickledTensor) and str(getattr(step.storage, "dtype", "")).startswith("float")
