"""Checkpoints of rsl_rl (``model_<n>.pt``; legged_gym, Isaac Lab): an actor, its normaliser, its memory.

Source: rsl_rl/modules/{actor_critic,actor_critic_recurrent,student_teacher,normalizer,normalization}.py and
runners/on_policy_runner.py of 2.3 and 3.1; rsl_rl/models/*.py and algorithms/ppo.py of 5.5. The policy is what
``act_inference`` gives, the mean; its deviation stands beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.graph.nn.activations import Activation
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.activations import activation_of, name_of
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import TensorFile, Weights, pytorch_alone
from export_model.converters.trainers.trainer import Modules, Rebuilt, Saved, Trainer
from export_model.signatures.roles import Role

_USUAL = "rsl_rl's default is elu"
_EXPORT_ONNX = "export the policy to ONNX in its own project (rsl_rl's exporter, torch.onnx.export), and give that"
_NORMALISER = "obs_norm"


class _Layout(Struct, frozen=True):
    """Where things are: under which key of the checkpoint, and the modules in it."""

    key: str
    actor: str
    memory: str
    normaliser: str
    deviation: str = "std"
    log_deviation: str = "log_std"


_NEW = ("mlp", "rnn.rnn", "obs_normalizer", "distribution.std_param", "distribution.log_std_param")
_LAYOUTS = (
    _Layout("model_state_dict", "actor", "memory_a.rnn", "actor_obs_normalizer"),
    _Layout("model_state_dict", "student", "memory_s.rnn", "student_obs_normalizer"),
    _Layout("actor_state_dict", *_NEW),
    _Layout("student_state_dict", *_NEW),
)
_TRAINING = ("critic", "memory_c.", "teacher", "memory_t.", "distribution.distribution")


def _layout_of(value: Any) -> _Layout | None:
    """Where the policy is in a checkpoint; None where it is none of rsl_rl's."""
    for layout in _LAYOUTS:
        state = value.get(layout.key) if isinstance(value, dict) else None
        if isinstance(state, dict) and f"{layout.actor}.0.weight" in state:
            return layout
    return None


def _to_graph(archive: TensorFile, layout: _Layout, activation: Activation) -> tuple[Graph, SourceFacts, Weights]:
    """The policy, its facts and its weights. Raises SourceError for parts that are not known, DamagedFileError."""
    state: Mapping[Any, Any] = archive.value[layout.key]
    beside = archive.value.get("obs_norm_state_dict")
    if isinstance(beside, dict):  # up to 2.3
        state = {**state, **{f"{_NORMALISER}.{k}": v for k, v in beside.items()}}
    weights = Weights(archive, state, holder="its policy", maker="rsl_rl", fix=_EXPORT_ONNX)
    weights.forget(*_TRAINING)
    net = Network(weights)
    recurrent = f"{layout.memory}.weight_ih_l0" in weights
    first = f"{layout.memory}.weight_ih_l0" if recurrent else f"{layout.actor}.0.weight"
    x = net.input("obs", weights.length(first, 1))
    for module in (layout.normaliser, _NORMALISER):
        x = net.empirical(x, module)
    memory: tuple[str, ...] = ()
    if recurrent:
        x, memory = net.remembering(x, layout.memory)
    mean = net.mlp(x, layout.actor, activation, ends=True)
    net.output("action", mean)
    outputs = {"action": Role.ACTION, **({"recurrent_out": Role.MEMORY_OUT} if memory else {})}
    outputs |= _deviation(net, mean, layout)
    weights.check_all_read()
    facts = SourceFacts(
        family="rsl_rl",
        memory_layout=memory,
        outputs=outputs,
        notes=(
            pytorch_alone("rsl_rl"),
            "the action is the mean, as rsl_rl's act_inference gives it; what the environment does with it (scales, "
            "offsets, clips) is not in the file",
        ),
    )
    return net.graph(), facts, weights


def _deviation(net: Network, mean: str, layout: _Layout) -> dict[str, Role]:
    """The deviation of the action, a row per agent; its logarithm where that is what is learned."""
    for module, name, role in (
        (layout.deviation, "action_std", Role.STD),
        (layout.log_deviation, "action_log_std", Role.LOG_STD),
    ):
        if module in net.state:
            per_action(net, mean, net.state.array(module, net.width(mean)), name)
            return {name: role}
    raise net.state.damaged_error(
        "its policy has no deviation",
        "it has none, or one that depends on the observation, or is not a Gaussian: the weights do not say which",
    )


def per_action(net: Network, mean: str, values: np.ndarray, name: str) -> None:
    """An output that is the same for every agent: one number per action, a row per agent."""
    net.at(name)
    net.output(name, net.add("Add", [net.add("ZerosLike", [mean]), net.const(values, "value")]))


def _rebuild(saved: Saved, layout: _Layout) -> Rebuilt:
    activation, files, notes = activation_of(saved.given, saved.activation, _USUAL)
    graph, facts, weights = _to_graph(saved.archive, layout, activation)
    told = {
        "activation": name_of(activation),
        "normalisers": [layout.normaliser, _NORMALISER],
        **{n: getattr(layout, n) for n in ("actor", "memory", "deviation", "log_deviation")},
    }
    modules = Modules("rsl_rl", weights, told)
    return Rebuilt(graph, replace(facts, notes=(*facts.notes, *notes)), files, modules)


TRAINER = Trainer("rsl_rl", lambda saved: _layout_of(saved.value), _rebuild)
