"""A policy of Stable-Baselines3 as a graph: what ``predict`` computes of an observation.

Source: stable_baselines3/common/{policies,torch_layers,distributions,preprocessing}.py, {dqn,sac,td3}/policies.py, and
sb3_contrib/common/{maskable,recurrent}/policies.py, {qrdqn,tqc,crossq,ars}/policies.py. The class tells the family,
``policy_kwargs`` what differs from its defaults (which no version changed), the weights everything else.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
from msgspec import Struct, field

from export_model.converters.graph.nn.activations import Activation, clip
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.types import FLOAT32, INT64
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.activations import activation_from_user, activation_named, name_of
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import TensorFile, Weights, pytorch_alone
from export_model.converters.trainers.stable_baselines3.layers import renormalised_mlp
from export_model.converters.trainers.stable_baselines3.normaliser import Normaliser
from export_model.converters.trainers.stable_baselines3.spaces import Space, space_of
from export_model.converters.trainers.trainer import Modules
from export_model.signatures.errors import DamagedFileError, SourceError, UsageError
from export_model.signatures.roles import Role

_EXPORT_ONNX = "export the model to ONNX in its own project (torch.onnx.export), and give that"
#: What a space is: one, or several by their keys.
Observed: TypeAlias = "Space | Mapping[str, Space]"
#: What no action depends on.
_TRAINING = (
    *("value_net.", "mlp_extractor.value_net.", "vf_features_extractor.", "lstm_critic.", "critic.", "critic_target."),
    *("q_net_target.", "quantile_net_target.", "actor_target."),
)
#: Inputs and outputs of ours that no observation may be called.
_TAKEN = ("action", "action_masks", "recurrent_in", "recurrent_out", "q_values", "epsilon")


class _Family(Struct, frozen=True):
    """A class of policies: its trainer, its default activation, how it acts, and whether tanh bounds its action."""

    algorithm: str
    activation: str
    build: Callable[[_Built, Observed], None]
    squashed: bool = False


class _Built(Struct):
    """A policy in the making."""

    net: Network
    kwargs: Mapping[str, Any]
    actions: Space
    activation: Activation
    squashed: bool
    maskable: bool
    normaliser: Normaliser | None = None
    roles: dict[str, Role] = field(default_factory=dict)
    outputs: dict[str, Role | None] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def to_graph(
    data: Mapping[str, Any],
    archive: TensorFile,
    state: Mapping[Any, Any],
    activation: str | None,
    normaliser: Normaliser | None,
) -> tuple[Graph, SourceFacts, Modules | None]:
    """The policy, what is known of it, and its modules where these are plain.

    ``activation`` is what the user names, ``normaliser`` what lies beside it.
    Raises SourceError for what is not built, DamagedFileError, UsageError.
    """
    family = _family(data)
    kwargs = data.get("policy_kwargs")
    kwargs = kwargs if isinstance(kwargs, dict) else {}
    weights = Weights(archive, state, holder="its policy", maker="Stable-Baselines3", fix=_EXPORT_ONNX)
    weights.forget(*_TRAINING)
    actions = space_of(data, "action_space")
    if isinstance(actions, dict):
        raise SourceError("its action space is a Dict", why="no policy of the library has one", fix=_EXPORT_ONNX)
    made = _Built(
        net=Network(weights),
        kwargs=kwargs,
        actions=actions,
        activation=_activation(kwargs, family, activation),
        squashed=family.squashed or _flag(kwargs, "squash_output"),
        maskable=family.algorithm == "MaskablePPO",
        normaliser=normaliser,
    )
    observed = space_of(data, "observation_space")
    if normaliser is not None:
        normaliser.check(observed.keys() if isinstance(observed, Mapping) else None)
    _check_class(kwargs)
    family.build(made, observed)
    weights.check_all_read()
    algorithm = family.algorithm or _on_policy(data)
    memory = ("h", "c") if "recurrent_out" in made.outputs else ()
    facts = SourceFacts(
        roles=made.roles,
        family="Stable-Baselines3",
        algorithm=algorithm,
        image_layout="NCHW",
        memory_layout=memory,
        distributions={} if normaliser is None else normaliser.distributions(made.roles),
        outputs=made.outputs,
        notes=(pytorch_alone("Stable-Baselines3"), *(normaliser.notes() if normaliser else ()), *made.notes),
    )
    return made.net.graph(), facts, _modules(made, family, observed)


def _modules(made: _Built, family: _Family, observed: Observed) -> Modules | None:
    """What PyTorch builds: of policies that see one row of numbers, and do without gSDE, masks and bits."""
    name, known = family.build.__name__.strip("_"), made.net.state.arrays()
    plain = isinstance(observed, Space) and len(observed.shape) == 1 and not observed.counts
    gsde = known.get("log_std", np.zeros(1)).ndim > 1 or (
        name == "gaussian_actor" and "actor.log_std.weight" not in known
    )
    renormalised = any(n.endswith("ra_mean") for n in known)
    own = gsde or renormalised or made.maskable or name == "ars_policy" or made.actions.kind == "MultiBinary"
    if not plain or own:
        return None
    low, high = made.actions.bounds() if made.actions.kind == "Box" else ((), ())
    told = {
        "family": name,
        "activation": name_of(made.activation),
        "squashed": made.squashed,
        "low": [float(n) for n in low],
        "high": [float(n) for n in high],
        "branches": list(made.actions.counts),
        "actions": made.actions.size,
    }
    normaliser = made.normaliser if made.normaliser is not None and made.normaliser.applied else None
    moments = next(iter(normaliser.applied.values())) if normaliser else None
    arrays = {"obs_rms.mean": moments.mean, "obs_rms.deviation": moments.deviation} if moments else {}
    told["limit"] = normaliser.limit if normaliser else None
    return Modules("stable_baselines3", made.net.state, told, arrays)


# ------------------------------------------------------------------ what data says


def _family(data: Mapping[str, Any]) -> _Family:
    entry = data.get("policy_class")
    module = entry.get("__module__") if isinstance(entry, dict) else None
    found = _FAMILIES.get(module) if isinstance(module, str) else None
    if found is None:
        said = f"its class is of {module[:80]}" if isinstance(module, str) else "its class is not known"
        raise SourceError(
            "its policy is none that is built here",
            why=f"{said}; what a class of one's own computes is not in the file. Policies of PPO, A2C, TRPO, SAC, TD3, "
            "DDPG, DQN, and of sb3-contrib's MaskablePPO, RecurrentPPO, QRDQN, TQC, CrossQ, ARS are",
            fix=_EXPORT_ONNX,
        )
    return found


def _on_policy(data: Mapping[str, Any]) -> str:
    """Which trainer an ActorCriticPolicy is of, by the settings that only it has."""
    return "PPO" if "clip_range" in data else "TRPO" if "cg_max_steps" in data else "A2C"


def _flag(kwargs: Mapping[str, Any], name: str, *, default: bool = False) -> bool:
    """A truth value, which may stand as text beside values that JSON lacks."""
    return str(kwargs.get(name, default)) == "True"


def _number(kwargs: Mapping[str, Any], name: str, default: float) -> float:
    """A number of ``policy_kwargs``. Raises DamagedFileError."""
    text = str(kwargs.get(name, default))
    try:
        return float(text)
    except ValueError as error:
        raise DamagedFileError(
            f"{name} must be a number", why=f"its policy_kwargs have {text[:40]!r}", fix="save the model again"
        ) from error


def _activation(kwargs: Mapping[str, Any], family: _Family, wanted: str | None) -> Activation:
    """The one that the policy was made with; what ``data`` cannot tell (a function of one's own) the user says."""
    text = str(kwargs.get("activation_fn", family.activation))
    match = re.fullmatch(r"(?:<class ')?(?:[\w.]*\.)?(\w+)(?:'>)?", text)
    said = None if match is None else activation_named(match[1])
    if wanted is not None:
        given = activation_from_user(wanted)
        if said is not None and said is not given and match is not None:
            raise UsageError(
                f"--activation {wanted} contradicts the file", why=f"it says {match[1]}", fix="leave --activation out"
            )
        return given
    if said is None:
        raise SourceError(
            f"its activation is not known: {text[:80]}",
            why="a function is not in the file, only its name",
            fix="say which of the usual ones it is: --activation elu; or " + _EXPORT_ONNX,
        )
    return said


def _check_class(kwargs: Mapping[str, Any]) -> None:
    """Raise SourceError where the observations go through an extractor of the user's own."""
    text = str(kwargs.get("features_extractor_class", ""))
    name = text.strip("<>'").rpartition(".")[2].strip("'")
    if text and (name not in ("FlattenExtractor", "NatureCNN", "CombinedExtractor") or "stable_baselines3" not in text):
        raise SourceError(
            f"its features extractor is {name[:60]}",
            why="what a class of one's own computes is not in the file",
            fix=_EXPORT_ONNX,
        )


# ------------------------------------------------------------------ observations


def _features(made: _Built, observed: Observed, module: str) -> str:
    """The features of all observations, side by side; ``module`` holds the extractor's weights."""
    if isinstance(observed, Space):
        return _encode(made, "observation", observed, module)
    parts = [_encode(made, key, space, f"{module}.extractors.{key}") for key, space in observed.items()]
    made.net.at(module)
    return made.net.concat(parts, 1)


def _encode(made: _Built, key: str, space: Space, module: str) -> str:
    net = made.net
    name = re.sub(r"[^A-Za-z0-9_.]", "_", key).lstrip("_.") or "observation"
    name = f"{name}_observation" if name in _TAKEN or name in made.roles else name
    whole = bool(space.counts)
    shape = ((len(space.counts),) if space.kind == "MultiDiscrete" else ()) if whole else space.shape
    nature = f"{module}.cnn.0.weight" in net.state
    x = net.named_input(name, INT64 if whole else FLOAT32, (None, *shape), name)
    made.roles[name] = Role.VISUAL if len(shape) == 3 and (space.image or nature) else Role.VECTOR
    net.at(f"{module}.{key}")
    if whole:
        columns = [x] if not shape else [_column(net, x, i) for i in range(shape[0])]
        hot = [
            net.add("OneHot", [c, net.ints(n, "depth"), net.floats(1, "on"), net.floats(0, "off")], axis=-1)
            for c, n in zip(columns, space.counts, strict=True)
        ]
        return net.concat(hot, 1)
    if made.normaliser is not None and key in made.normaliser.moments:
        x = made.normaliser.apply(net, x, name, key, space.shape)
    if space.image and _flag(made.kwargs, "normalize_images", default=True):
        x = net.add("RealDiv", [x, net.floats(255)])
    if nature:
        return _nature(net, x, module)
    return x if len(shape) == 1 else net.reshape(x, (-1, space.size))


def _column(net: Network, x: str, index: int) -> str:
    return net.squeeze(net.slice(x, 1, index, index + 1), [1])


def _nature(net: Network, image: str, module: str) -> str:
    """``NatureCNN`` on [B, C, H, W]."""
    if net.rank(image) != 4:
        raise DamagedFileError(
            f"{module} sees no image", why="its observation space has no three axes", fix=_EXPORT_ONNX
        )
    x = net.nhwc(image)
    for index, stride in ((0, 4), (2, 2), (4, 1)):
        x = net.add("Relu", [net.convolution(x, f"{module}.cnn.{index}", stride)])
    return net.add("Relu", [net.linear(net.flat(x), f"{module}.linear.0")])


# ------------------------------------------------------------------ families


def _actor_critic(made: _Built, observed: Observed) -> None:
    """``ActorCriticPolicy`` and its maskable and recurrent kin: Gaussian, categorical or Bernoulli actions."""
    net, own = made.net, "pi_features_extractor"
    own = own if net.state.under(f"{own}.") else "features_extractor"
    x = _features(made, observed, own)
    net.state.forget("features_extractor.")  # the same, or the critic's
    if "lstm_actor.weight_ih_l0" in net.state:
        x, _ = net.remembering(x, "lstm_actor")
        made.outputs["recurrent_out"] = Role.MEMORY_OUT
    for part in ("shared_net", "policy_net"):
        x = net.mlp(x, f"mlp_extractor.{part}", made.activation)
    out = net.linear(x, "action_net")
    if made.actions.kind != "Box":
        _categorical(made, out)
        return
    if len(net.state.shape("log_std")) == 1:
        net.at("action_net")
        with np.errstate(over="ignore", invalid="ignore"):  # a damaged file: verification finds it
            spread = np.exp(net.state.array("log_std", net.width(out)).astype(np.float64)).astype(FLOAT32)
        _continuous(made, out, net.const(spread, "std"))
        return
    _continuous(made, out, _state_dependent(made, x, "log_std", net.width(out)))


def _gaussian_actor(made: _Built, observed: Observed) -> None:
    """``Actor`` of SAC, TQC and CrossQ: a mean and a deviation that depends on the observation, squashed by tanh."""
    net = made.net
    epsilon = _number(made.kwargs, "batch_norm_eps", 1e-3)
    x = _features(made, observed, "actor.features_extractor")
    x = renormalised_mlp(net, x, "actor.latent_pi", made.activation, epsilon)
    if "actor.log_std.weight" in net.state:
        mean = net.linear(x, "actor.mu")
        logarithm = clip(net, net.linear(x, "actor.log_std", net.width(mean)), -20, 2)
        _continuous(made, mean, net.add("Exp", [logarithm]))
        return
    limit = _number(made.kwargs, "clip_mean", 2.0)
    mean = net.linear(x, "actor.mu.0" if "actor.mu.0.weight" in net.state else "actor.mu")
    mean = clip(net, mean, -limit, limit) if limit > 0 else mean
    _continuous(made, mean, _state_dependent(made, x, "actor.log_std", net.width(mean)))


def _actor(made: _Built, observed: Observed) -> None:
    """``Actor`` of TD3 and DDPG: tanh of a mean; what they add to explore belongs to training."""
    x = _features(made, observed, "actor.features_extractor")
    _continuous(made, made.net.mlp(x, "actor.mu", made.activation, ends=True), None)


def _ars_policy(made: _Built, observed: Observed) -> None:
    """``ARSPolicy``, and ``ARSLinearPolicy``, whose default is neither to squash nor to have hidden layers."""
    net = made.net
    x = _features(made, observed, "features_extractor")
    if "action_net.weight" in net.state:  # ARSLinearPolicy before sb3-contrib 1.7
        linear, out = True, net.linear(x, "action_net", biased="action_net.bias" in net.state)
    else:
        linear = len(net.state.indices("action_net.")) == 1 and "net_arch" not in made.kwargs
        out = net.mlp(x, "action_net", made.activation, ends=True, biased="action_net.0.bias" in net.state)
    if made.actions.kind == "Discrete":
        if net.width(out) != made.actions.size:
            raise _mixed_models_error(
                f"its network has {net.width(out)} logits, and its space {made.actions.size} actions"
            )
        net.highest(out, None)
        made.outputs["action"] = Role.ACTION
        return
    made.squashed = _flag(made.kwargs, "squash_output", default=not linear)
    _continuous(made, out, None)


def _values(made: _Built, observed: Observed) -> None:
    """``QNetwork``: the action of the highest value."""
    x = _features(made, observed, "q_net.features_extractor")
    _highest(made, made.net.mlp(x, "q_net.q_net", made.activation, ends=True))


def _quantiles(made: _Built, observed: Observed) -> None:
    """``QuantileNetwork``: the mean of each action's quantiles is its value."""
    net = made.net
    x = _features(made, observed, "quantile_net.features_extractor")
    x = net.mlp(x, "quantile_net.quantile_net", made.activation, ends=True)
    count = made.actions.size
    if not count or net.width(x) % count:
        raise DamagedFileError(
            f"its quantiles are {net.width(x)} for {count} actions", why="each has as many", fix=_EXPORT_ONNX
        )
    _highest(made, net.reduce("Mean", net.reshape(x, (-1, net.width(x) // count, count)), [1], keep=False))


# ------------------------------------------------------------------ actions


def _state_dependent(made: _Built, x: str, name: str, actions: int) -> str:
    """The deviation of gSDE's noise, x·N(0, σ²): √(x²·σ²). Training keeps one draw for some steps."""
    net = made.net
    logarithm = net.state.array(name, net.width(x), None).astype(np.float64)
    if _flag(made.kwargs, "use_expln"):
        above = np.log1p(np.maximum(logarithm, 0) + 1e-6) + 1
        std = np.where(logarithm > 0, above, np.exp(np.minimum(logarithm, 0)))
    else:
        std = np.exp(logarithm)
    if std.shape[1] not in (1, actions):
        raise DamagedFileError(
            f"{name} has {std.shape[1]} columns", why=f"there are {actions} actions", fix=_EXPORT_ONNX
        )
    made.notes.append(
        "its noise depends on the state (gSDE): epsilon is drawn for every step here, training kept it for some steps"
    )
    net.at(name)
    variance = net.const(np.broadcast_to(std**2, (len(std), actions)).astype(FLOAT32), "variance")
    return net.add("Sqrt", [net.add("MatMul", [net.add("Square", [x]), variance])])


def _continuous(made: _Built, mean: str, spread: str | None) -> None:
    """``action`` as ``predict`` gives it: drawn, squashed and scaled to the bounds of the space, or clipped to them."""
    net = made.net
    net.at("action")
    if net.width(mean) != made.actions.size:
        raise _mixed_models_error(f"its network has {net.width(mean)} actions, and its space {made.actions.size}")
    value = mean
    if spread is not None:
        value = net.add("Add", [mean, net.add("Mul", [net.normals_like(mean, "action"), spread])])
    low, high = made.actions.bounds()
    if made.squashed:
        value = net.add("Tanh", [value])
        if (low != -1).any() or (high != 1).any():
            half = net.add("Mul", [net.add("Add", [value, net.floats(1)]), net.floats(0.5)])
            value = net.add("Add", [net.add("Mul", [half, net.const(high - low, "range")]), net.const(low, "low")])
    else:
        value = clip(net, value, _limit(net, low, "low"), _limit(net, high, "high"))
    if len(made.actions.shape) > 1:
        made.notes.append(f"its actions are {made.actions.shape} in the environment; here they are one row")
    net.output("action", value)
    made.outputs["action"] = Role.ACTION


def _mixed_models_error(what: str) -> DamagedFileError:
    return DamagedFileError(what, why="they are of different models", fix="save the model again: model.save")


def _limit(net: Network, limits: np.ndarray, name: str) -> str | None:
    """A bound as a constant; None where no action has one."""
    if not np.isfinite(limits).any():
        return None
    largest = np.finfo(FLOAT32).max
    return net.const(np.clip(limits, -largest, largest), name)


def _categorical(made: _Built, logits: str) -> None:
    """One draw per branch; a bit (MultiBinary) is a branch of two, whose first logit is 0."""
    net, space = made.net, made.actions
    width = net.width(logits)
    bits = space.kind == "MultiBinary"
    sizes = (2,) * space.size if bits else space.counts
    masked = _masks(made, sum(sizes), logits)
    net.at("action")
    columns = 1 if bits and width == len(sizes) else 0
    if width != (len(sizes) if columns else sum(sizes)):
        raise _mixed_models_error(f"its network has {width} logits, and its action space {sum(sizes)} actions")
    parts, start = [], 0
    for size in sizes:
        step = columns or size
        branch = net.slice(masked, 1, start, start + step) if len(sizes) > 1 else masked
        if columns:
            branch = net.concat([net.add("ZerosLike", [branch]), branch], 1)
        parts.append(net.choice(branch))
        start += step
    net.output("action", net.concat(parts, 1))
    made.outputs["action"] = Role.ACTION


def _masks(made: _Built, count: int, logits: str) -> str:
    """The logits, with those of forbidden actions taken out where the policy is maskable."""
    if not made.maskable:
        return logits
    net = made.net
    masks = net.input("action_masks", count)
    net.at("action")
    return net.forbid(logits, masks)


def _highest(made: _Built, values: str) -> None:
    net = made.net
    if made.actions.kind != "Discrete" or net.width(values) != made.actions.size:
        raise _mixed_models_error(
            f"its network values {net.width(values)} actions, and its space has {made.actions.size}"
        )
    net.highest(values)
    made.outputs |= {"action": Role.ACTION, "q_values": Role.Q_VALUES}


#: By the module of the policy's class.
_FAMILIES = {
    "stable_baselines3.common.policies": _Family("", "Tanh", _actor_critic),
    "sb3_contrib.common.maskable.policies": _Family("MaskablePPO", "Tanh", _actor_critic),
    "sb3_contrib.common.recurrent.policies": _Family("RecurrentPPO", "Tanh", _actor_critic),
    "stable_baselines3.sac.policies": _Family("SAC", "ReLU", _gaussian_actor, True),
    "sb3_contrib.tqc.policies": _Family("TQC", "ReLU", _gaussian_actor, True),
    "sb3_contrib.crossq.policies": _Family("CrossQ", "ReLU", _gaussian_actor, True),
    "sb3_contrib.ars.policies": _Family("ARS", "ReLU", _ars_policy),
    "stable_baselines3.td3.policies": _Family("TD3", "ReLU", _actor, True),
    "stable_baselines3.dqn.policies": _Family("DQN", "ReLU", _values),
    "sb3_contrib.qrdqn.policies": _Family("QRDQN", "ReLU", _quantiles),
}
