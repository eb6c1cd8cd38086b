"""The scripts whose state dictionaries are read: the names that each gives, what it computes, and the evidence.

CleanRL: cleanrl/<script>.py of release 1.0 and the main branch. PPO-PyTorch: PPO.py and PPO_continuous.py of
nikhilbarhate99/PPO-PyTorch, whose commits bd8b8bf (2021-11-15) and 44813ab (2023-02-07) took tanh out and put it back.

Rows that fit one file compute different things from the same numbers: nothing in the weights decides among them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

from msgspec import Struct

from export_model.converters.files.unpickle import PickledTensor
from export_model.converters.trainers.scripts import cleanrl, ppo_pytorch
from export_model.converters.trainers.scripts.building import Making


class Script(Struct, frozen=True, kw_only=True):
    """One reading of a state dictionary.

    - ``key``: what --script calls it; ``maker``: whose script it is; ``algorithm``: what it trains.
    - ``names``: how its tensors' names begin, each of them; ``without``: how no name begins.
    - ``head``: the module of the last layer, of ``least`` outputs or more; ``says``: what the {n} of them are.
    - ``channels``: of the image, where the script fixes what they are. ``common``: the names are those that networks of
      any kind have, unless they are of convolutions.
    - ``build``: makes the network; ``activation``: between layers in the scripts of ``evidence``. Without one,
      no script has quite these names.
    """

    key: str
    maker: str
    algorithm: str
    names: tuple[str, ...]
    without: tuple[str, ...] = ()
    head: str
    least: int = 1
    says: str
    channels: int | None = None
    common: bool = False
    build: Callable[[Making], None]
    activation: str = ""
    evidence: str = ""

    def has_names_of(self, state: Mapping[Any, Any]) -> bool:
        """Return whether a state dictionary has the names, and the channels."""
        if self.channels is not None and shape_of(state, "network.0.weight")[1:2] != (self.channels,):
            return False
        return all(_begins(state, name) for name in self.names) and not any(_begins(state, n) for n in self.without)

    def is_told_by_names(self, state: Mapping[Any, Any]) -> bool:
        """Return whether the names alone tell that a state dictionary is the script's."""
        return bool(self.activation) and not (self.common and len(shape_of(state, "network.0.weight")) < 3)

    @property
    def default(self) -> tuple[str, str] | None:
        """The activation where neither the user nor a file says it, and the note on it."""
        if not self.activation:
            return None
        said = f"its activation is taken to be {self.activation}, as in {self.maker}'s {self.evidence}; if it was"
        return self.activation, f"{said} changed there, say which: --activation NAME"

    def reading(self, state: Mapping[Any, Any]) -> str:
        """Return what the last layer's numbers are."""
        return self.says.format(n=width_of(state, self.head))


def _begins(state: Mapping[Any, Any], start: str) -> bool:
    return any(str(name).startswith(start) for name in state)


def shape_of(state: Mapping[Any, Any], name: str) -> tuple[int, ...]:
    """Return the shape of a tensor; () where there is none of that name."""
    tensor = state.get(name)
    return tensor.shape if isinstance(tensor, PickledTensor) else ()


def width_of(state: Mapping[Any, Any], module: str) -> int:
    """Return how many numbers the last layer of a module gives; 0 where it has none."""
    ends = [
        (int(match[1] or 0), shape[0])
        for name in state
        if isinstance(name, str) and (match := re.fullmatch(rf"{module}\.(?:(\d{{1,6}})\.)?weight", name))
        if (shape := shape_of(state, name))
    ]
    return max(ends, default=(0, 0))[1]


CLEANRL, PPO_PYTORCH = "CleanRL", "PPO-PyTorch"
_CHOICE = "one choice of {n}, drawn by its logits"
_VALUES = "the action of the highest of its values"
_ATARI = ("network.0.", "network.2.", "network.4.", "network.7.", "actor.weight", "critic.")
_ALONE = {"names": ("actor.0.", "critic."), "without": ("network.", "lstm."), "head": "actor", "activation": "tanh"}
_PPO: Any = {"key": "cleanrl-ppo", "maker": CLEANRL, "algorithm": "PPO", "head": "actor", "least": 2, "says": _CHOICE}
_PYTORCH: Any = {"maker": PPO_PYTORCH, "algorithm": "PPO", **_ALONE}
SCRIPTS = (
    Script(
        key="cleanrl-ppo-continuous",
        maker=CLEANRL,
        algorithm="PPO",
        names=("actor_mean.0.", "actor_logstd"),
        head="actor_mean",
        says="{n} means of a Gaussian, action_log_std the logarithm of its deviation",
        build=cleanrl.ppo_continuous,
        activation="tanh",
        evidence="ppo_continuous_action.py and rpo_continuous_action.py",
    ),
    Script(
        key="cleanrl-sac",
        maker=CLEANRL,
        algorithm="SAC",
        names=("fc1.", "fc_mean.", "fc_logstd.", "action_scale", "action_bias"),
        head="fc_mean",
        says="{n} numbers, drawn, squashed by tanh and scaled",
        build=cleanrl.sac,
        activation="relu",
        evidence="sac_continuous_action.py",
    ),
    Script(
        key="cleanrl-td3",
        maker=CLEANRL,
        algorithm="TD3 or DDPG",
        names=("fc1.", "fc_mu.", "action_scale", "action_bias"),
        head="fc_mu",
        says="{n} numbers, squashed by tanh and scaled",
        build=cleanrl.td3,
        activation="relu",
        evidence="td3_continuous_action.py and ddpg_continuous_action.py",
    ),
    Script(**{**_PPO, **_ALONE}, build=cleanrl.ppo_discrete, evidence="ppo.py"),
    Script(
        key="ppo-pytorch-discrete",
        **_PYTORCH,
        least=2,
        says="one choice of {n}, drawn by their softmax",
        build=cleanrl.ppo_discrete,
        evidence="PPO.py, has_continuous_action_space = False",
    ),
    Script(
        key="ppo-pytorch-continuous",
        **_PYTORCH,
        says="{n} means, the tanh of the last layer",
        build=ppo_pytorch.squashed_mean,
        evidence="PPO.py, has_continuous_action_space = True, until November 2021 and from February 2023",
    ),
    Script(
        key="ppo-pytorch-continuous-2022",
        **_PYTORCH,
        says="{n} means, the last layer itself",
        build=ppo_pytorch.mean,
        evidence="PPO.py, has_continuous_action_space = True, in between",
    ),
    Script(
        **_PPO,
        names=_ATARI,
        build=cleanrl.ppo_discrete,
        activation="relu",
        evidence="ppo_atari.py and ppo_atari_lstm.py, which divide the image by 255",
    ),
    Script(
        **{**_PPO, "key": "cleanrl-ppo-pettingzoo"},
        names=_ATARI,
        without=("lstm.",),
        channels=6,
        build=cleanrl.ppo_pettingzoo,
        activation="relu",
        evidence="ppo_pettingzoo_ma_atari.py, which divides four of six channels by 255",
    ),
    Script(**_PPO, names=("actor.weight", "critic."), build=cleanrl.ppo_discrete),
    Script(**_PPO, names=("network.0.", "actor.0.", "critic."), build=cleanrl.ppo_discrete),
    Script(
        key="cleanrl-c51",
        maker=CLEANRL,
        algorithm="C51",
        names=("network.0.", "atoms"),
        head="network",
        least=2,
        says=_VALUES,
        build=cleanrl.values,
        activation="relu",
        evidence="c51.py and c51_atari.py",
    ),
    Script(
        key="cleanrl-dqn",
        maker=CLEANRL,
        algorithm="DQN or PQN",
        names=("network.0.",),
        without=("atoms", "actor.", "critic."),
        common=True,
        head="network",
        least=2,
        says=_VALUES,
        build=cleanrl.values,
        activation="relu",
        evidence="dqn.py, dqn_atari.py and pqn.py",
    ),
)
