"""Policies of brax and MuJoCo Playground (PPO, SAC): a normaliser and dense layers, named as flax names them.

Source: brax/training/{networks,distribution,checkpoint}.py, acme/running_statistics.py and
agents/{ppo,sac}/networks.py of 0.14.2. ``MLP`` has kernels [in, out] called ``hidden_<i>``, the activation before a
``LayerNorm``; with a tanh at its end the last layer gives means and deviations; with ``distribution_type`` normal it is
``PolicyModuleWithStd``, whose means are ``Dense_0``. The policy is what ``make_inference_fn(params,
deterministic=True)`` gives. ``<ppo|sac>_network_config.json`` is what ``checkpoint.save`` writes beside the arrays; the
normaliser's statistics are kept up whether it is used or not (agents/ppo/train.py), so they do not tell that.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.converters.files.file_probe import json_in
from export_model.converters.graph.nn.activations import Activation, gelu
from export_model.converters.graph.nn.linear import matmul
from export_model.converters.graph.nn.normalisation import layer
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.activations import activation_from_user, activation_named
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights
from export_model.converters.trainers.settings import Settings
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer
from export_model.signatures.errors import SourceError, UsageError
from export_model.signatures.roles import Role

CONFIGS = {"ppo_network_config.json": "PPO", "sac_network_config.json": "SAC"}
_FIX = "give a policy of brax' own PPO or SAC without images, or the function of make_inference_fn by jax2tf"
#: Which script saved a pickle, where nothing lies beside it: whether its policy sees normalised observations.
_SCRIPTS = {"brax-normalised": True, "brax-raw": False}
#: Of flax' LayerNorm.
_EPSILON = 1e-6
_IMAGES = ("policy.CNN_", "policy.VisionMLP_")
#: The deviations, which the action without chance does not need.
_DEVIATIONS = ("policy.Dense_1.", "policy.std_param.", "policy.std_logparam.")


class _Recipe(Struct, frozen=True):
    """What the arrays do not tell, who said it, and in which files."""

    activation: Activation
    normalised: bool
    key: str | None = None
    clip_scale: float | None = None
    algorithm: str = ""
    said_by: str = ""
    files: tuple[Path, ...] = ()


def _recognise(saved: Saved) -> Path | None:
    """Return the folder that brax' configuration may lie in; None where another trainer saved it."""
    return None if saved.settings is None else saved.settings.get("brax")


def _rebuild(saved: Saved, folder: Path) -> Rebuilt:
    weights = Weights(saved.archive, saved.value, holder="its policy", maker="brax", fix=_FIX)
    if images := [name for name in saved.value if name.startswith(_IMAGES)]:
        raise weights.unsupported_error(images[0], "policies that see images are not read from brax")
    squashed = "policy.hidden_0.kernel" in weights
    layers = "policy" if squashed else "policy.MLP_0"
    observed = weights.length(f"{layers}.hidden_0.kernel", 0)
    recipe = _recipe(saved, folder, weights)
    net = Network(weights)
    x = _observe(net, recipe, observed)
    last = len(weights.indices(f"{layers}.hidden_")) - 1
    for index in range(last + 1):
        x = _dense(net, x, f"{layers}.hidden_{index}")
        if index < last or not squashed:
            x = _layer_norm(net, recipe.activation(net, x), f"{layers}.LayerNorm_{index}")
    x = x if squashed else _dense(net, x, "policy.Dense_0")
    net.at("action")
    net.output("action", net.add("Tanh", [_means(net, x)]) if squashed else _clip_mean(net, x, recipe.clip_scale))
    weights.forget("normaliser.", *_DEVIATIONS)
    weights.check_all_read()
    facts = SourceFacts(
        family="brax",
        algorithm=recipe.algorithm or ("PPO" if saved.settings and saved.settings["critic"] else ""),
        outputs={"action": Role.ACTION},
        notes=(
            "no runtime but JAX with brax reads it: its formats are compared with each other only (self-consistent)",
            f"the action is brax' with deterministic=True; observations are {'' if recipe.normalised else 'not '}"
            f"normalised, as {recipe.said_by} says",
        ),
    )
    return Rebuilt(net.graph(), facts, recipe.files)


# ------------------------------------------------------------------ what the arrays do not tell


def _recipe(saved: Saved, folder: Path, weights: Weights) -> _Recipe:
    """Return what brax' configuration says, or else the user. Raises SourceError where neither does, UsageError."""
    for name, algorithm in CONFIGS.items():
        if (folder / name).is_file():
            return _recipe_of(saved, folder / name, algorithm)
    plain = _is_untouched(saved, weights)
    if saved.script is not None and saved.script not in _SCRIPTS:
        raise UsageError(f"--script {saved.script}: unknown script of brax", fix=f"one of: {', '.join(_SCRIPTS)}")
    if saved.activation is None or (saved.script is None and not plain):
        raise SourceError(
            "its parameters do not say which activation its layers have, and whether observations are normalised",
            why=f"brax keeps the statistics up either way, and none of these files is here: {', '.join(CONFIGS)}",
            fix="say both: --activation swish (PPO's own; SAC has relu) and --script brax-normalised "
            "(normalize_observations=True in the training) or --script brax-raw; or give brax' checkpoint folder",
        )
    normalised = _SCRIPTS.get(saved.script or "brax-raw", False)
    return _Recipe(
        _jax_activation(saved.activation),
        normalised,
        said_by="--script" if saved.script else "an empty normaliser",
    )


def _recipe_of(saved: Saved, file: Path, algorithm: str) -> _Recipe:
    """Return what a configuration of brax says. Raises SourceError, UsageError where an option says it again."""
    for option in ("activation", "script"):
        if getattr(saved, option) is not None:
            raise UsageError(f"--{option} says nothing about it", why=f"{file.name} has it", fix="leave it out")
    try:
        content = json_in(saved.given.bytes_of(file))
    except (ValueError, RecursionError) as error:
        raise SourceError(
            f"{file.name} is not JSON", why=str(error)[:200], fix="give the file that brax wrote"
        ) from error
    settings = Settings(content if isinstance(content, dict) else {}, file.name)
    made = settings.section("network_factory_kwargs")
    word = made.text("activation", "swish" if algorithm == "PPO" else "relu")
    if activation_named(word) is None:
        raise made.error("activation", f"is {word[:40]!r}, which is not an activation that is known")
    clip = made.number("mean_clip_scale", 0.0) if "mean_clip_scale" in made else None
    key = made.text("policy_obs_key", "state")
    return _Recipe(
        _jax_activation(word),
        settings.flag("normalize_observations"),
        key=key,
        clip_scale=clip,
        algorithm=algorithm,
        said_by=file.name,
        files=(file,),
    )


def _jax_activation(name: str) -> Activation:
    """Return an activation as JAX computes it: its gelu is the one by tanh (jax.nn.gelu, approximate=True)."""
    found = activation_from_user(name)
    return (lambda b, x: gelu(b, x, tanh=True)) if found is gelu else found


def _is_untouched(saved: Saved, weights: Weights) -> bool:
    """Whether the normaliser has the means and deviations that it was made with."""
    wanted: dict[str, Any] = {"normaliser.mean": 0, "normaliser.std": 1}
    return all(
        bool(np.all(saved.archive.array(t, n) == value))
        for start, value in wanted.items()
        for n, t in saved.value.items()
        if n == start or n.startswith(f"{start}.")
    )


# ------------------------------------------------------------------ layers


def _observe(net: Network, recipe: _Recipe, observed: int) -> str:
    """The observation [B, observed], less its mean, over its deviation where the policy is given that."""
    keys = net.state.under("normaliser.mean.")
    if not keys:
        return _normalise(net, net.input("obs", observed), "", recipe.normalised)
    fitting = [k for k in keys if net.state.shape(f"normaliser.mean.{k}") == (observed,)]
    if recipe.key is not None and recipe.key in fitting:
        fitting = [recipe.key]
    if len(fitting) != 1:
        raise SourceError(
            f"its policy sees {observed} numbers, and it is not said which observation that is",
            why=f"the observations are {', '.join(sorted(keys)[:8])}, of which {len(fitting)} have as many numbers",
            fix=f"give brax' checkpoint folder: {next(iter(CONFIGS))} names it (policy_obs_key)",
        )
    return _normalise(net, net.input(fitting[0], observed), f".{fitting[0]}", recipe.normalised)


def _normalise(net: Network, x: str, key: str, normalised: bool) -> str:
    if not normalised:
        return x
    net.at("normaliser")
    mean, deviation = (net.state.array(f"normaliser.{k}{key}", net.width(x)) for k in ("mean", "std"))
    return net.add("RealDiv", [net.add("Sub", [x, net.const(mean, "mean")]), net.const(deviation, "std")])


def _dense(net: Network, x: str, module: str) -> str:
    """Flax' ``Dense``: x·kernel + bias."""
    net.at(module)
    kernel = net.state.array(f"{module}.kernel", net.width(x), None)
    bias = net.state.array(f"{module}.bias", kernel.shape[1])
    return net.add("BiasAdd", [matmul(net, x, net.const(kernel, "kernel")), net.const(bias, "bias")])


def _layer_norm(net: Network, x: str, module: str) -> str:
    """Flax' ``LayerNorm`` over the last axis; x where there is none."""
    if f"{module}.scale" not in net.state:
        return x
    net.at(module)
    scale, bias = (net.const(net.state.array(f"{module}.{k}", net.width(x)), k) for k in ("scale", "bias"))
    return layer(net, x, 1, scale, bias, _EPSILON)[0]


def _means(net: Network, x: str) -> str:
    """The first half of what the last layer gives: means, then deviations."""
    if net.width(x) % 2:
        raise net.state.damaged_error(
            f"its last layer gives {net.width(x)} numbers", "a mean and a deviation of each action are expected"
        )
    return net.slice(x, 1, 0, net.width(x) // 2)


def _clip_mean(net: Network, mean: str, scale: float | None) -> str:
    """scale·mean/(1 + |mean|); the mean where there is no scale."""
    if scale is None:
        return mean
    over = net.add("Add", [net.add("Abs", [mean]), net.floats(1)])
    return net.add("Mul", [net.add("RealDiv", [mean, over]), net.floats(scale)])


TRAINER = Trainer("brax", _recognise, _rebuild, by_names=False, scripts=True)
