"""Trainers' networks, made of PyTorch's own layers, which check that the state is all of their weights.

Each is given a state dictionary, and what the file's reader was told or found of it. It answers by the names that the
reader gives: ``action``, ``recurrent_out``, ``logits_0`` (what the first branch is drawn by) …

Sources: those that converters/trainers names, of the same versions.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import torch
    from torch import nn

State = dict[str, Any]
Network = Callable[[State], State]
Told = Mapping[str, Any]

#: How the name of what a normal draw is fed as ends.
_NOISE = "RandomStandardNormal"


def _of(state: State, module: str) -> State:
    return {n.removeprefix(f"{module}."): t for n, t in state.items() if n.startswith(f"{module}.")}


def _load(layer: nn.Module, state: State, module: str) -> nn.Module:
    layer.load_state_dict(_of(state, module))
    return layer.eval()


def activation_layer(name: str) -> nn.Module:
    """The layer that ``--activation`` names."""
    from torch import nn

    kinds: tuple[type[nn.Module], ...] = (
        *(nn.ReLU, nn.Tanh, nn.Sigmoid, nn.Softplus, nn.Softsign, nn.ELU, nn.SELU, nn.CELU, nn.GELU, nn.SiLU, nn.Mish),
        *(nn.LeakyReLU, nn.ReLU6, nn.Hardtanh, nn.Hardsigmoid, nn.Hardswish, nn.LogSigmoid, nn.Identity),
    )
    for kind in kinds:
        if kind.__name__.lower() == name:
            return kind()
    raise RuntimeError(f"--activation {name} is not known here")


def linear(state: State, module: str) -> nn.Module:
    """``nn.Linear``."""
    from torch import nn

    out, width = state[f"{module}.weight"].shape
    return _load(nn.Linear(width, out, bias=f"{module}.bias" in state), state, module)


def sequence(state: State, module: str, activation: str = "tanh", *, ends: bool = False) -> nn.Sequential:
    """``nn.Sequential`` by the trainer's own numbers: what has no weights there is the activation."""
    from torch import nn

    places = {int(m[1]) for n in state if (m := re.match(rf"{re.escape(module)}\.(\d+)\.", n))}
    layers = nn.Sequential()
    for place in range(max(places, default=-1) + 1):
        name = f"{module}.{place}"
        if place not in places:
            layers.append(activation_layer(activation))
        elif state[f"{name}.weight"].ndim == 1:
            layers.append(_load(nn.LayerNorm(len(state[f"{name}.weight"])), state, name))
        else:
            layers.append(linear(state, name))
    if places and not ends:
        layers.append(activation_layer(activation))
    return layers


class RecurrentLayer:
    """``nn.LSTM`` or ``nn.GRU``; the memory is [B, …]: the layers' h, then (LSTM) their c."""

    def __init__(self, state: State, module: str) -> None:
        from torch import nn

        self._rows, self._hidden = state[f"{module}.weight_hh_l0"].shape
        self._layers = sum(n.startswith("weight_hh_l") for n in _of(state, module))
        kind = nn.LSTM if self._rows == 4 * self._hidden else nn.GRU
        width = state[f"{module}.weight_ih_l0"].shape[1]
        self._module = _load(kind(width, self._hidden, self._layers), state, module)

    def __call__(self, x: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the output of one step, and the memory after it."""
        import torch

        before = memory.reshape(len(memory), -1, self._hidden).transpose(0, 1).contiguous()
        parts = before.split(self._layers)
        y, after = self._module(x[None], parts if len(parts) == 2 else parts[0])
        joined = torch.cat(after) if isinstance(after, tuple) else after
        return y[0], joined.transpose(0, 1).reshape(memory.shape)


def _noise(feeds: State, mean: torch.Tensor) -> torch.Tensor:
    import torch

    return next((t.reshape(mean.shape) for n, t in feeds.items() if n.endswith(_NOISE)), torch.zeros_like(mean))


def _rows_of(values: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
    """The same numbers for every agent."""
    return values.reshape(1, -1).expand(len(mean), -1)


# ------------------------------------------------------------------ rsl_rl


def rsl_rl(state: State, told: Told) -> Network:
    """``ActorCritic``, its recurrent kin, ``StudentTeacher`` of 2.3 and 3.1, ``MLPModel``, ``RNNModel`` of 5.5."""
    actor = sequence(state, told["actor"], told["activation"], ends=True)
    memory = RecurrentLayer(state, told["memory"]) if f"{told['memory']}.weight_ih_l0" in state else None
    normalisers = [_of(state, m) for m in told["normalisers"] if f"{m}._mean" in state]

    def act(feeds: State) -> State:
        x, answers = feeds["obs"], {}
        for normaliser in normalisers:
            x = (x - normaliser["_mean"]) / (normaliser["_std"] + 1e-2)
        if memory is not None:
            x, answers["recurrent_out"] = memory(x, feeds["recurrent_in"])
        answers["action"] = mean = actor(x)
        for key, name in ((told["deviation"], "action_std"), (told["log_deviation"], "action_log_std")):
            if key in state:
                answers[name] = _rows_of(state[key], mean)
        return answers

    return act


# ------------------------------------------------------------------ scripts


def scripts(state: State, told: Told) -> Network:
    """``Agent``, ``Actor`` and ``QNetwork`` of CleanRL's scripts without images, ``ActorCritic`` of PPO-PyTorch."""
    import torch

    build, activation = told["build"], told["activation"]
    whole = partial(sequence, state, activation=activation, ends=True)
    if build in ("sac", "td3"):
        return _off_policy(state, activation)
    if build == "values":
        return partial(_values, whole("network"), state.get("atoms"))
    if build == "ppo_discrete":
        trunk = sequence(state, "network", activation)
        memory = RecurrentLayer(state, "lstm") if "lstm.weight_ih_l0" in state else None
        actor = linear(state, "actor") if "actor.weight" in state else whole("actor")
        return partial(_choice, trunk, memory, actor)
    actor = whole("actor_mean" if build == "ppo_continuous" else "actor")

    def act(feeds: State) -> State:
        mean = actor(feeds["obs"])
        deviation = {"action_log_std": _rows_of(state["actor_logstd"], mean)} if "actor_logstd" in state else {}
        return {"action": torch.tanh(mean) if build == "squashed_mean" else mean, **deviation}

    return act


def _choice(trunk: nn.Module, memory: RecurrentLayer | None, actor: nn.Module, feeds: State) -> State:
    x, answers = trunk(feeds["obs"]), {}
    if memory is not None:
        x, answers["recurrent_out"] = memory(x, feeds["recurrent_in"])
    return {**answers, "logits_0": actor(x)}


def _values(network: nn.Module, atoms: torch.Tensor | None, feeds: State) -> State:
    import torch

    values = network(feeds["obs"])
    if atoms is not None:  # C51
        values = (torch.softmax(values.reshape(len(values), -1, len(atoms)), 2) * atoms).sum(2)
    return {"q_values": values, "action": values.argmax(1, keepdim=True)}


def _off_policy(state: State, activation: str) -> Network:
    import torch

    hidden = [linear(state, f"fc{i}") for i in range(1, 1 + sum(bool(re.match(r"fc\d+\.weight", n)) for n in state))]
    shape = activation_layer(activation)
    mean_layer = linear(state, "fc_mean" if "fc_mean.weight" in state else "fc_mu")
    deviation = linear(state, "fc_logstd") if "fc_logstd.weight" in state else None

    def act(feeds: State) -> State:
        x = feeds["obs"]
        for layer in hidden:
            x = shape(layer(x))
        mean = mean_layer(x)
        if deviation is not None:
            log_std = -5 + 0.5 * (2 - (-5)) * (torch.tanh(deviation(x)) + 1)
            mean = mean + _noise(feeds, mean) * log_std.exp()
        return {"action": torch.tanh(mean) * state["action_scale"] + state["action_bias"]}

    return act


# ------------------------------------------------------------------ Stable-Baselines3


def stable_baselines3(state: State, told: Told) -> Network:
    """``MlpPolicy`` and ``MlpLstmPolicy`` on one row of numbers, of PPO, A2C, TRPO, SAC, TQC, TD3, DDPG, DQN, QRDQN."""
    import torch

    family, activation = told["family"], told["activation"]
    low, high = torch.tensor(told["low"]), torch.tensor(told["high"])
    limit = told["limit"]

    def bound_action(mean: torch.Tensor) -> torch.Tensor:
        if told["squashed"]:
            return low + 0.5 * (torch.tanh(mean) + 1) * (high - low)
        return torch.maximum(torch.minimum(mean, high), low)

    def observe(feeds: State) -> torch.Tensor:
        x = feeds["observation"]
        if limit is None:
            return x
        moved = (x.double() - state["obs_rms.mean"]) / state["obs_rms.deviation"]
        return moved.clip(-limit, limit).float()

    if family in ("values", "quantiles"):
        net = sequence(
            state, "q_net.q_net" if family == "values" else "quantile_net.quantile_net", activation, ends=True
        )

        def value(feeds: State) -> State:
            values = net(observe(feeds))
            if family == "quantiles":
                values = values.reshape(len(values), -1, told["actions"]).mean(1)
            return {"q_values": values, "action": values.argmax(1, keepdim=True)}

        return value
    if family == "actor":
        actor = sequence(state, "actor.mu", activation, ends=True)
        return lambda feeds: {"action": bound_action(actor(observe(feeds)))}
    if family == "gaussian_actor":
        latent = sequence(state, "actor.latent_pi", activation)
        heads = [linear(state, f"actor.{name}") for name in ("mu", "log_std")]

        def draw(feeds: State) -> State:
            x = latent(observe(feeds))
            mean, log_std = (head(x) for head in heads)
            return {"action": bound_action(mean + _noise(feeds, mean) * log_std.clamp(-20, 2).exp())}

        return draw
    memory = RecurrentLayer(state, "lstm_actor") if "lstm_actor.weight_ih_l0" in state else None
    trunks = [sequence(state, f"mlp_extractor.{part}", activation) for part in ("shared_net", "policy_net")]
    head = linear(state, "action_net")

    def act(feeds: State) -> State:
        x, answers = observe(feeds), {}
        if memory is not None:
            x, answers["recurrent_out"] = memory(x, feeds["recurrent_in"])
        for trunk in trunks:
            x = trunk(x)
        out = head(x)
        if "log_std" not in state:
            parts = out.split(told["branches"], 1)
            return {**answers, **{f"logits_{i}": part for i, part in enumerate(parts)}}
        return {**answers, "action": bound_action(out + _noise(feeds, out) * state["log_std"].exp())}

    return act


# ------------------------------------------------------------------ ML-Agents


def mlagents(state: State, told: Told) -> Network:
    """``SimpleActor`` of 0.26 to 1.1 on rows of numbers, each normalised or not, with its LSTM."""
    import torch

    normalisers = [_of(state, f"{module}.normalizer") if module else {} for module in told["sensors"]]
    body = sequence(state, told["body"], "silu")
    memory = RecurrentLayer(state, "network_body.lstm.lstm") if "network_body.lstm.lstm.weight_ih_l0" in state else None
    kinds = "action_model._continuous_distribution", "action_model._discrete_distribution"
    has_mean = f"{kinds[0]}.mu.weight" in state
    mean_layer = linear(state, f"{kinds[0]}.mu") if has_mean else None
    deviation = linear(state, f"{kinds[0]}.log_sigma") if f"{kinds[0]}.log_sigma.weight" in state else None
    branches = [linear(state, f"{kinds[1]}.branches.{i}") for i in range(told["branches"])]

    def act(feeds: State) -> State:
        answers: State = {}
        parts = []
        for i, normaliser in enumerate(normalisers):
            x = feeds[f"obs_{i}"]
            if normaliser:
                spread = torch.sqrt(normaliser["running_variance"] / normaliser["normalization_steps"])
                x = torch.clamp((x - normaliser["running_mean"]) / spread, -5, 5)
            parts.append(x)
        x = body(torch.cat(parts, 1))
        if memory is not None:
            x, answers["recurrent_out"] = memory(x, feeds["recurrent_in"])
        if mean_layer is not None:
            mean = mean_layer(x)
            log_sigma = state[f"{kinds[0]}.log_sigma"] if deviation is None else deviation(x).clamp(-20, 2)
            drawn = mean + _noise(feeds, mean) * log_sigma.exp()
            answers["continuous_actions"] = torch.tanh(drawn) if told["squashed"] else drawn.clamp(-3, 3) / 3
            answers["deterministic_continuous_actions"] = mean
        masks = feeds["action_masks"].split([b.out_features for b in branches], 1) if branches else ()
        for i, (branch, mask) in enumerate(zip(branches, masks, strict=True)):
            logits = branch(x) * mask - 1e8 * (1 - mask)
            answers[f"logits_{i}"] = torch.log(torch.softmax(logits, -1))
        return answers

    return act


#: By what converters/trainers calls them.
NETWORKS: Mapping[str, Callable[[State, Told], Network]] = {
    "rsl_rl": rsl_rl,
    "scripts": scripts,
    "stable_baselines3": stable_baselines3,
    "mlagents": mlagents,
}
