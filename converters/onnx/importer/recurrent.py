"""LSTM, GRU and RNN layers, run for one step: all that a policy does between two decisions.

Equations and gate orders: onnx/docs/Operators.md (LSTM: i, o, f, c; GRU: z, net, h).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from converters.graph.types import FLOAT32, Dim
from converters.onnx.importer.importer import Importer
from converters.onnx.importer.node import Op, Translate

_DEFAULTS = {
    "LSTM": ("sigmoid", "tanh", "tanh"),
    "GRU": ("sigmoid", "tanh"),
    "RNN": ("tanh",),
}


@dataclass(frozen=True, slots=True)
class _Step:
    """One step of one layer: its input [B, n], the rows, and how its results are laid out."""

    x: str
    rows: Dim
    hidden: int
    batch_first: bool


def _step(op: Op, net: Importer) -> _Step:
    """Check what the layer is, and take its one input out of the sequence."""
    x = op.need(0)
    shape = net.shape(x)
    batch_first = bool(op.integer("layout", 0))
    if len(shape) != 3:
        raise op.refused(f"its input has {len(shape)} axes instead of three", "the model is damaged")
    time, rows = (shape[1], shape[0]) if batch_first else (shape[0], shape[1])
    if time != 1:
        length = time if isinstance(time, int) else "a number of"
        raise op.refused(
            f"it runs over {length} steps",
            "a policy is exported for one step, its memory fed back by the caller",
            "export it with sequences of length 1 and the memory as input and output",
        )
    direction = op.text("direction", "forward")
    if direction not in ("forward", "reverse") or net.shape(op.need(1))[0] != 1:
        raise op.refused(f"its direction is {direction!r}", "a policy cannot look into the future")
    given = tuple(a.lower() for a in op.attrs.get("activations", _DEFAULTS[op.kind]))
    if given != _DEFAULTS[op.kind] or op.attrs.get("activation_alpha") or op.attrs.get("activation_beta"):
        raise op.refused(f"its activations are {', '.join(given)}", f"only {', '.join(_DEFAULTS[op.kind])} occur")
    if op.number("clip", 0.0) or op.integer("input_forget", 0):
        raise op.refused("it clips its gates or couples them", "no trainer writes such a layer")
    hidden = net.length(op.need(2), -1)
    return _Step(net.reshape(x, (-1, net.length(x, -1))), rows, hidden, batch_first)


def _rows_of(op: Op, net: Importer, position: int, step: _Step) -> str | None:
    """A state [1, B, H] (ML-Agents 0.20 to 0.25 gave [B, 1, H]: right at batch 1 only) as [B, H]."""
    state = op.get(position)
    if state is None:
        return None
    shape = net.shape(state)
    if not step.batch_first and len(shape) == 3 and isinstance(shape[0], str) and shape[1] == 1:
        net.one_row = True
    return net.reshape(state, (step.rows, step.hidden))


def _zeros(net: Importer, step: _Step) -> str:
    return net.add("Fill", [net.vector([step.rows, step.hidden]), net.const(np.zeros((), FLOAT32), "zero")])


def _weights(op: Op, net: Importer, position: int, parts: Sequence[slice] | None = None) -> list[str]:
    """The kernel [1, gates·H, n] at ``position``, turned to [n, gates·H]; cut into ``parts`` of its columns."""
    matrix = net.needed_constant(op.need(position), "the kernel")[0].T
    return [net.const(matrix[:, part].copy(), "kernel") for part in parts or [slice(None)]]


def _product(net: Importer, x: str, kernel: str, bias: str | None) -> str:
    value = net.add("MatMul", [x, kernel])
    return value if bias is None else net.add("BiasAdd", [value, bias])


def _biases(op: Op, net: Importer, gates: int, hidden: int) -> tuple[list[str], list[str]] | None:
    """Per gate the input's and the state's bias, None where the layer has none."""
    operand = op.get(3)
    if operand is None:
        return None
    value = net.needed_constant(operand, "the bias")[0]
    parts = [net.const(value[i * hidden : (i + 1) * hidden].copy(), "bias") for i in range(2 * gates)]
    return parts[:gates], parts[gates:]


def _sum_bias(op: Op, net: Importer, gates: int, hidden: int) -> str | None:
    operand = op.get(3)
    if operand is None:
        return None
    value = net.needed_constant(operand, "the bias")[0]
    return net.const(value[: gates * hidden] + value[gates * hidden :], "bias")


def _outputs(net: Importer, step: _Step, states: Sequence[str]) -> list[str | None]:
    """Y and the last states, in the layer's own layout."""
    rows, hidden = step.rows, step.hidden
    sequence: tuple[Dim, ...] = (rows, 1, 1, hidden) if step.batch_first else (1, 1, rows, hidden)
    state: tuple[Dim, ...] = (rows, 1, hidden) if step.batch_first else (1, rows, hidden)
    return [net.reshape(states[0], sequence), *(net.reshape(s, state) for s in states)]


def _gates(net: Importer, value: str, count: int) -> list[str]:
    split = net.add("Split", [net.ints(1, "axis"), value], num_split=count)
    return [split if i == 0 else f"{split}:{i}" for i in range(count)]


def _lstm(op: Op, net: Importer) -> list[str | None]:
    """The cell: c' = f·c + i·tanh(g), h' = o·tanh(c')."""
    step = _step(op, net)
    peepholes = op.get(7)
    if peepholes is not None and net.needed_constant(peepholes, "what its gates see of the cell").any():
        raise op.refused("it has peepholes", "no trainer writes such a layer")
    (kernel,), (inner,) = _weights(op, net, 1), _weights(op, net, 2)
    total = net.add("MatMul", [step.x, kernel])
    h, c = _rows_of(op, net, 5, step), _rows_of(op, net, 6, step)
    if h is not None:
        total = net.add("Add", [total, net.add("MatMul", [h, inner])])
    bias = _sum_bias(op, net, 4, step.hidden)
    if bias is not None:
        total = net.add("BiasAdd", [total, bias])
    i, o, f, g = _gates(net, total, 4)
    cell = net.add("Mul", [net.add("Sigmoid", [i]), net.add("Tanh", [g])])
    if c is not None:
        cell = net.add("Add", [net.add("Mul", [net.add("Sigmoid", [f]), c]), cell])
    hidden = net.add("Mul", [net.add("Sigmoid", [o]), net.add("Tanh", [cell])])
    return _outputs(net, step, [hidden, cell])


def _gru(op: Op, net: Importer) -> list[str | None]:
    """The state: h' = (1 − z)·tanh(…) + z·h; ``linear_before_reset`` (PyTorch) resets after the product."""
    step = _step(op, net)
    size = step.hidden
    cuts = [slice(i * size, (i + 1) * size) for i in range(3)]
    kernels, inner = _weights(op, net, 1, cuts), _weights(op, net, 2, cuts)
    h = _rows_of(op, net, 5, step) or _zeros(net, step)
    biases = _biases(op, net, 3, size)
    of_x: list[str | None] = [*biases[0]] if biases else [None] * 3
    of_h: list[str | None] = [*biases[1]] if biases else [None] * 3
    inputs = [_product(net, step.x, k, b) for k, b in zip(kernels, of_x, strict=True)]
    z, reset = (
        net.add("Sigmoid", [net.add("Add", [inputs[i], _product(net, h, inner[i], of_h[i])])]) for i in range(2)
    )
    if op.integer("linear_before_reset", 0):
        state = net.add("Mul", [reset, _product(net, h, inner[2], of_h[2])])
    else:
        state = _product(net, net.add("Mul", [reset, h]), inner[2], of_h[2])
    candidate = net.add("Tanh", [net.add("Add", [inputs[2], state])])
    rest = net.add("Mul", [net.add("Sub", [net.number(z, 1), z]), candidate])
    return _outputs(net, step, [net.add("Add", [rest, net.add("Mul", [z, h])])])


def _rnn(op: Op, net: Importer) -> list[str | None]:
    """The state: h' = tanh(x·W + h·R + b)."""
    step = _step(op, net)
    (kernel,), (inner,) = _weights(op, net, 1), _weights(op, net, 2)
    total = net.add("MatMul", [step.x, kernel])
    h = _rows_of(op, net, 5, step)
    if h is not None:
        total = net.add("Add", [total, net.add("MatMul", [h, inner])])
    bias = _sum_bias(op, net, 1, step.hidden)
    if bias is not None:
        total = net.add("BiasAdd", [total, bias])
    return _outputs(net, step, [net.add("Tanh", [total])])


OPS: Mapping[str, Translate] = {"LSTM": _lstm, "GRU": _gru, "RNN": _rnn}
