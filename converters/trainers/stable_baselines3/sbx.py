"""Policies of SBX (Stable-Baselines3 in JAX): flax parameters under the names that Stable-Baselines3 gives its weights.

Source: sbx/{ppo,sac,tqc,td3,dqn}/policies.py and sbx/common/policies.py of 0.28. Its actors compute what those of
Stable-Baselines3 do, with ``Dense_<n>`` for layers that are numbered here by their place in a Sequential, kernels
[in, out]. ``model.save`` pickles the policy whole (cloudpickle, in ``data``): it is read as data, its functions by
their names. Other than there, observations of numbers only are taken, and images are not divided by 255.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.converters.files.pickled_objects import Instance, array_of, unpickle_objects
from export_model.converters.trainers.pytorch.weights import ArraysByName
from export_model.converters.trainers.stable_baselines3.spaces import Space, space_of
from export_model.signatures.errors import DamagedFileError, SourceError

_EXPORT_ONNX = "export the policy to ONNX in its own project (jax2onnx), and give that"
_SAVE_AGAIN = "save the model again: model.save"
#: Layers of a policy; flax numbers them.
MAX_DENSE = 64
#: jax.nn's functions that are what PyTorch's of the same meaning are (jax/_src/nn/functions.py); gelu is not: there it
#: is the approximation by tanh.
_ACTIVATIONS = {
    **dict.fromkeys(("relu", "tanh", "elu", "selu", "celu", "sigmoid", "softplus", "relu6", "leaky_relu"), ""),
    "silu": "SiLU",
    "swish": "SiLU",
    "soft_sign": "Softsign",
}


class _Actor(Struct, frozen=True):
    """A module of SBX, by its twin in Stable-Baselines3.

    ``state`` is where the parameters are, ``classes`` are what computes with them, ``hidden`` is what the hidden layers
    are called in the twin (with an activation behind the last, too), and ``heads`` the last layers.
    """

    twin: str
    state: str
    classes: tuple[str, ...]
    hidden: str
    heads: tuple[str, ...]


_ACTORS = {
    "sbx.ppo.policies": _Actor(
        "stable_baselines3.common.policies", "actor", ("Actor",), "mlp_extractor.policy_net", ("action_net",)
    ),
    **{
        f"sbx.{name}.policies": _Actor(
            f"{library}.{name}.policies",
            "actor",
            ("SquashedGaussianActor",),
            "actor.latent_pi",
            ("actor.mu", "actor.log_std"),
        )
        for name, library in (("sac", "stable_baselines3"), ("tqc", "sb3_contrib"))
    },
    "sbx.td3.policies": _Actor("stable_baselines3.td3.policies", "actor", ("Actor",), "actor.mu", ()),
    "sbx.dqn.policies": _Actor("stable_baselines3.dqn.policies", "qf", ("QNetwork",), "q_net.q_net", ()),
}


def is_sbx(data: Mapping[str, Any]) -> bool:
    """Whether the settings of a saved model are of a policy of SBX."""
    return _module_of(data).startswith("sbx.")


def _module_of(data: Mapping[str, Any]) -> str:
    entry = data.get("policy_class")
    return str(entry.get("__module__", "")) if isinstance(entry, dict) else ""


def read_sbx(data: Mapping[str, Any]) -> tuple[ArraysByName, dict[str, Any]]:
    """Return the weights, and the settings as Stable-Baselines3 would have them.

    Raises SourceError for networks and observations that are not built, DamagedFileError, NotAPolicyError.
    """
    actor = _ACTORS.get(_module_of(data))
    if actor is None:
        raise SourceError(
            f"its policy is of {_module_of(data)[:60]}, which is not built here",
            why="policies of SBX's PPO, SAC, TQC, TD3, DDPG and DQN are",
            fix=_EXPORT_ONNX,
        )
    _check_observations(data)
    policy = unpickle_objects(_pickle_of(data), functions=True)
    module = policy.attribute(actor.state) if isinstance(policy, Instance) else None
    state = policy.attribute(f"{actor.state}_state") if isinstance(policy, Instance) else None
    if not isinstance(module, Instance) or not isinstance(state, Instance):
        raise DamagedFileError(f"its policy has no {actor.state}", why="every saved model has one", fix=_SAVE_AGAIN)
    if module.maker.name not in actor.classes or module.attribute("features_extractor") is not None:
        raise SourceError(
            f"its network is {module.maker.name[:60]}"
            + (" behind NatureCNN" if module.maker.name in actor.classes else ""),
            why=f"of this algorithm {', '.join(actor.classes)} alone is built",
            fix=_EXPORT_ONNX,
        )
    entry, kwargs = data.get("policy_class"), data.get("policy_kwargs")
    ours = {**(entry if isinstance(entry, dict) else {}), "__module__": actor.twin}
    named = {**(kwargs if isinstance(kwargs, dict) else {}), "activation_fn": _activation_of(module)}
    return ArraysByName(_weights(_params_of(state), actor)), {**data, "policy_class": ours, "policy_kwargs": named}


def _check_observations(data: Mapping[str, Any]) -> None:
    """Raise SourceError unless the observations are rows of numbers: others SBX takes in another way."""
    observed = space_of(data, "observation_space")
    for space in observed.values() if isinstance(observed, dict) else (observed,):
        if not isinstance(space, Space) or space.kind != "Box" or len(space.shape) != 1:
            raise SourceError(
                f"its observation space is {getattr(space, 'kind', 'Dict')} {list(getattr(space, 'shape', ()))}",
                why="of SBX's policies those that observe a row of numbers are built",
                fix=_EXPORT_ONNX,
            )


def _pickle_of(data: Mapping[str, Any]) -> bytes:
    entry = data.get("policy")
    text = entry.get(":serialized:") if isinstance(entry, dict) else None
    try:
        return base64.b64decode(text if isinstance(text, str) else "", validate=True)
    except (binascii.Error, ValueError) as error:
        raise DamagedFileError("its policy cannot be read", why=str(error)[:80], fix=_SAVE_AGAIN) from error


def _activation_of(module: Instance) -> str:
    """Return the activation as Stable-Baselines3 would name it. Raises SourceError."""
    function = module.attribute("activation_fn")
    name = (
        function.attribute("__name__") or function.attribute("function_name") if isinstance(function, Instance) else ""
    )
    if name not in _ACTIVATIONS:
        raise SourceError(
            f"its activation is {str(name)[:60] or 'not known'}",
            why=f"of jax.nn's functions {', '.join(_ACTIVATIONS)} are known to be what PyTorch's are",
            fix=_EXPORT_ONNX,
        )
    return _ACTIVATIONS[name] or str(name)


def _params_of(state: Instance) -> Mapping[str, Any]:
    params = state.attribute("params")
    params = params.attribute("_dict") if isinstance(params, Instance) else params  # flax's FrozenDict
    inner = params.get("params") if isinstance(params, dict) else None
    if not isinstance(inner, dict):
        raise DamagedFileError("its policy has no parameters", why="a flax module has some", fix=_SAVE_AGAIN)
    return inner


def _weights(params: Mapping[str, Any], actor: _Actor) -> dict[str, np.ndarray]:
    """Return the weights by the names that they have in Stable-Baselines3.

    Raises SourceError for parameters beside layers and a deviation.
    """
    count = sum(name.startswith("Dense_") for name in params)
    others = sorted(set(params) - {f"Dense_{i}" for i in range(count)} - {"log_std"})
    if others or not len(actor.heads) <= count <= MAX_DENSE:
        raise SourceError(
            f"its network has a part that is not built: {', '.join(map(str, others[:4]))[:120] or f'{count} layers'}",
            why="layers (Dense) and a deviation (log_std) are",
            fix=_EXPORT_ONNX,
        )
    arrays: dict[str, np.ndarray] = {}
    for i in range(count):
        head = i - (count - len(actor.heads))
        name = actor.heads[head] if head >= 0 else f"{actor.hidden}.{2 * i}"
        layer = params[f"Dense_{i}"]
        if not isinstance(layer, dict) or set(layer) != {"kernel", "bias"}:
            raise DamagedFileError(f"its layer Dense_{i} has no kernel and bias", why="it is damaged", fix=_SAVE_AGAIN)
        arrays[f"{name}.weight"] = _array(layer["kernel"], f"Dense_{i}.kernel").T
        arrays[f"{name}.bias"] = _array(layer["bias"], f"Dense_{i}.bias")
    if "log_std" in params:
        arrays["log_std"] = _array(params["log_std"], "log_std")
    return arrays


def _array(value: Any, what: str) -> np.ndarray:
    """Return a pickled array of JAX (``_reconstruct_array(fun, args, state, …)``: numpy's) or of numpy."""
    if isinstance(value, Instance) and value.maker.name == "_reconstruct_array" and len(value.arguments) >= 3:
        made, arguments, state = value.arguments[:3]
        maker = getattr(made, "maker", made)
        value = Instance(maker, arguments if isinstance(arguments, tuple) else (), state)
    array = array_of(value, what)
    if math.prod(array.shape) > 1 << 28:
        raise DamagedFileError(f"its {what} has the shape {list(array.shape)}", why="it is damaged", fix=_SAVE_AGAIN)
    return array
