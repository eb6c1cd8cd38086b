"""The networks that rl_games builds from its settings, as a graph: what its players compute of an observation.

The deterministic action of ``PpoPlayerContinuous`` is the mean, clipped to −1 … 1 where ``clip_actions`` (it is unless
the settings say otherwise) and then scaled to limits that only the environment has; of ``SACPlayer`` tanh of the mean.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import Struct, field

from export_model.converters.graph.nn.activations import clip
from export_model.converters.graph.nn.convolution import Window
from export_model.converters.graph.nn.normalisation import layer
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights, pytorch_alone
from export_model.converters.trainers.rl_games.normaliser import normalise, observed_shape
from export_model.converters.trainers.settings import Settings
from export_model.converters.trainers.trainer import Saved
from export_model.signatures.errors import SourceError
from export_model.signatures.roles import Role

EXPORT_ONNX = "load it in rl_games, export the module that gives the action (torch.onnx.export), and give the .onnx"
_MODELS = ("continuous_a2c", "continuous_a2c_logstd", "discrete_a2c", "multi_discrete_a2c")
_NORMALISER = "running_mean_std"
_TRAINING = ("value.", "critic_cnn.", "critic_mlp.", "c_rnn.", "c_layer_norm.", "value_mean_std.", "aux_")
_A2C = "a2c_network."


class _Making(Struct):
    """A policy in the making."""

    net: Network
    network: Settings
    outputs: dict[str, Role | None] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    memory: tuple[str, ...] = ()


def rebuild_actor_critic(
    saved: Saved, states: Mapping[str, Mapping[Any, Any]], params: Settings
) -> tuple[Graph, SourceFacts]:
    """Return the policy of PPO (``A2CBuilder``), and what is known of it.

    Raises SourceError for settings and parts that are not built, DamagedFileError.
    """
    network, config = params.section("network"), params.section("config")
    model = params.section("model").text("name", "")
    if network.text("name", "actor_critic") != "actor_critic" or model not in _MODELS:
        name, place = (network.text("name"), "network") if model in _MODELS else (model or "missing", "model")
        raise _unknown_error(params, place, name)
    state = dict(states["model"])
    beside = states.get(_NORMALISER, {})  # where the normaliser was saved on its own
    state |= {f"{_NORMALISER}.{name}": tensor for name, tensor in beside.items()}
    weights = Weights(saved.archive, state, holder="its policy", maker="rl_games", fix=EXPORT_ONNX)
    weights.forget(*(_A2C + name for name in _TRAINING), "value_mean_std.")
    made = _Making(Network(weights), network)
    x = _observe(made, saved, normalised=config.flag("normalize_input"))
    x = _body(made, x)
    if "continuous" in network.section("space"):
        _continuous(made, x, network.section("space").section("continuous"), model, config)
    else:
        _discrete(made, x, config)
    return _finish(made, "PPO")


def rebuild_soft_actor(
    saved: Saved, states: Mapping[str, Mapping[Any, Any]], params: Settings
) -> tuple[Graph, SourceFacts]:
    """Return the policy of SAC (``SACBuilder``), and what is known of it. Raises as ``rebuild_actor_critic``."""
    network = params.section("network")
    if network.text("name", "soft_actor_critic") != "soft_actor_critic":
        raise _unknown_error(params, "network", network.text("name"))
    state = {**states["actor"], **{f"{_NORMALISER}.{n}": t for n, t in states.get(_NORMALISER, {}).items()}}
    weights = Weights(saved.archive, state, holder="its policy", maker="rl_games", fix=EXPORT_ONNX)
    made = _Making(net := Network(weights), network)
    x = _observe(made, saved, normalised=params.section("config").flag("normalize_input"))
    mlp = network.section("mlp")
    if mlp.flag("d2rl"):
        raise mlp.error("d2rl", "is true, which is not built for SAC")
    index = len(mlp.sizes("units"))
    activation = mlp.activation("activation")
    for i in range(index):
        x = activation(net, net.linear(x, f"trunk.{2 * i}"))
    both = net.linear(x, f"trunk.{2 * index}")
    actions, rest = divmod(net.width(both), 2)
    if rest or not actions:
        raise weights.damaged_error(f"its actor gives {net.width(both)} numbers", "a mean and a deviation per action")
    net.at("action")
    mean, logarithm = (net.slice(both, 1, i * actions, (i + 1) * actions) for i in (0, 1))
    low, high = _log_std_bounds(network)
    net.output("action", net.add("Tanh", [mean]))
    net.output("action_log_std", clip(net, logarithm, low, high))
    made.outputs |= {"action": Role.ACTION, "action_log_std": Role.LOG_STD}
    made.notes.append(
        "the action is tanh of the mean, as rl_games' player acts deterministically; training draws around the mean "
        "before tanh, with the deviation whose logarithm is action_log_std"
    )
    return _finish(made, "SAC")


def _log_std_bounds(network: Settings) -> tuple[float, float]:
    bounds = network.values.get("log_std_bounds")
    if not isinstance(bounds, list) or len(bounds) != 2 or not all(isinstance(b, int | float) for b in bounds):
        raise network.error("log_std_bounds", "must be two numbers")
    return float(bounds[0]), float(bounds[1])


def _finish(made: _Making, algorithm: str) -> tuple[Graph, SourceFacts]:
    made.net.state.check_all_read()
    facts = SourceFacts(
        family="rl_games",
        algorithm=algorithm,
        memory_layout=made.memory,
        outputs=made.outputs,
        notes=(pytorch_alone("rl_games"), f"its network is built as {made.network.file} says", *made.notes),
    )
    return made.net.graph(), facts


def _unknown_error(params: Settings, place: str, name: str) -> SourceError:
    return SourceError(
        f"{params.file}: params.{place}.name is {name[:60]}, which is not built here",
        why="of rl_games' networks actor_critic (models " + ", ".join(_MODELS) + ") and soft_actor_critic are",
        fix=EXPORT_ONNX,
    )


# ------------------------------------------------------------------ layers


def _observe(made: _Making, saved: Saved, *, normalised: bool) -> str:
    """Return the observation, normalised where training did. An image is [B, H, W, C], its colours from 0 to 1."""
    net = made.net
    shape = observed_shape(net.state, _NORMALISER if normalised else "", saved, _first_layer(made))
    x = net.input("obs", *shape)
    if len(shape) == 3:
        made.notes.append("its image has colours from 0 to 1: rl_games divides bytes by 255 before the policy")
    return normalise(net, x, _NORMALISER, shape) if normalised else x


def _first_layer(made: _Making) -> str:
    """Return the name of a layer that reads the observation, or all of it beside other numbers."""
    for name in ("actor_cnn.0", "a_rnn.rnn", "rnn.rnn", "actor_mlp.0", "actor_mlp.linears.0", "mu", "logits"):
        before = made.network.section("rnn").flag("before_mlp")
        if "rnn" in name and not before and made.net.state.under(f"{_A2C}actor_mlp."):
            continue
        weight = f"{_A2C}{name}.weight_ih_l0" if "rnn" in name else f"{_A2C}{name}.weight"
        if weight in made.net.state:
            return weight
    return "trunk.0.weight"


def _body(made: _Making, x: str) -> str:
    """Return what the heads read: convolutions, layers and a memory, in the order of the settings."""
    net, network = made.net, made.network
    if "cnn" in network:
        x = _convolutions(made, x)
    encoded = x
    if "rnn" not in network:
        return _mlp(made, x)
    rnn = network.section("rnn")
    before = rnn.flag("before_mlp")
    if not before:
        x = _mlp(made, x)
        x = net.concat([x, encoded], 1) if rnn.flag("concat_input") else x
    own = "a_" if network.flag("separate") else ""
    if rnn.text("name") not in ("lstm", "gru"):
        raise rnn.error("name", f"is {rnn.text('name')[:40]}; lstm and gru are built")
    x, made.memory = net.remembering(x, f"{_A2C}{own}rnn.rnn")
    made.outputs["recurrent_out"] = Role.MEMORY_OUT
    if rnn.flag("layer_norm"):
        x = _layer_norm(net, x, f"{_A2C}{own}layer_norm")
    x = net.concat([x, encoded], 1) if rnn.flag("concat_output") else x
    return _mlp(made, x) if before else x


def _layer_norm(net: Network, x: str, module: str) -> str:
    net.at(module)
    scale, bias = (net.const(net.state.array(f"{module}.{k}", net.width(x)), k) for k in ("weight", "bias"))
    return layer(net, x, 1, scale, bias)[0]


def _mlp(made: _Making, x: str) -> str:
    """Return the result of ``actor_mlp``. Its settings' normalisation reaches only D2RL (rl_games/algos_torch)."""
    net, mlp = made.net, made.network.section("mlp")
    units, activation = mlp.sizes("units"), mlp.activation("activation")
    module = f"{_A2C}actor_mlp"
    if not mlp.flag("d2rl"):
        for i in range(len(units)):
            x = activation(net, net.linear(x, f"{module}.{2 * i}", units[i]))
        return x
    norm = made.network.text("normalization", "")
    if norm not in ("", "layer_norm"):
        raise made.network.error("normalization", f"is {norm[:40]} with d2rl, which is not built")
    given = x
    for i, size in enumerate(units):
        x = net.linear(net.concat([x, given], 1) if i else x, f"{module}.linears.{i}", size)
        x = activation(net, x) if i == 0 else x  # the first is normalised behind its activation, the others before
        x = _layer_norm(net, x, f"{module}.norm_layers.{i}") if norm else x
        x = x if i == 0 else activation(net, x)
    return x


def _convolutions(made: _Making, image: str) -> str:
    """Return the features of an image [B, H, W, C] as rows, in PyTorch's order."""
    net, cnn = made.net, made.network.section("cnn")
    kind = cnn.text("type")
    if kind not in ("conv2d", "conv2d_flatten") or net.rank(image) != 4:
        raise cnn.error("type", f"is {kind[:40]}; conv2d on an image is built")
    if made.network.text("normalization", ""):
        raise made.network.error("normalization", "beside convolutions is not built")
    activation = cnn.activation("activation")
    x = image if cnn.flag("permute_input", default=True) else net.nhwc(image)
    for i, conv in enumerate(cnn.sections("convs")):
        top, left = conv.pair("padding", 0, 0)
        window = Window(conv.pair("kernel_size", 1), conv.pair("strides", 1), pads=((top, top), (left, left)))
        x = activation(net, net.convolve(x, f"{_A2C}actor_cnn.{2 * i}", window))
    return net.flat(x)


# ------------------------------------------------------------------ heads


def _continuous(made: _Making, x: str, space: Settings, model: str, config: Settings) -> None:
    net = made.net
    mean = space.activation("mu_activation", "None")(net, net.linear(x, f"{_A2C}mu"))
    clipped = config.flag("clip_actions", default=True)
    name, role = ("action_std", Role.STD) if model == "continuous_a2c" else ("action_log_std", Role.LOG_STD)
    shape = space.activation("sigma_activation", "None")
    if f"{_A2C}sigma" in net.state:
        net.at(name)
        fixed = net.const(net.state.array(f"{_A2C}sigma", net.width(mean)), "sigma")
        net.output(name, shape(net, net.add("Add", [net.add("ZerosLike", [mean]), fixed])))
    else:
        net.output(name, shape(net, net.linear(x, f"{_A2C}sigma", net.width(mean))))
    net.at("action")
    net.output("action", clip(net, mean, -1, 1) if clipped else mean)
    made.outputs |= {"action": Role.ACTION, name: role}
    limits = "between -1 and 1; the player scales it to the limits of the environment, which are not in the file"
    made.notes.append(
        "the action is the mean, as rl_games' player acts deterministically, "
        + (limits if clipped else "not clipped (clip_actions is false)")
    )


def _discrete(made: _Making, x: str, config: Settings) -> None:
    net = made.net
    several = net.state.indices(f"{_A2C}logits.")
    names = [f"{_A2C}logits.{i}" for i in several] or [f"{_A2C}logits"]
    parts = [net.linear(x, name) for name in names]
    sizes = [net.width(part) for part in parts]
    logits = parts[0] if len(parts) == 1 else net.concat(parts, 1)
    if config.flag("use_action_masks"):
        masks = net.input("action_masks", sum(sizes))
        net.at("action")
        logits = net.forbid(logits, masks)
    net.at("action")
    net.output("action", net.choices(logits, sizes))
    made.outputs["action"] = Role.ACTION
