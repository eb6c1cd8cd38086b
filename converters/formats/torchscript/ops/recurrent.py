"""Recurrent layers of ``torch.nn``, step by step. States are [layers, batch, hidden] (aten/src/ATen/native/RNN.cpp)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.formats.torchscript.machine import Machine
from export_model.converters.formats.torchscript.values import ScriptTensor
from export_model.converters.graph.nn import recurrent as nn
from export_model.signatures.errors import UnsupportedOpError

#: Steps that a history may have: each is written out.
_MAX_STEPS = 128
#: One layer's step: (input [B, n], its states [B, H]) → its states.
_Step = Callable[[Machine, str, Sequence[str], Sequence[np.ndarray]], list[str]]


def _lstm_step(m: Machine, x: str, states: Sequence[str], weights: Sequence[np.ndarray]) -> list[str]:
    kernel, inner, *biases = weights
    m.expect(x, -1, kernel.shape[1])
    product = m.b.add("MatMul", [x, m.b.const(kernel.T, "kernel")])
    bias = biases[0] + biases[1] if biases else None
    made = nn.lstm(
        m.b,
        product,
        h=states[0],
        c=states[1],
        recurrent=m.b.const(inner.T, "recurrent_kernel"),
        bias=bias,
        gates="ifgo",
    )
    return list(made)


def _gru_step(m: Machine, x: str, states: Sequence[str], weights: Sequence[np.ndarray]) -> list[str]:
    m.expect(x, -1, weights[0].shape[1])
    order = (1, 0, 2)  # PyTorch has r, z, n; the layer is given z, r, n
    parts = [m.b.const(np.split(w, 3)[i].T, "kernel") for w in weights[:2] for i in order]
    shifts = [np.split(v, 3)[i] for v in weights[2:] for i in order] or None
    return [nn.gru(m.b, x, states[0], parts[:3], parts[3:], shifts, linear_before_reset=True)]


def _rnn_step(op: str) -> _Step:
    def step(m: Machine, x: str, states: Sequence[str], weights: Sequence[np.ndarray]) -> list[str]:
        kernel, inner, *biases = weights
        m.expect(x, -1, kernel.shape[1])
        total = m.b.add("MatMul", [x, m.b.const(kernel.T, "kernel")])
        total = m.b.add("Add", [total, m.b.add("MatMul", [states[0], m.b.const(inner.T, "recurrent_kernel")])])
        if biases:
            total = m.b.add("BiasAdd", [total, m.b.const(biases[0] + biases[1], "bias")])
        return [m.b.add(op, [total])]

    return step


def _layers(step: _Step, states: int) -> Callable[..., Any]:
    """``lstm(input, hx, params, has_biases, num_layers, dropout, train, bidirectional, batch_first)`` and its kin."""

    def translate(
        m: Machine,
        x: Any,
        hx: Any,
        params: Any,
        has_biases: Any,
        layers: Any,
        dropout: Any,
        train: Any,
        bidirectional: Any,
        batch_first: Any,
    ) -> tuple[ScriptTensor, ...]:
        if bidirectional:
            raise UnsupportedOpError("it reads its history backwards, too", why="an agent has none of what comes")
        if dropout and train:
            raise UnsupportedOpError("dropout of a module that is in training", why="call eval() before it is saved")
        each = 4 if has_biases else 2
        if not isinstance(params, list) or len(params) != each * layers:
            raise UnsupportedOpError(f"{layers} layers have {len(params)} weights", why="projections are not known")
        weights = [m.constant_numbers(p, "a weight of a recurrent layer") for p in params]
        held = [m.ref(h) for h in (hx if isinstance(hx, list | tuple) else [hx])]
        if len(held) != states or any(m.b.rank(h) != 3 or m.b.length(h, 0) != layers for h in held):
            raise UnsupportedOpError("its states are not [layers, batch, hidden]", why="the layers need one each")
        inputs = _steps(m, m.ref(x), 1 if batch_first else 0)
        after: list[list[str]] = [[] for _ in range(states)]
        for layer in range(layers):
            now = [m.b.squeeze(m.b.slice(h, 0, layer, layer + 1), [0]) for h in held]
            outputs = []
            for one in inputs:
                now = step(m, one, now, weights[each * layer : each * (layer + 1)])
                outputs.append(now[0])
            inputs = outputs
            for kept, state in zip(after, now, strict=True):
                kept.append(m.b.expand_dims(state, 0))
        output = m.b.concat([m.b.expand_dims(o, 1 if batch_first else 0) for o in inputs], 1 if batch_first else 0)
        return (ScriptTensor(output), *(ScriptTensor(m.b.concat(kept, 0)) for kept in after))

    return translate


def _steps(m: Machine, x: str, axis: int) -> list[str]:
    """The steps of a history [T, B, n], each [B, n]."""
    if m.b.rank(x) != 3:
        raise UnsupportedOpError(f"its input has {m.b.rank(x)} axes", why="steps, batch and numbers are expected")
    count = m.b.length(x, axis)
    if count > _MAX_STEPS:
        raise UnsupportedOpError(f"a history of {count} steps", why=f"up to {_MAX_STEPS} are written out")
    if count == 1:
        return [m.b.squeeze(x, [axis])]
    return [m.b.squeeze(m.b.slice(x, axis, i, i + 1), [axis]) for i in range(count)]


def _cell(step: _Step) -> Callable[..., Any]:
    """``lstm_cell(input, hx, w_ih, w_hh, b_ih, b_hh)`` and its kin."""

    def translate(m: Machine, x: Any, hx: Any, *params: Any) -> Any:
        weights = [m.constant_numbers(p, "a weight of a recurrent cell") for p in params if p is not None]
        held = [m.ref(h) for h in (hx if isinstance(hx, list | tuple) else [hx])]
        for state in held:
            m.expect(state, -1, weights[1].shape[1])
        made = [ScriptTensor(r) for r in step(m, m.ref(x), held, weights)]
        return tuple(made) if len(made) > 1 else made[0]

    return translate


OPS: Mapping[str, Callable[..., Any]] = {
    "lstm": _layers(_lstm_step, 2),
    "gru": _layers(_gru_step, 1),
    "rnn_tanh": _layers(_rnn_step("Tanh"), 1),
    "rnn_relu": _layers(_rnn_step("Relu"), 1),
    "lstm_cell": _cell(_lstm_step),
    "gru_cell": _cell(_gru_step),
    "rnn_tanh_cell": _cell(_rnn_step("Tanh")),
    "rnn_relu_cell": _cell(_rnn_step("Relu")),
}
