"""What PPO-PyTorch's PPO.py computes: three layers of an actor, which its one class ends with tanh, softmax or nothing.

The deviation of a continuous action is the constructor's (``action_std_init``), decayed by the script and in no file.
"""

from __future__ import annotations

from export_model.converters.trainers.scripts.building import Making, observation_input, sequence
from export_model.signatures.roles import Role


def _mean(making: Making) -> str:
    making.outputs["action"] = Role.ACTION
    making.notes.append("action is the mean; its deviation is set in the script (0.6, decayed to 0.1), not in the file")
    return sequence(making, observation_input(making, "actor.0"), "actor", ends=True)


def mean(making: Making) -> None:
    """Give the mean of a Gaussian, without an activation behind the last layer."""
    making.net.output("action", _mean(making))


def squashed_mean(making: Making) -> None:
    """Give the mean of a Gaussian, tanh of the last layer."""
    value, net = _mean(making), making.net
    net.at("action")
    net.output("action", net.add("Tanh", [value]))
