"""Activations by the names that PyTorch's classes and the trainers' configurations give them.

Formulas and defaults: torch/nn/modules/activation.py. ``elu`` and ``ELU`` are one. ``lrelu`` and ``crelu`` (CELU) are
rsl_rl's (rsl_rl/utils/utils.py).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from converters.graph.builder import Builder
from converters.graph.nn.activations import (
    celu,
    clip,
    elu,
    gelu,
    hard_sigmoid,
    hard_swish,
    leaky_relu,
    log_sigmoid,
    mish,
    selu,
    swish,
)
from signatures.errors import UsageError

Activation = Callable[[Builder, str], str]
LEAKY_SLOPE = 0.01


def _plain(op: str) -> Activation:
    return lambda b, x: b.add(op, [x])


_KNOWN: dict[str, Activation] = {
    "relu": _plain("Relu"),
    "tanh": _plain("Tanh"),
    "sigmoid": _plain("Sigmoid"),
    "softplus": _plain("Softplus"),
    "softsign": _plain("Softsign"),
    "elu": elu,
    "selu": selu,
    "celu": celu,
    "crelu": celu,
    "gelu": gelu,
    "silu": swish,
    "swish": swish,
    "mish": mish,
    "leakyrelu": partial(leaky_relu, alpha=LEAKY_SLOPE),
    "lrelu": partial(leaky_relu, alpha=LEAKY_SLOPE),
    "relu6": partial(clip, low=0, high=6),
    "hardtanh": partial(clip, low=-1, high=1),
    "hardsigmoid": partial(hard_sigmoid, alpha=1 / 6, beta=0.5),
    "hardswish": hard_swish,
    "logsigmoid": log_sigmoid,
    "identity": lambda b, x: x,
    "none": lambda b, x: x,
}


def named(name: str) -> Activation | None:
    """The activation of a name, however it is written; None where it is not known."""
    return _KNOWN.get(name.lower().replace("_", "").replace("-", ""))


def told(name: str) -> Activation:
    """The one that the user names. Raises UsageError."""
    found = named(name)
    if found is None:
        raise UsageError(
            f"--activation {name}: there is no such activation", fix=f"one of: {', '.join(sorted(_KNOWN))}"
        )
    return found
