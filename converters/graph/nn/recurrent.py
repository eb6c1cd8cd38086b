"""Recurrent layers, run for one step: all that a policy does between two decisions.

Equations: onnx/docs/Operators.md (LSTM, GRU, RNN), which are torch.nn's. States are [B, H], None where they are zeros.
LSTM and RNN take the input's product with its kernel, ``product`` [B, gates·H]; ``recurrent`` [H, gates·H] is the
state's kernel, ``bias`` [gates·H] the sum of the input's and the state's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.activations import Activation

Array = np.ndarray


def tanh(b: Builder, x: str) -> str:
    """What a candidate and an output go through, if nothing else is said."""
    return b.add("Tanh", [x])


def sigmoid(b: Builder, x: str) -> str:
    """What a gate goes through, if nothing else is said."""
    return b.add("Sigmoid", [x])


def lstm(
    b: Builder,
    product: str,
    h: str | None,
    c: str | None,
    recurrent: str,
    bias: Array | None,
    gates: str,
    *,
    activation: Activation = tanh,
    gate: Activation = sigmoid,
) -> tuple[str, str]:
    """The new h and c, each [B, H]: c' = f·c + i·tanh(g), h' = o·tanh(c').

    ``gates`` is the order of i, f, g and o along the kernels' columns.
    """
    parts = dict(zip(gates, b.split(_total(b, product, h, recurrent, bias), 4), strict=True))
    cell = b.add("Mul", [gate(b, parts["i"]), activation(b, parts["g"])])
    if c is not None:
        cell = b.add("Add", [b.add("Mul", [gate(b, parts["f"]), c]), cell])
    return b.add("Mul", [gate(b, parts["o"]), activation(b, cell)]), cell


def rnn(
    b: Builder, product: str, h: str | None, recurrent: str, bias: Array | None, *, activation: Activation = tanh
) -> str:
    """The new h [B, H]: tanh(product + h·R + bias)."""
    return activation(b, _total(b, product, h, recurrent, bias))


def _total(b: Builder, total: str, h: str | None, recurrent: str, bias: Array | None) -> str:
    if h is not None:
        total = b.add("Add", [total, b.add("MatMul", [h, recurrent])])
    return total if bias is None else b.add("BiasAdd", [total, b.const(bias, "bias")])


def gru(
    b: Builder,
    x: str,
    h: str,
    kernels: Sequence[str],
    recurrent: Sequence[str],
    biases: Sequence[Array] | None,
    *,
    linear_before_reset: bool,
    activation: Activation = tanh,
    gate: Activation = sigmoid,
) -> str:
    """The new h [B, H]: (1 − z)·tanh(…) + z·h, with the gates z, r and the candidate, each with constants of its own.

    x is [B, n], a kernel [n, H], a recurrent one [H, H], ``biases`` three of the input and three of the state, each
    [H]. ``linear_before_reset`` (PyTorch) resets after the product with the state's kernel.
    """
    of_x, of_h = ([b.const(v, "bias") for v in biases[i : i + 3]] if biases else [None] * 3 for i in (0, 3))
    inputs = [_affine(b, x, k, v) for k, v in zip(kernels, of_x, strict=True)]
    z, reset = (gate(b, b.add("Add", [inputs[i], _affine(b, h, recurrent[i], of_h[i])])) for i in range(2))
    if linear_before_reset:
        state = b.add("Mul", [reset, _affine(b, h, recurrent[2], of_h[2])])
    else:
        state = _affine(b, b.add("Mul", [reset, h]), recurrent[2], of_h[2])
    candidate = activation(b, b.add("Add", [inputs[2], state]))
    rest = b.add("Mul", [b.add("Sub", [b.number(z, 1), z]), candidate])
    return b.add("Add", [rest, b.add("Mul", [z, h])])


def _affine(b: Builder, x: str, kernel: str, bias: str | None) -> str:
    value = b.add("MatMul", [x, kernel])
    return value if bias is None else b.add("BiasAdd", [value, bias])
