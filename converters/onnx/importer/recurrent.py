"""LSTM, GRU and RNN layers, run for one step: all that a policy does between two decisions.

Equations and gate orders: onnx/docs/Operators.md (LSTM: i, o, f, c; GRU: z, r, h).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from converters.graph.types import FLOAT32, Dim
from converters.onnx.importer.importer import Raiser
from converters.onnx.importer.node import Op, Raise

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


def _step(op: Op, r: Raiser) -> _Step:
    """Check what the layer is, and take its one input out of the sequence."""
    x = op.need(0)
    shape = r.shape(op, x)
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
    if direction not in ("forward", "reverse") or r.shape(op, op.need(1))[0] != 1:
        raise op.refused(f"its direction is {direction!r}", "a policy cannot look into the future")
    given = tuple(a.lower() for a in op.attrs.get("activations", _DEFAULTS[op.kind]))
    if given != _DEFAULTS[op.kind] or op.attrs.get("activation_alpha") or op.attrs.get("activation_beta"):
        raise op.refused(f"its activations are {', '.join(given)}", f"only {', '.join(_DEFAULTS[op.kind])} occur")
    if op.number("clip", 0.0) or op.integer("input_forget", 0):
        raise op.refused("it clips its gates or couples them", "no trainer writes such a layer")
    hidden = r.length(op, op.need(2), -1)
    return _Step(r.reshape(x, (-1, r.length(op, x, -1))), rows, hidden, batch_first)


def _rows_of(op: Op, r: Raiser, position: int, step: _Step) -> str | None:
    """A state [1, B, H] (ML-Agents 0.20 to 0.25 gave [B, 1, H]: right at batch 1 only) as [B, H]."""
    state = op.get(position)
    if state is None:
        return None
    shape = r.shape(op, state)
    if not step.batch_first and len(shape) == 3 and isinstance(shape[0], str) and shape[1] == 1:
        r.one_row = True
    return r.reshape(state, (step.rows, step.hidden))


def _zeros(r: Raiser, step: _Step) -> str:
    return r.add("Fill", [r.vector([step.rows, step.hidden]), r.const(np.zeros((), FLOAT32), "zero")])


def _weights(op: Op, r: Raiser, position: int, parts: Sequence[slice] | None = None) -> list[str]:
    """The kernel [1, gates·H, n] at ``position``, turned to [n, gates·H]; cut into ``parts`` of its columns."""
    matrix = r.needed_constant(op, op.need(position), "the kernel")[0].T
    return [r.const(matrix[:, part].copy(), "kernel") for part in parts or [slice(None)]]


def _product(r: Raiser, x: str, kernel: str, bias: str | None) -> str:
    value = r.add("MatMul", [x, kernel])
    return value if bias is None else r.add("BiasAdd", [value, bias])


def _biases(op: Op, r: Raiser, gates: int, hidden: int) -> tuple[list[str], list[str]] | None:
    """Per gate the input's and the state's bias, None where the layer has none."""
    operand = op.get(3)
    if operand is None:
        return None
    value = r.needed_constant(op, operand, "the bias")[0]
    parts = [r.const(value[i * hidden : (i + 1) * hidden].copy(), "bias") for i in range(2 * gates)]
    return parts[:gates], parts[gates:]


def _sum_bias(op: Op, r: Raiser, gates: int, hidden: int) -> str | None:
    operand = op.get(3)
    if operand is None:
        return None
    value = r.needed_constant(op, operand, "the bias")[0]
    return r.const(value[: gates * hidden] + value[gates * hidden :], "bias")


def _outputs(r: Raiser, step: _Step, states: Sequence[str]) -> list[str | None]:
    """Y and the last states, in the layer's own layout."""
    rows, hidden = step.rows, step.hidden
    sequence: tuple[Dim, ...] = (rows, 1, 1, hidden) if step.batch_first else (1, 1, rows, hidden)
    state: tuple[Dim, ...] = (rows, 1, hidden) if step.batch_first else (1, rows, hidden)
    return [r.reshape(states[0], sequence), *(r.reshape(s, state) for s in states)]


def _gates(r: Raiser, value: str, count: int) -> list[str]:
    split = r.add("Split", [r.ints(1, "axis"), value], num_split=count)
    return [split if i == 0 else f"{split}:{i}" for i in range(count)]


def _lstm(op: Op, r: Raiser) -> list[str | None]:
    """The cell: c' = f·c + i·tanh(g), h' = o·tanh(c')."""
    step = _step(op, r)
    peepholes = op.get(7)
    if peepholes is not None and r.needed_constant(op, peepholes, "what its gates see of the cell").any():
        raise op.refused("it has peepholes", "no trainer writes such a layer")
    (kernel,), (inner,) = _weights(op, r, 1), _weights(op, r, 2)
    total = r.add("MatMul", [step.x, kernel])
    h, c = _rows_of(op, r, 5, step), _rows_of(op, r, 6, step)
    if h is not None:
        total = r.add("Add", [total, r.add("MatMul", [h, inner])])
    bias = _sum_bias(op, r, 4, step.hidden)
    if bias is not None:
        total = r.add("BiasAdd", [total, bias])
    i, o, f, g = _gates(r, total, 4)
    cell = r.add("Mul", [r.add("Sigmoid", [i]), r.add("Tanh", [g])])
    if c is not None:
        cell = r.add("Add", [r.add("Mul", [r.add("Sigmoid", [f]), c]), cell])
    hidden = r.add("Mul", [r.add("Sigmoid", [o]), r.add("Tanh", [cell])])
    return _outputs(r, step, [hidden, cell])


def _gru(op: Op, r: Raiser) -> list[str | None]:
    """The state: h' = (1 − z)·tanh(…) + z·h; ``linear_before_reset`` (PyTorch) resets after the product."""
    step = _step(op, r)
    size = step.hidden
    cuts = [slice(i * size, (i + 1) * size) for i in range(3)]
    kernels, inner = _weights(op, r, 1, cuts), _weights(op, r, 2, cuts)
    h = _rows_of(op, r, 5, step) or _zeros(r, step)
    biases = _biases(op, r, 3, size)
    of_x: list[str | None] = [*biases[0]] if biases else [None] * 3
    of_h: list[str | None] = [*biases[1]] if biases else [None] * 3
    inputs = [_product(r, step.x, k, b) for k, b in zip(kernels, of_x, strict=True)]
    z, reset = (r.add("Sigmoid", [r.add("Add", [inputs[i], _product(r, h, inner[i], of_h[i])])]) for i in range(2))
    if op.integer("linear_before_reset", 0):
        state = r.add("Mul", [reset, _product(r, h, inner[2], of_h[2])])
    else:
        state = _product(r, r.add("Mul", [reset, h]), inner[2], of_h[2])
    candidate = r.add("Tanh", [r.add("Add", [inputs[2], state])])
    rest = r.add("Mul", [r.add("Sub", [r.number(z, 1), z]), candidate])
    return _outputs(r, step, [r.add("Add", [rest, r.add("Mul", [z, h])])])


def _rnn(op: Op, r: Raiser) -> list[str | None]:
    """The state: h' = tanh(x·W + h·R + b)."""
    step = _step(op, r)
    (kernel,), (inner,) = _weights(op, r, 1), _weights(op, r, 2)
    total = r.add("MatMul", [step.x, kernel])
    h = _rows_of(op, r, 5, step)
    if h is not None:
        total = r.add("Add", [total, r.add("MatMul", [h, inner])])
    bias = _sum_bias(op, r, 1, step.hidden)
    if bias is not None:
        total = r.add("BiasAdd", [total, bias])
    return _outputs(r, step, [r.add("Tanh", [total])])


OPS: Mapping[str, Raise] = {"LSTM": _lstm, "GRU": _gru, "RNN": _rnn}
