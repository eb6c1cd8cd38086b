"""State dictionaries of CleanRL's scripts, by the names that they give their layers.

Source: cleanrl/{ppo,ppo_continuous_action,ppo_atari,ppo_atari_lstm,dqn,dqn_atari,c51,pqn,sac_continuous_action,
td3_continuous_action,ddpg_continuous_action}.py. What is no weight in them (activations, strides, tanh) follows from
those scripts, the activation too, which is said in a note: people change it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from converters.graph.nn.activations import Activation
from converters.graph.nn.normalisation import layer
from converters.graph.nodes import Graph
from converters.policy.facts import SourceFacts
from converters.trainers.pytorch.activations import activation_of
from converters.trainers.pytorch.network import Network
from converters.trainers.pytorch.weights import Weights, pytorch_alone
from converters.trainers.rsl_rl import per_action
from converters.trainers.trainer import Rebuilt, Saved, Trainer
from signatures.errors import SourceError, UsageError
from signatures.roles import Role

_USUAL = "CleanRL's scripts have tanh in PPO, relu elsewhere and before images"
_EXPORT_ONNX = "export the policy to ONNX in its own project (torch.onnx.export), and give that"
#: The logarithm of SAC's deviation lies between these.
_LOWEST, _HIGHEST = -5.0, 2.0
#: (kernel, stride) of the convolutions before Atari's images.
_WINDOWS = ((8, 4), (4, 2), (3, 1))

_Outputs = dict[str, Role | None]


class _Script(Struct, frozen=True):
    """A kind of script.

    ``names`` tell it, ``algorithm`` is what it is called, ``build`` builds it, and ``activation`` is what the scripts
    in ``evidence`` have between their layers; empty: no script has these names.
    """

    names: tuple[str, ...]
    algorithm: str
    build: Callable[[_Making], str]
    activation: str = ""
    evidence: str = ""

    @property
    def default(self) -> tuple[str, str] | None:
        """The activation where neither the user nor a file says it, and the note on it."""
        if not self.activation:
            return None
        said = f"its activation is taken to be {self.activation}, as in CleanRL's {self.evidence}; if it was changed"
        return self.activation, f"{said} there, say which: --activation NAME"


class _Making(Struct):
    net: Network
    activation: Activation
    saved: Saved
    outputs: _Outputs
    notes: list[str]
    memory: tuple[str, ...] = ()


def _state_of(value: Any) -> tuple[Mapping[Any, Any], _Script] | None:
    """The policy's state dictionary in what was saved, and the kind of script; None where it is none of CleanRL's."""
    candidates = [value, *(value if isinstance(value, tuple | list) else ())]
    if isinstance(value, dict):
        candidates += [value.get("model_weights"), value.get("actor")]
    for state in candidates:
        if not isinstance(state, dict):
            continue
        for script in _SCRIPTS:
            if all(any(str(k).startswith(name) for k in state) for name in script.names):
                return state, script
    return None


def _to_graph(
    saved: Saved, state: Mapping[Any, Any], script: _Script, activation: Activation
) -> tuple[Graph, SourceFacts]:
    """The policy and what is known of it. Raises SourceError for unknown parts, DamagedFileError, UsageError."""
    weights = Weights(saved.archive, state, holder="its policy", maker="CleanRL", fix=_EXPORT_ONNX)
    weights.forget("critic", "_critic")
    making = _Making(Network(weights), activation, saved, {}, [])
    meaning = script.build(making)
    weights.check_all_read()
    facts = SourceFacts(
        family="CleanRL",
        algorithm=script.algorithm,
        image_layout="NCHW",
        memory_layout=making.memory,
        outputs=making.outputs,
        notes=(
            pytorch_alone("the script"),
            f"by the names of its layers it is of CleanRL's {script.algorithm}: {meaning}; observations that its "
            "wrappers normalise or clip must come so",
            *making.notes,
        ),
    )
    return making.net.graph(), facts


# ------------------------------------------------------------------ layers


def _observation_input(making: _Making, first: str) -> str:
    """The input that the layer ``first`` reads: numbers, or an image, whose size the user says; divided by 255."""
    net = making.net
    shape = net.state.shape(f"{first}.weight")
    if len(shape) in (1, 2):
        if making.saved.sensors and tuple(making.saved.sensors) != ((shape[-1],),):
            raise UsageError(
                "--sensors does not fit the checkpoint", why=f"it observes {shape[-1]} numbers", fix="leave it out"
            )
        return net.input("obs", shape[-1])
    size = making.saved.image_shape(net.state.length(f"{first}.weight", 1), "; CleanRL stacks four grey frames")
    making.notes.append("its image has colours from 0 to 255, which CleanRL's scripts divide by 255")
    image = net.input("obs", *size)
    net.at("obs_scaled")
    return net.nhwc(net.add("RealDiv", [image, net.floats(255)]))


def _layers(making: _Making, x: str, module: str, *, ends: bool) -> str:
    """``nn.Sequential`` of convolutions, linear layers and layer norms, an activation after each but the last.

    What has no weights is told by its place: one module between two layers is the activation (before images become
    rows: Flatten alone; two are both), none is none, and more could be anything.
    """
    net, state = making.net, making.net.state
    found = state.indices(f"{module}.")
    ranks = {index: len(state.shape(f"{module}.{index}.weight")) for index in found}
    images = [index for index in found if ranks[index] == 4]
    for index, after in itertools.zip_longest(found, found[1:]):
        name = f"{module}.{index}"
        if ranks[index] == 4:
            kernel = state.length(f"{name}.weight", 2)
            place = images.index(index)
            if len(images) != len(_WINDOWS) or kernel != _WINDOWS[place][0]:
                raise state.unsupported_error(
                    name, "its strides are not in the file, and its kernels are not those of CleanRL's scripts"
                )
            x = net.convolution(x, name, _WINDOWS[place][1])
        elif ranks[index] in (1, 3):
            x = _layer_norm(net, x, name)
        else:
            x = net.linear(net.flat(x) if net.rank(x) == 4 else x, name)
        if after is None:
            return x if ends else making.activation(net, x)
        between, norms = after - index - 1, (ranks[index], ranks[after])
        flattened = net.rank(x) == 4 and ranks[after] == 2
        if between == 0 and not flattened and (1 in norms or 3 in norms):
            continue
        if between == flattened + 1:
            x = making.activation(net, x)
        elif between != 1:
            what = "nothing stands" if between == 0 else f"{between} modules without weights stand"
            raise state.unsupported_error(
                module, f"{what} between its layers {index} and {after}, and one activation is expected"
            )
    raise state.unsupported_error(module, "it has no layers")


def _layer_norm(net: Network, x: str, name: str) -> str:
    """``nn.LayerNorm``, of a row or of a whole image [C, H, W]."""
    rank, shape = net.rank(x), net.type_of(x).shape
    assert shape is not None
    sizes = [shape[i] for i in ((3, 1, 2) if rank == 4 else (1,))]
    if len(net.state.shape(f"{name}.weight")) != len(sizes):
        raise net.state.unsupported_error(
            name, "it must be a LayerNorm: what it takes together (groups, a batch) is not in the file"
        )
    scale, bias = (net.state.array(f"{name}.{part}", *map(int, sizes)) for part in ("weight", "bias"))
    if rank == 4:
        scale, bias = scale.transpose(1, 2, 0), bias.transpose(1, 2, 0)
    net.at(name)
    return layer(net, x, 1, net.const(scale, "scale"), net.const(bias, "bias"))[0]


def _trunk(making: _Making) -> str:
    """fc1, fc2 … of SAC, TD3 and DDPG."""
    net, x, number = making.net, _observation_input(making, "fc1"), 1
    while f"fc{number}.weight" in net.state:
        x = making.activation(net, net.linear(x, f"fc{number}"))
        number += 1
    return x


def _squash_to_bounds(net: Network, value: str) -> str:
    """tanh, to the bounds of the action space."""
    net.at("action")
    value = net.add("Tanh", [value])
    scale, bias = (
        net.state.array(name, *(*(1,) * (len(shape) - 1), net.width(value))[: len(shape)]).reshape(-1)
        for name in ("action_scale", "action_bias")
        for shape in (net.state.shape(name),)
    )
    return net.add("Add", [net.add("Mul", [value, net.const(scale, "scale")]), net.const(bias, "bias")])


# ------------------------------------------------------------------ scripts


def _ppo_continuous(making: _Making) -> str:
    net = making.net
    mean = _layers(making, _observation_input(making, "actor_mean.0"), "actor_mean", ends=True)
    net.output("action", mean)
    per_action(net, mean, net.state.array("actor_logstd", 1, net.width(mean)).reshape(-1), "action_log_std")
    making.outputs.update(action=Role.ACTION, action_log_std=Role.LOG_STD)
    return "action is the mean of a Gaussian, action_log_std the logarithm of its deviation"


def _ppo_discrete(making: _Making) -> str:
    """Logits of an actor, after a trunk that it shares with the critic or alone; a memory between them."""
    net = making.net
    shared = bool(net.state.under("network."))
    alone = "actor.weight" in net.state
    if shared:
        x = _layers(making, _observation_input(making, "network.0"), "network", ends=False)
    else:
        first = "" if alone else ".0"
        x = _observation_input(making, f"actor{first}")
        critic = f"critic{first}.weight"
        if critic in net.state and net.state.length(critic, 1) != net.width(x):
            raise SourceError(
                "its actor and its critic are of no PPO",
                why="its critic reads other numbers than its actor: what bounds the actor's action is not in the file",
                fix=_EXPORT_ONNX,
            )
    if "lstm.weight_ih_l0" in net.state:
        x, making.memory = net.remembering(x, "lstm")
        making.outputs["recurrent_out"] = Role.MEMORY_OUT
    logits = net.linear(x, "actor") if alone else _layers(making, x, "actor", ends=True)
    net.at("action")
    net.output("action", net.choice(logits))
    making.outputs["action"] = Role.ACTION
    return f"one choice of {net.width(logits)} actions"


def _values(making: _Making) -> str:
    """Values per action, or (C51) probabilities of values per action."""
    net = making.net
    x = _layers(making, _observation_input(making, "network.0"), "network", ends=True)
    if "atoms" in net.state:
        atoms = net.state.array("atoms", None)
        actions, rest = divmod(net.width(x), max(len(atoms), 1))
        if rest or not actions:
            raise net.state.damaged_error(
                f"its network has {net.width(x)} outputs for {len(atoms)} values", "each action has all"
            )
        net.at("q_values")
        rows = net.reshape(net.add("Softmax", [net.reshape(x, (-1, len(atoms)))]), (-1, actions, len(atoms)))
        x = net.reduce("Sum", net.add("Mul", [rows, net.const(atoms, "atoms")]), [2], keep=False)
    net.highest(x)
    making.outputs.update(action=Role.ACTION, q_values=Role.Q_VALUES)
    return f"the action of the highest of {net.width(x)} values"


def _sac(making: _Making) -> str:
    net = making.net
    x = _trunk(making)
    mean = net.linear(x, "fc_mean")
    logarithm = net.add("Tanh", [net.linear(x, "fc_logstd", net.width(mean))])
    share = net.add("Mul", [net.add("Add", [logarithm, net.floats(1)]), net.floats((_HIGHEST - _LOWEST) / 2)])
    spread = net.add("Exp", [net.add("Add", [share, net.floats(_LOWEST)])])
    noise = net.add("Mul", [net.normals_like(mean, "action"), spread])
    net.output("action", _squash_to_bounds(net, net.add("Add", [mean, noise])))
    making.outputs["action"] = Role.ACTION
    return "the action is drawn, squashed by tanh and scaled"


def _td3(making: _Making) -> str:
    net = making.net
    net.output("action", _squash_to_bounds(net, net.linear(_trunk(making), "fc_mu")))
    making.outputs["action"] = Role.ACTION
    return "the action is squashed by tanh and scaled"


#: Scripts of cleanrl/cleanrl, release 1.0 and its main branch; what stands first is looked for first.
_SCRIPTS = (
    _Script(("actor_mean.0.", "actor_logstd"), "PPO", _ppo_continuous, "tanh", "ppo_continuous_action.py"),
    _Script(
        ("fc1.", "fc_mean.", "fc_logstd.", "action_scale", "action_bias"),
        "SAC",
        _sac,
        "relu",
        "sac_continuous_action.py",
    ),
    _Script(
        ("fc1.", "fc_mu.", "action_scale", "action_bias"),
        "TD3 or DDPG",
        _td3,
        "relu",
        "td3_continuous_action.py and ddpg_continuous_action.py",
    ),
    _Script(("actor.0.", "critic."), "PPO", _ppo_discrete, "tanh", "ppo.py"),
    # Three convolutions, Flatten and a layer; a trunk of other layers before one actor is in no script.
    _Script(
        ("network.0.", "network.2.", "network.4.", "network.7.", "actor.weight", "critic."),
        "PPO",
        _ppo_discrete,
        "relu",
        "ppo_atari.py and ppo_atari_lstm.py",
    ),
    _Script(("actor.weight", "critic."), "PPO", _ppo_discrete),
    _Script(("network.0.", "atoms"), "C51", _values, "relu", "c51.py and c51_atari.py"),
    _Script(("network.0.",), "DQN or PQN", _values, "relu", "dqn.py, dqn_atari.py and pqn.py"),
)


def _rebuild(saved: Saved, found: tuple[Mapping[Any, Any], _Script]) -> Rebuilt:
    state, script = found
    activation, files, notes = activation_of(saved.given, saved.activation, _USUAL, script.default)
    graph, facts = _to_graph(saved, state, script, activation)
    return Rebuilt(graph, replace(facts, notes=(*facts.notes, *notes)), files)


TRAINER = Trainer("CleanRL", lambda saved: _state_of(saved.value), _rebuild)
