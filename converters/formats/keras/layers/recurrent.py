"""LSTM, GRU and SimpleRNN over a history [B, T, n], written out step by step; their cells, stacked or alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.converters.formats.keras.layers.activations import activation_of
from export_model.converters.formats.keras.layers.step import Step, Translate
from export_model.converters.formats.keras.model import KerasLayer, cells_of, layer_of
from export_model.converters.graph.nn import recurrent as nn
from export_model.converters.graph.nn.activations import Activation
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import DamagedFileError, UnsupportedOpError

#: (x [B, n], states) → the new states; the first is what the cell gives.
Turn = Callable[[str, Sequence[str]], list[str]]


class _Cell(Struct, frozen=True):
    """What one step computes, and the width of each state."""

    turn: Turn
    widths: tuple[int, ...]


def _cell(step: Step, kind: str, width: int) -> _Cell:
    """A cell that reads ``width`` numbers, with the next weights."""
    b = step.net
    if kind not in _CELLS:
        raise UnsupportedOpError(f"it runs a {kind}")
    units = int(step.get("units"))
    gates = _CELLS[kind]
    kernel, inner = step.take(width, gates * units), step.take(units, gates * units)
    bias = step.take() if step.get("use_bias", True) else None
    if bias is not None and bias.shape[-1:] != (gates * units,):
        raise DamagedFileError(f"the bias of the layer {step.path!r} has the shape {list(bias.shape)}", fix=_SAVE_AGAIN)
    activation = activation_of(step, step.get("activation", "tanh"))
    older = "hard_sigmoid" if step.is_tfjs else "sigmoid"
    gate = activation_of(step, step.get("recurrent_activation", older))
    if kind.startswith("GRU"):
        return _Cell(_gru(step, kernel, inner, bias, activation, gate), (units,))
    kernels = b.const(kernel, "kernel"), b.const(inner, "recurrent_kernel")
    if kind.startswith("LSTM"):

        def lstm(x: str, states: Sequence[str]) -> list[str]:
            product = b.add("MatMul", [x, kernels[0]])
            h, c = states
            return [
                *nn.lstm(
                    b,
                    product,
                    h=h,
                    c=c,
                    recurrent=kernels[1],
                    bias=bias,
                    gates="ifgo",
                    activation=activation,
                    gate=gate,
                )
            ]

        return _Cell(lstm, (units, units))

    def simple(x: str, states: Sequence[str]) -> list[str]:
        product = b.add("MatMul", [x, kernels[0]])
        return [nn.rnn(b, product, states[0], kernels[1], bias, activation=activation)]

    return _Cell(simple, (units,))


def _gru(
    step: Step,
    kernel: np.ndarray,
    inner: np.ndarray,
    bias: np.ndarray | None,
    activation: Activation,
    gate: Activation,
) -> Turn:
    b = step.net
    kernels, recurrent = ([b.const(p.copy(), "kernel") for p in np.split(a, 3, axis=1)] for a in (kernel, inner))
    after = bool(step.get("reset_after", not step.is_tfjs)) if bias is None else bias.ndim == 2
    biases = None
    if bias is not None:
        both = bias if after else np.stack([bias, np.zeros_like(bias)])
        biases = [p.copy() for row in both for p in np.split(row, 3)]

    def turn(x: str, states: Sequence[str]) -> list[str]:
        made = nn.gru(
            b, x, states[0], kernels, recurrent, biases, linear_before_reset=after, activation=activation, gate=gate
        )
        return [made]

    return turn


#: Gates of each cell.
_SAVE_AGAIN = "save the model again"
_CELLS = {"LSTM": 4, "LSTMCell": 4, "GRU": 3, "GRUCell": 3, "SimpleRNN": 1, "SimpleRNNCell": 1}


def _cells(step: Step, width: int) -> list[_Cell]:
    """The cells that run one after the other at each step."""
    if step.layer.kind != "RNN":
        return [_cell(step, step.layer.kind, width)]
    found = []
    for inner in cells_of(step.layer):
        inside = step.inner(inner, (), step.left)
        found.append(_cell(inside, inner.kind, width))
        step.left = inside.left
        width = found[-1].widths[0]
    return found


def _recurrent(step: Step) -> list[str]:
    b, x = step.net, step.x
    if step.rank != 3:
        raise step.damaged_error(f"is given {step.rank} axes, not [B, T, n]")
    if step.kwargs.get("mask") is not None:
        raise UnsupportedOpError("it is given a mask")
    step.refuse_unless("time_major", False, None)
    rows, steps = b.shape(x)[0], b.length(x, 1)
    cells = _cells(step, b.length(x, 2))
    widths = [w for cell in cells for w in cell.widths]
    given = step.kwargs.get("initial_state") or step.tensors[1:]
    given = [given] if isinstance(given, str) else [*given]
    states, held = [*given], [*given]
    if step.get("stateful") and not given:
        held = [b.state(width) for width in widths]
        states = [*held]
    elif not given:
        states = [b.add("Fill", [b.vector([rows, w]), b.const(np.zeros((), FLOAT32), "zero")]) for w in widths]
    if [b.length(s, -1) for s in states] != widths:
        raise step.damaged_error(f"has states of {widths} numbers, and is given others")
    turns = range(steps - 1, -1, -1) if step.get("go_backwards") else range(steps)
    outputs = []
    for turn in turns:
        value = b.squeeze(x if steps == 1 else b.slice(x, 1, turn, turn + 1), [1])
        at = 0
        for cell in cells:
            count = len(cell.widths)
            states[at : at + count] = cell.turn(value, states[at : at + count])
            value, at = states[at], at + count
        outputs.append(value)
    _keep(step, held, states)
    result = outputs[-1]
    if step.get("return_sequences"):
        result = b.add("Pack", outputs, axis=1) if steps > 1 else b.expand_dims(result, 1)
    return [result, *(states if step.get("return_state") else ())]


def _one_step(step: Step) -> list[str]:
    """A cell that is called by itself: what it gives, then its new states."""
    b = step.net
    given = [*step.tensors[1:], *(step.kwargs.get("states") or ())]
    cell = _cell(step, step.layer.kind, b.length(step.x, step.rank - 1))
    if step.rank != 2 or tuple(b.length(s, -1) for s in given) != cell.widths:
        raise DamagedFileError(f"the cell {step.path!r} is given other tensors than its own", fix=_SAVE_AGAIN)
    states = cell.turn(step.x, given)
    _keep(step, given, states)
    return [states[0], *states]


def _keep(step: Step, held: Sequence[str], states: Sequence[str]) -> None:
    """Note what becomes of the states that are inputs of the model; there are none in ``held`` where zeros begin."""
    b = step.net
    for taken_in, given_out in zip(held, states, strict=False):
        if b.nodes[b.position[taken_in]].op == "Placeholder":
            b.states[taken_in] = given_out


def _bidirectional(step: Step) -> list[str]:
    """The layer forwards, and one like it backwards, its sequence turned round; joined as ``merge_mode`` says."""
    b = step.net
    forward = layer_of(step.get("layer"))
    backward = layer_of(step.get("backward_layer") or step.get("layer"))
    if forward.kind not in LAYERS or forward.config.get("return_state") or len(step.tensors) > 1:
        raise UnsupportedOpError(f"it wraps a {forward.kind} with its own states")
    turned: dict[str, Any] = {**backward.config}
    if not step.get("backward_layer"):
        turned["go_backwards"] = not forward.config.get("go_backwards")
    results = []
    for layer in (forward, KerasLayer(backward.kind, backward.name, turned)):
        inside = step.inner(layer, [step.x], step.left)
        (value,) = LAYERS[layer.kind](inside)
        step.left = inside.left
        results.append(value)
    ahead, behind = results
    if forward.config.get("return_sequences"):
        steps = b.length(behind, 1)
        behind = behind if steps == 1 else b.take(behind, range(steps - 1, -1, -1), 1)
    mode = step.get("merge_mode", "concat")
    if mode == "concat":
        return [b.concat([ahead, behind], b.rank(ahead) - 1)]
    if mode is None:
        return [ahead, behind]
    if mode not in ("sum", "ave", "mul"):
        raise UnsupportedOpError(f"its merge_mode is {mode!r}")
    value = b.add("Mul" if mode == "mul" else "Add", [ahead, behind])
    return [b.add("Mul", [value, b.number(value, 0.5)]) if mode == "ave" else value]


LAYERS: Mapping[str, Translate] = {
    **dict.fromkeys(("LSTM", "GRU", "SimpleRNN", "RNN"), _recurrent),
    **dict.fromkeys(("LSTMCell", "GRUCell", "SimpleRNNCell"), _one_step),
    "Bidirectional": _bidirectional,
}
