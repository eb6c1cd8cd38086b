"""What CleanRL's scripts compute, release 1.0 and the main branch; ``table.py`` says which file has which names."""

from __future__ import annotations

import numpy as np

from export_model.converters.trainers.rsl_rl import per_action
from export_model.converters.trainers.scripts.building import (
    Making,
    observation_input,
    sequence,
    squash_to_bounds,
    trunk,
)
from export_model.signatures.roles import Role

#: The logarithm of SAC's deviation lies between these.
_LOWEST, _HIGHEST = -5.0, 2.0


def ppo_continuous(making: Making) -> None:
    """Give the mean of a Gaussian, with the logarithm of its deviation."""
    net = making.net
    mean = sequence(making, observation_input(making, "actor_mean.0"), "actor_mean", ends=True)
    net.output("action", mean)
    per_action(net, mean, net.state.array("actor_logstd", 1, net.width(mean)).reshape(-1), "action_log_std")
    making.outputs.update(action=Role.ACTION, action_log_std=Role.LOG_STD)


def ppo_discrete(making: Making, image: str = "") -> None:
    """Draw by the logits of an actor, after a trunk that it shares with the critic or alone; a memory between them.

    ``image`` is what the trunk reads where it is not the observation alone.
    """
    net = making.net
    shared = bool(net.state.under("network."))
    alone = "actor.weight" in net.state
    if shared:
        x = sequence(making, image or observation_input(making, "network.0"), "network", ends=False)
    else:
        x = observation_input(making, "actor" if alone else "actor.0")
    if "lstm.weight_ih_l0" in net.state:
        x, making.memory = net.remembering(x, "lstm")
        making.outputs["recurrent_out"] = Role.MEMORY_OUT
    logits = net.linear(x, "actor") if alone else sequence(making, x, "actor", ends=True)
    net.at("action")
    net.output("action", net.choice(logits))
    making.outputs["action"] = Role.ACTION


def values(making: Making) -> None:
    """Values per action, or (C51) probabilities of values per action."""
    net = making.net
    x = sequence(making, observation_input(making, "network.0"), "network", ends=True)
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


def sac(making: Making) -> None:
    """Draw from a Gaussian, squash to the bounds of the action space."""
    net = making.net
    x = trunk(making)
    mean = net.linear(x, "fc_mean")
    logarithm = net.add("Tanh", [net.linear(x, "fc_logstd", net.width(mean))])
    share = net.add("Mul", [net.add("Add", [logarithm, net.floats(1)]), net.floats((_HIGHEST - _LOWEST) / 2)])
    spread = net.add("Exp", [net.add("Add", [share, net.floats(_LOWEST)])])
    noise = net.add("Mul", [net.normals_like(mean, "action"), spread])
    net.output("action", squash_to_bounds(net, net.add("Add", [mean, noise])))
    making.outputs["action"] = Role.ACTION


def td3(making: Making) -> None:
    """Squash the last layer to the bounds of the action space."""
    net = making.net
    net.output("action", squash_to_bounds(net, net.linear(trunk(making), "fc_mu")))
    making.outputs["action"] = Role.ACTION


def ppo_pettingzoo(making: Making) -> None:
    """Draw as ppo_discrete; of six channels, four are colours and two say whose turn it is."""
    net = making.net
    size = making.saved.image_shape(net.state.length("network.0.weight", 1))
    making.notes.append("four channels of its image have colours from 0 to 255, which the script divides by 255")
    image = net.input("obs", *size)
    net.at("obs_scaled")
    scale = np.array([255] * 4 + [1] * 2, np.float32)
    ppo_discrete(making, net.add("RealDiv", [net.nhwc(image), net.const(scale, "scale")]))
