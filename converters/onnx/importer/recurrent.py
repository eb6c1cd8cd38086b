"""LSTM, GRU and RNN layers, run for one step: all that a policy does between two decisions.

Equations and gate orders: onnx/docs/Operators.md (LSTM: i, o, f, c; GRU: z, net, h).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from converters.graph.nn import recurrent as nn
from converters.graph.types import FLOAT32, Dim
from converters.onnx.importer.importer import Importer
from converters.onnx.importer.node import Op, Translate
from signatures.records import dataclass

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


def _weights(op: Op, net: Importer, gates: int, hidden: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The kernels [n, gates·H] and [H, gates·H], and the biases [2·gates·H] of the input and the state."""
    kernel, inner = (net.needed_constant(op.need(i), "the kernel")[0].T for i in (1, 2))
    operand = op.get(3)
    biases = None if operand is None else net.needed_constant(operand, "the bias")[0]
    if {kernel.shape[1], inner.shape[1]} != {gates * hidden} or (
        biases is not None and len(biases) != 2 * gates * hidden
    ):
        raise op.refused("its kernels and biases do not fit together", "the model is damaged")
    return kernel, inner, biases


def _parts(array: np.ndarray, hidden: int) -> list[np.ndarray]:
    """The columns of each gate."""
    return [array[..., i : i + hidden].copy() for i in range(0, array.shape[-1], hidden)]


def _product(op: Op, net: Importer, gates: int, step: _Step) -> tuple[str, str, np.ndarray | None]:
    """The input times its kernel, the state's kernel, and the sum of both biases."""
    kernel, inner, biases = _weights(op, net, gates, step.hidden)
    weights = [net.const(k.copy(), "kernel") for k in (kernel, inner)]
    bias = None if biases is None else biases[: len(biases) // 2] + biases[len(biases) // 2 :]
    return net.add("MatMul", [step.x, weights[0]]), weights[1], bias


def _outputs(net: Importer, step: _Step, states: Sequence[str]) -> list[str | None]:
    """Y and the last states, in the layer's own layout."""
    rows, hidden = step.rows, step.hidden
    sequence: tuple[Dim, ...] = (rows, 1, 1, hidden) if step.batch_first else (1, 1, rows, hidden)
    state: tuple[Dim, ...] = (rows, 1, hidden) if step.batch_first else (1, rows, hidden)
    return [net.reshape(states[0], sequence), *(net.reshape(s, state) for s in states)]


def _lstm(op: Op, net: Importer) -> list[str | None]:
    step = _step(op, net)
    peepholes = op.get(7)
    if peepholes is not None and net.needed_constant(peepholes, "what its gates see of the cell").any():
        raise op.refused("it has peepholes", "no trainer writes such a layer")
    product, inner, bias = _product(op, net, 4, step)
    h, c = _rows_of(op, net, 5, step), _rows_of(op, net, 6, step)
    return _outputs(net, step, nn.lstm(net, product, h, c, inner, bias, "iofg"))


def _gru(op: Op, net: Importer) -> list[str | None]:
    step = _step(op, net)
    size = step.hidden
    kernel, inner, biases = _weights(op, net, 3, size)
    kernels, recurrent = ([net.const(k, "kernel") for k in _parts(w, size)] for w in (kernel, inner))
    h = _rows_of(op, net, 5, step) or _zeros(net, step)
    parts = None if biases is None else _parts(biases, size)
    after = bool(op.integer("linear_before_reset", 0))
    state = nn.gru(net, step.x, h, kernels, recurrent, parts, linear_before_reset=after)
    return _outputs(net, step, [state])


def _rnn(op: Op, net: Importer) -> list[str | None]:
    step = _step(op, net)
    product, inner, bias = _product(op, net, 1, step)
    return _outputs(net, step, [nn.rnn(net, product, _rows_of(op, net, 5, step), inner, bias)])


OPS: Mapping[str, Translate] = {"LSTM": _lstm, "GRU": _gru, "RNN": _rnn}
