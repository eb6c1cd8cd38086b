"""The models that skrl generates from its settings, as a graph: what its trainers act by when they evaluate.

A model's state dictionary has ``<container>_container.<place>.weight``; the output is the last place of the last
container, or (shared models) ``policy_layer``. The action of a Gaussian is its mean (``stochastic_evaluation`` is off).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from msgspec import Struct, field

from export_model.converters.graph.nn.activations import Activation, clip
from export_model.converters.graph.nn.convolution import Window
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.types import FLOAT32
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.activations import activation_named
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights, pytorch_alone
from export_model.converters.trainers.rsl_rl import per_action
from export_model.converters.trainers.settings import MAX_UNITS, Settings
from export_model.converters.trainers.skrl.expressions import evaluate
from export_model.converters.trainers.trainer import Saved
from export_model.signatures.errors import DamagedFileError
from export_model.signatures.roles import Role

EXPORT_ONNX = "load it in skrl, export the policy (torch.onnx.export, its preprocessor included), and give the .onnx"
#: Statistics of the observations, of 2.x and of 1.x.
PREPROCESSORS = ("observation_preprocessor", "state_preprocessor")
_OBSERVED = ("OBSERVATIONS", "STATES")
#: Words of an output's expression: a layer with a number for each action, or one.
_SIZED = ("ACTIONS", "ONE")
_CLASSES = ("GaussianMixin", "DeterministicMixin", "CategoricalMixin")
#: RunningStandardScaler: (x − mean) / (√variance + ε), clamped.
_EPSILON, _LIMIT = 1e-8, 5.0


class _SkrlPolicy(Struct):
    net: Network
    model: Settings
    observation: str
    tensors: dict[str, str] = field(default_factory=dict)
    outputs: dict[str, Role | None] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def tensor(self, name: str) -> str | None:
        """Return what a name in an input's expression stands for; None where it is not known."""
        return self.observation if name in _OBSERVED else self.tensors.get(name)


def rebuild_policy(saved: Saved, state: Mapping[Any, Any], settings: Settings) -> tuple[Graph, SourceFacts]:
    """Return the policy and what is known of it.

    Raises SourceError for settings and parts that are not built, DamagedFileError, UsageError.
    """
    models = settings.section("models")
    model = models.section("policy")
    kind = model.text("class")
    if kind not in _CLASSES:
        raise model.error("class", f"is {kind[:40]}, which is not built; {', '.join(_CLASSES)} are")
    both = dict(state)
    statistics = _statistics(saved, settings)
    both |= {f"{PREPROCESSORS[0]}.{name}": tensor for name, tensor in statistics.items()}
    weights = Weights(saved.archive, both, holder="its policy", maker="skrl", fix=EXPORT_ONNX)
    weights.forget("value_layer.")
    net = Network(weights)
    made = _SkrlPolicy(net, model, "")
    made.observation = _observe(made, saved, normalised=bool(statistics))
    shared = not models.flag("separate", default=True)
    x = _containers(made, shared=shared)
    _HEADS[kind](made, _output(made, x, shared=shared))
    weights.check_all_read()
    facts = SourceFacts(
        family="skrl",
        algorithm=settings.section("agent").text("class", ""),
        outputs=made.outputs,
        notes=(pytorch_alone("skrl"), f"its network is built as {settings.file} says", *made.notes),
    )
    return net.graph(), facts


# ------------------------------------------------------------------ observations


def _statistics(saved: Saved, settings: Settings) -> Mapping[Any, Any]:
    """Return what the observations are normalised by: a state dictionary, empty where nothing is.

    Raises SourceError where the settings name a preprocessor and the checkpoint has no statistics, or the other way.
    """
    agent = settings.section("agent")
    named = next((agent.text(key) for key in PREPROCESSORS if key in agent), None)
    found: Mapping[Any, Any] = next(
        (saved.value[key] for key in PREPROCESSORS if isinstance(saved.value.get(key), dict)), {}
    )
    if named not in (None, "RunningStandardScaler"):
        raise agent.error("observation_preprocessor", f"is {str(named)[:40]}; RunningStandardScaler is built")
    if (named is None) is not (not found):
        has, lacks = ("settings", "checkpoint") if named else ("checkpoint", "settings")
        raise DamagedFileError(
            f"the {has} of the run have statistics of the observations, and the {lacks} none",
            why="without them the policy would act on other numbers than it was trained on",
            fix="give the agent.yaml of the same run",
        )
    return found


def _observe(made: _SkrlPolicy, saved: Saved, *, normalised: bool) -> str:
    """Return the observation as training saw it; an image is [B, H, W, C] where the settings permute it."""
    net, weights = made.net, made.net.state
    first = f"{_container_names(made.model)[0]}_container.0.weight"
    rank = len(weights.shape(first))
    shape: tuple[int, ...]
    if rank == 4:
        channels, height, width = saved.image_shape(weights.length(first, 1))
        shape = (channels, height, width)
        if "permute" in _first_input(made.model):
            shape = (height, width, channels)
    elif normalised:
        shape = weights.shape(f"{PREPROCESSORS[0]}.running_mean")
    else:
        shape = (weights.length(first, 1),)
    x = net.input("obs", *shape)
    if normalised:
        x = _normalise(net, x, shape)
    channels_first = rank == 4 and "permute" not in _first_input(made.model)
    return net.nhwc(x) if channels_first else x


def _first_input(model: Settings) -> str:
    return model.sections("network")[0].text("input")


def _normalise(net: Network, x: str, shape: tuple[int, ...]) -> str:
    module, weights = PREPROCESSORS[0], net.state
    mean, variance = (weights.array(f"{module}.running_{k}", math.prod(shape)) for k in ("mean", "variance"))
    weights.forget(f"{module}.current_count")
    net.at(module)
    with np.errstate(invalid="ignore"):  # a damaged file: verification finds it
        deviation = (np.sqrt(variance) + np.float32(_EPSILON)).astype(FLOAT32)
    centred = net.add("Sub", [x, net.const(mean.reshape(shape), "mean")])
    scaled = net.add("RealDiv", [centred, net.const(deviation.reshape(shape), "deviation")])
    return clip(net, scaled, -_LIMIT, _LIMIT)


# ------------------------------------------------------------------ layers


def _container_names(model: Settings) -> list[str]:
    names = [container.text("name") for container in model.sections("network")]
    if not names:
        raise model.error("network", "must have a container")
    return names


def _containers(made: _SkrlPolicy, *, shared: bool) -> str:
    """Return the last container's result; each one's is known by its name."""
    containers = made.model.sections("network")
    x = ""
    for number, container in enumerate(containers):
        name = container.text("name")
        net = made.net
        net.at(f"{name}_container")
        x = evaluate(net, container.text("input"), made.tensor, partial(container.error, "input"))
        last = number == len(containers) - 1
        x = _layers(made, x, container, f"{name}_container", embedded=last and not shared and _has_layer(made.model))
        made.tensors[name] = x
    return x


def _layers(made: _SkrlPolicy, x: str, container: Settings, module: str, *, embedded: bool) -> str:
    """Return the result of ``nn.Sequential``; ``embedded``: the output's layer is its last."""
    net, place = made.net, 0
    for layer, activation in zip(*_plan(container), strict=True):
        kind, arguments = layer
        if kind == "flatten":
            x = net.flat(x) if net.rank(x) == 4 else x
            place += 1
            continue
        if kind == "conv2d":
            x = net.convolve(x, f"{module}.{place}", _window(container, arguments))
        else:
            biased = f"{module}.{place}.bias" in net.state
            x = net.linear(x, f"{module}.{place}", _units(container, arguments), biased=biased)
        place += 1
        if activation is not None:
            x = activation(net, x)
            place += 1
    return net.linear(x, f"{module}.{place}") if embedded else x


def _plan(container: Settings) -> tuple[list[tuple[str, Any]], list[Activation | None]]:
    """Return (kind, arguments) and the activation of each layer."""
    layers = container.values.get("layers")
    if not isinstance(layers, list) or len(layers) > 64:
        raise container.error("layers", "must be a list of at most 64 layers")
    plan = [_layer(container, layer) for layer in layers]
    said = container.values.get("activations", [])
    names = said if isinstance(said, list) else [said]
    names = names * len(plan) if len(names) == 1 else names or [None] * len(plan)
    if len(names) != len(plan):
        raise container.error("activations", f"must be one, or one for each of {len(plan)} layers")
    return plan, [_activation(container, name) for name in names]


def _layer(container: Settings, layer: Any) -> tuple[str, Any]:
    if isinstance(layer, int) and not isinstance(layer, bool):
        return "linear", layer
    if layer == "flatten":
        return "flatten", None
    if isinstance(layer, dict) and len(layer) == 1:
        ((kind, arguments),) = layer.items()
        if kind.lower() in ("linear", "conv2d", "flatten"):
            return kind.lower(), arguments
    raise container.error("layers", f"have one that is not built: {str(layer)[:60]}; linear, conv2d, flatten are")


def _activation(container: Settings, name: Any) -> Activation | None:
    if name in (None, ""):
        return None
    found = activation_named(name) if isinstance(name, str) else None
    if found is None:
        raise container.error("activations", f"have {str(name)[:40]!r}, which is not known")
    return found


def _units(container: Settings, arguments: Any) -> int | None:
    """Return the length of a linear layer's result; None where the settings say it by a word."""
    if isinstance(arguments, dict):
        arguments = arguments.get("out_features", arguments.get("features"))
    if isinstance(arguments, list) and arguments:
        arguments = arguments[0]
    if isinstance(arguments, int) and not isinstance(arguments, bool) and 0 < arguments <= MAX_UNITS:
        return arguments
    if isinstance(arguments, str):
        return None
    raise container.error("layers", f"have a linear layer that is not known: {str(arguments)[:60]}")


def _window(container: Settings, arguments: Any) -> Window:
    """Return the window of a convolution: a list in PyTorch's order, or a mapping."""
    if isinstance(arguments, list):
        arguments = dict(zip(("out_channels", "kernel_size", "stride", "padding", "bias"), arguments, strict=False))
    if not isinstance(arguments, dict) or "kernel_size" not in arguments:
        raise container.error("layers", f"have a conv2d that is not known: {str(arguments)[:60]}")
    said = Settings(arguments, container.file, f"{container.place}.layers")
    top, left = said.pair("padding", 0, 0)
    strides = said.pair("stride" if "stride" in said else "strides", 1)
    return Window(said.pair("kernel_size", 1), strides, pads=((top, top), (left, left)))


# ------------------------------------------------------------------ heads


def _has_layer(model: Settings) -> bool:
    """Whether the output is a layer of its own: where its expression names what it has one number of each."""
    return any(token in model.text("output") for token in _SIZED)


def _output(made: _SkrlPolicy, x: str, *, shared: bool) -> str:
    """Return the result of the model's output expression."""
    net, text = made.net, made.model.text("output")
    if shared:
        x = net.linear(x, "policy_layer") if _has_layer(made.model) else x
    net.at("output")
    known = dict.fromkeys(_SIZED, x)
    return evaluate(
        net, text, lambda name: known.get(name) or made.tensors.get(name), partial(made.model.error, "output")
    )


def _gaussian(made: _SkrlPolicy, mean: str) -> None:
    net, model = made.net, made.model
    if model.flag("clip_mean_actions"):
        raise model.error("clip_mean_actions", "is true: the limits are the environment's, which are not in the file")
    net.output("action", mean)
    values = net.state.array("log_std_parameter", net.width(mean))
    if model.flag("clip_log_std", default=True):
        values = np.clip(values, model.number("min_log_std", -20), model.number("max_log_std", 2)).astype(FLOAT32)
    per_action(net, mean, values, "action_log_std")
    made.outputs |= {"action": Role.ACTION, "action_log_std": Role.LOG_STD}
    made.notes.append(
        "the action is the mean, as skrl's trainers evaluate; action_log_std is the deviation's logarithm"
    )


def _deterministic(made: _SkrlPolicy, action: str) -> None:
    if made.model.flag("clip_actions"):
        raise made.model.error("clip_actions", "is true: the limits are the environment's, which are not in the file")
    made.net.output("action", action)
    made.outputs["action"] = Role.ACTION


def _categorical(made: _SkrlPolicy, values: str) -> None:
    net = made.net
    logits = values if made.model.flag("unnormalized_log_prob", default=True) else net.add("Log", [values])
    net.at("action")
    net.output("action", net.choice(logits))
    made.outputs["action"] = Role.ACTION


_HEADS = {"GaussianMixin": _gaussian, "DeterministicMixin": _deterministic, "CategoricalMixin": _categorical}
