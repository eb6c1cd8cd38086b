"""Checkpoints of Sample Factory (``checkpoint_p0/checkpoint_<n>_<m>.pth``), with the ``config.json`` of their run.

Source: sample_factory/model/{actor_critic,encoder,core,decoder,action_parameterization}.py, utils/normalize.py and
algo/utils/running_mean_std.py of 2.1. ``{"model": state, "train_step": …}``; weights of an actor apart from the critic
(``actor_critic_share_weights`` is false) have ``actor_`` before their names.

Actions are taken where their deviation is a weight of its own (``learned_stddev``: ``adaptive_stddev`` is false, as in
Sample Factory's MuJoCo, Brax and Isaac Gym). Elsewhere the last layer gives N numbers that may be the odds of one
choice, of several, or means and deviations: the space of actions is the environment's, and in no file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from export_model.converters.graph.nn.activations import Activation
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights, pytorch_alone
from export_model.converters.trainers.rl_games.normaliser import normalise
from export_model.converters.trainers.rsl_rl import per_action
from export_model.converters.trainers.settings import Settings, needed_settings
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer
from export_model.signatures.errors import SourceError
from export_model.signatures.roles import Role

_EXPORT_ONNX = (
    "load it in Sample Factory, export the module that gives the action (torch.onnx.export), and give the .onnx"
)
#: 2.x writes the first, 1.x wrote the second.
_FILES = ("config.json", "cfg.json")
_KEYS = ("encoder_mlp_layers",)
_HEAD = "action_parameterization"
_STATISTICS = "obs_normalizer.running_mean_std.running_mean_std"
#: What training alone needs: the critic, and the statistics of returns.
_TRAINING = ("critic_", "returns_normalizer.")


def _state_of(saved: Saved) -> dict[Any, Any] | None:
    """Return the policy's state dictionary; None where the checkpoint is not of Sample Factory."""
    state = saved.value.get("model") if isinstance(saved.value, dict) else None
    known = isinstance(state, dict) and any(isinstance(n, str) and n.startswith(f"{_HEAD}.") for n in state)
    return state if known else None


def _rebuild(saved: Saved, state: dict[Any, Any]) -> Rebuilt:
    settings, file = needed_settings(
        saved,
        "Sample Factory",
        _FILES,
        _KEYS,
        why="activation, memory and normaliser are recorded only in the run's settings",
        fix="put the run's config.json next to the checkpoint, or give the .pth where the run left it",
        has="it (nonlinearity)",
    )
    graph, facts = _rebuild_actor(saved, state, settings)
    return Rebuilt(graph, facts, (file,))


def _rebuild_actor(saved: Saved, state: Mapping[Any, Any], settings: Settings) -> tuple[Graph, SourceFacts]:
    """Return the policy and what is known of it.

    Raises SourceError for settings and parts that are not built, DamagedFileError.
    """
    weights = Weights(saved.archive, state, holder="its policy", maker="Sample Factory", fix=_EXPORT_ONNX)
    if f"{_HEAD}.learned_stddev" not in weights:
        width = weights.length(f"{_HEAD}.distribution_linear.weight", 0)
        raise SourceError(
            f"its {width} numbers for actions may be of one choice, of several, or means and deviations",
            why="the action space is the environment's, and no file of the run records it; with adaptive_stddev "
            "false the deviation is a separate weight, and such policies are read",
            fix=_EXPORT_ONNX,
        )
    weights.forget(*_TRAINING)
    own = "" if settings.flag("actor_critic_share_weights", default=True) else "actor_"
    net, activation = Network(weights), settings.activation("nonlinearity", "elu")
    x = _encode(net, settings, f"{own}encoder.encoders", activation)
    memory: tuple[str, ...] = ()
    if settings.flag("use_rnn"):
        x, memory = net.remembering(x, f"{own}core.core")
    for number, size in enumerate(settings.sizes("decoder_mlp_layers")):
        x = activation(net, net.linear(x, f"{own}decoder.mlp.{2 * number}", size))
    mean = net.linear(x, f"{_HEAD}.distribution_linear")
    scale = settings.number("continuous_tanh_scale", 0.0)
    if scale > 0:
        squashed = net.add("Tanh", [net.add("RealDiv", [mean, net.floats(scale)])])
        mean = net.add("Mul", [squashed, net.floats(scale)])
    net.output("action", mean)
    per_action(net, mean, weights.array(f"{_HEAD}.learned_stddev", net.width(mean)), "action_log_std")
    outputs: dict[str, Role | None] = {"action": Role.ACTION, "action_log_std": Role.LOG_STD}
    outputs |= {"recurrent_out": Role.MEMORY_OUT} if memory else {}
    weights.check_all_read()
    facts = SourceFacts(
        family="Sample Factory",
        algorithm=settings.text("algo", ""),
        memory_layout=memory,
        outputs=outputs,
        notes=(
            pytorch_alone("Sample Factory"),
            f"its network is built as {settings.file} says",
            "the action is the mean, as eval_deterministic takes it; what the environment clips or scales is not in "
            "the file",
        ),
    )
    return net.graph(), facts


def _encode(net: Network, settings: Settings, module: str, activation: Activation) -> str:
    """Return what all observations give, each normalised as training did, in the order of their names."""
    weights, sizes = net.state, settings.sizes("encoder_mlp_layers")
    keys = sorted({name.partition(".")[0] for name in weights.under(f"{module}.")})
    if not keys or not sizes:
        raise settings.error("encoder_mlp_layers", "must have a layer for each observation")
    encoded = []
    for key in keys:
        first = f"{module}.{key}.mlp_head.0.weight"
        if first not in weights:
            raise weights.unsupported_error(f"{module}.{key}", "of encoders, layers on a row of numbers are built")
        x = net.input(key, weights.length(first, 1))
        x = _normalise(net, settings, key, x)
        for number, size in enumerate(sizes):
            x = activation(net, net.linear(x, f"{module}.{key}.mlp_head.{2 * number}", size))
        encoded.append(x)
    return encoded[0] if len(encoded) == 1 else net.concat(encoded, 1)


def _normalise(net: Network, settings: Settings, key: str, x: str) -> str:
    """Return an observation less a mean and by a scale (``obs`` alone has them), then by its running statistics."""
    if key == "obs":
        mean, scale = settings.number("obs_subtract_mean", 0.0), settings.number("obs_scale", 1.0)
        net.at("obs_normalizer")
        x = net.add("Sub", [x, net.floats(mean)]) if mean else x
        if not scale:
            raise settings.error("obs_scale", "must not be 0")
        x = net.add("RealDiv", [x, net.floats(scale)]) if scale != 1 else x
    statistics = f"{_STATISTICS}.{key}"
    normalised = f"{statistics}.running_mean" in net.state
    if normalised and not settings.flag("normalize_input"):
        raise settings.error("normalize_input", "is false, and the checkpoint has statistics of the observations")
    return normalise(net, x, statistics, (net.width(x),)) if normalised else x


TRAINER = Trainer("Sample Factory", _state_of, _rebuild)
