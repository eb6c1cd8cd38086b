"""Checkpoints of FastTD3 (``models/<run>_<step>.pt``, ``<run>_final.pt``): an actor and its normaliser.

Source: fast_td3/{fast_td3,fast_td3_simbav2,fast_td3_deploy,fast_td3_utils}.py of May 2026. The policy is what
``fast_td3_deploy.Policy`` gives: ``tanh``, without the noise of training. An actor of several tasks is refused.
"""

from __future__ import annotations

import math
from typing import Any

from export_model.converters.graph.nn.activations import NAMED
from export_model.converters.graph.nn.normalisation import layer
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights, pytorch_alone
from export_model.converters.trainers.trainer import Rebuilt, Saved, Trainer
from export_model.signatures.errors import SourceError
from export_model.signatures.roles import Role

_FIX = "export fast_td3_deploy.load_policy(CHECKPOINT) to ONNX (torch.onnx.export), and give that"
_STATE = "actor_state_dict"
_NORMALISER = "obs_normalizer"
#: Of the actor that explores while it is trained.
_EXPLORING = ("noise_scales", "std_min", "std_max")
#: SimbaV2: what is joined to every observation (``c_shift`` in fast_td3_deploy.py), added to lengths, and to a ReLU.
_SHIFT, _EPSILON = 3.0, 1e-8


def _recognise(saved: Saved) -> bool | None:
    """Return whether its actor is SimbaV2's; None where FastTD3 did not save it."""
    state = saved.value.get(_STATE) if isinstance(saved.value, dict) else None
    if not isinstance(state, dict) or f"{_NORMALISER}_state" not in saved.value:
        return None
    return "embedder.w.w.weight" in state if {"fc_mu.0.weight", "embedder.w.w.weight"} & state.keys() else None


def _rebuild(saved: Saved, simba: bool) -> Rebuilt:
    saved.refuse_activation("FastTD3", "its actors have ReLU between their layers")
    arguments = saved.value.get("args")
    statistics = saved.value[f"{_NORMALISER}_state"] or {}
    state = {**saved.value[_STATE], **{f"{_NORMALISER}.{k}": v for k, v in statistics.items()}}
    if "task_embedding.weight" in state:
        raise SourceError(
            "an actor of several tasks is not read from a checkpoint",
            why="it looks its task up in a table, by the last columns of the observation",
            fix=_FIX,
        )
    weights = Weights(saved.archive, state, holder="its actor", maker="FastTD3", fix=_FIX)
    weights.forget(*_EXPLORING)
    net = Network(weights)
    observed = weights.length("embedder.w.w.weight", 1) - 1 if simba else weights.length("net.0.weight", 1)
    x = net.empirical(net.input("obs", observed), _NORMALISER)
    action = _simba(net, x) if simba else _plain(net, x, arguments if isinstance(arguments, dict) else {})
    net.output("action", net.add("Tanh", [action]))
    weights.check_all_read()
    facts = SourceFacts(
        family="FastTD3",
        algorithm="TD3",
        outputs={"action": Role.ACTION},
        notes=(
            pytorch_alone("FastTD3"),
            "the action is the actor's, from −1 to 1, without the noise of training; the environment scales it",
        ),
    )
    return Rebuilt(net.graph(), facts)


def _plain(net: Network, x: str, arguments: dict[str, Any]) -> str:
    """``Actor`` before its tanh: layers with ReLU, or a head whose groups are distributions (SimNorm)."""
    relu = NAMED["relu"]
    x = net.mlp(x, "net", relu)
    if "fc_head.linear.weight" not in net.state:
        return net.linear(net.mlp(x, "fc_head", relu), "fc_mu.0")
    x = net.linear(x, "fc_head.linear")
    groups = arguments.get("actor_seq_len")
    width = net.width(x)
    if not isinstance(groups, int) or groups < 1 or width % groups:
        raise net.state.damaged_error(
            f"its args say that the {width} numbers of fc_head are actor_seq_len={groups!r} groups",
            "that many do not fit, and each group is normalised by itself",
        )
    net.at("fc_head")
    scale, shift = (net.const(net.state.array(f"fc_head.norm.{k}", width), k) for k in ("weight", "bias"))
    x, *_ = layer(net, x, 1, scale, shift)
    x = net.add("Softmax", [net.reshape(x, (-1, groups, width // groups))])
    return net.linear(net.reshape(x, (-1, width)), "fc_mu.0")


def _simba(net: Network, x: str) -> str:
    """SimbaV2's ``Actor`` before its tanh. Layers have no bias, and rows of length 1 go from block to block."""
    net.at("embedder")
    x = _of_length_1(net, net.pad(x, ((0, 0), (0, 1)), _SHIFT))
    x = _of_length_1(net, _scale_by(net, net.linear(x, "embedder.w.w", biased=False), "embedder.scaler"))
    blocks = net.state.indices("encoder.")
    for index in blocks:
        block = f"encoder.{index}"
        inner = _scale_by(net, net.linear(x, f"{block}.mlp.w1.w", biased=False), f"{block}.mlp.scaler")
        inner = net.add("Add", [net.add("Relu", [inner]), net.floats(_EPSILON)])
        inner = _of_length_1(net, net.linear(inner, f"{block}.mlp.w2.w", biased=False))
        # forward_scaler = alpha_init / alpha_scale = √width / (blocks + 1); 1 everywhere else
        step = _scale_by(
            net,
            net.add("Sub", [inner, x]),
            f"{block}.alpha_scaler",
            math.sqrt(net.width(x)) / (len(blocks) + 1),
        )
        x = _of_length_1(net, net.add("Add", [x, step]))
    mean = _scale_by(net, net.linear(x, "predictor.mean_w1.w", biased=False), "predictor.mean_scaler")
    mean = net.linear(mean, "predictor.mean_w2.w", biased=False)
    return net.add("Add", [mean, net.const(net.state.array("predictor.mean_bias", net.width(mean)), "bias")])


def _scale_by(net: Network, x: str, module: str, factor: float = 1.0) -> str:
    """``Scaler``: a learned factor for each column, times ``forward_scaler``."""
    net.at(module)
    return net.add("Mul", [x, net.const(net.state.array(f"{module}.scaler", net.width(x)) * factor, "scale")])


def _of_length_1(net: Network, x: str) -> str:
    """``l2normalize``: each row over its length + 1e-8."""
    length = net.add("Sqrt", [net.reduce("Sum", net.add("Square", [x]), [-1], keep=True)])
    return net.add("RealDiv", [x, net.add("Add", [length, net.floats(_EPSILON)])])


TRAINER = Trainer("FastTD3", _recognise, _rebuild)
