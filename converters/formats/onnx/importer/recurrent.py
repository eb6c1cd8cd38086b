"""LSTM, GRU and RNN layers: one step, or a history of a fixed length, which is written out step by step.

Equations and gate orders: onnx/docs/Operators.md (LSTM: i, o, f, c; GRU: z, net, h).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from msgspec import Struct

from export_model.converters.formats.onnx.importer.importer import Importer
from export_model.converters.formats.onnx.importer.node import Op, Translate
from export_model.converters.graph.nn import recurrent as nn
from export_model.converters.graph.types import FLOAT32, Dim

_DEFAULTS = {
    "LSTM": ("sigmoid", "tanh", "tanh"),
    "GRU": ("sigmoid", "tanh"),
    "RNN": ("tanh",),
}


#: What the layer gives at each step, in the order of time; the states after the last.
_Run = tuple[Sequence[str], Sequence[str]]


class _Steps(Struct, frozen=True):
    """One layer: its inputs [B, n] in the order of time, the rows, and how its results are laid out."""

    inputs: Sequence[str]
    rows: Dim
    hidden: int
    batch_first: bool
    reverse: bool

    def over(
        self,
        inputs: Sequence[str],
        turn: Callable[[str, Sequence[str | None]], Sequence[str]],
        states: Sequence[str | None],
    ) -> _Run:
        """Every step after the other; ``turn`` gives the new states, of an input's or what was made of it."""
        given: list[str] = []
        for x in reversed(inputs) if self.reverse else inputs:
            states = turn(x, states)
            given.append(str(states[0]))
        return (given[::-1] if self.reverse else given), [str(s) for s in states]


def _steps(op: Op, net: Importer) -> _Steps:
    """Check what the layer is, and take its inputs out of the sequence."""
    x = op.need(0)
    shape = net.shape(x)
    batch_first = bool(op.integer("layout", 0))
    if len(shape) != 3:
        raise op.op_error(f"its input has {len(shape)} axes instead of three", "the model is damaged")
    time, rows = (shape[1], shape[0]) if batch_first else (shape[0], shape[1])
    if not isinstance(time, int):
        raise op.op_error(
            "it runs over any number of steps",
            "a policy is exported for one step, its memory fed back by the caller, or for a history of a fixed length",
            "export it with sequences of length 1 and the memory as input and output",
        )
    lengths = op.get(4)
    if time > 1 and lengths is not None and (net.needed_constant(lengths, "the length of each row") != time).any():
        raise op.op_error("its rows are of other lengths than its input")
    direction = op.text("direction", "forward")
    if direction not in ("forward", "reverse") or net.shape(op.need(1))[0] != 1:
        raise op.op_error(
            f"its direction is {direction!r}", "layers that run one way are read: forward, or reverse over a history"
        )
    given = tuple(a.lower() for a in op.attrs.get("activations", _DEFAULTS[op.kind]))
    if given != _DEFAULTS[op.kind] or op.attrs.get("activation_alpha") or op.attrs.get("activation_beta"):
        raise op.op_error(f"its activations are {', '.join(given)}", f"only {', '.join(_DEFAULTS[op.kind])} occur")
    if op.number("clip", 0.0) or op.integer("input_forget", 0):
        raise op.op_error("it clips its gates or couples them", "no trainer writes such a layer")
    hidden, axis = net.length(op.need(2), -1), 1 if batch_first else 0
    turns = [x] if time == 1 else [net.slice(x, axis, i, i + 1) for i in range(time)]
    inputs = [net.reshape(turn, (-1, net.length(x, -1))) for turn in turns]
    return _Steps(inputs, rows, hidden, batch_first, direction == "reverse")


def _rows_of(op: Op, net: Importer, position: int, steps: _Steps) -> str | None:
    """A state [1, B, H] (ML-Agents 0.20 to 0.25 gave [B, 1, H]: right at batch 1 only) as [B, H]."""
    state = op.get(position)
    if state is None:
        return None
    shape = net.shape(state)
    if not steps.batch_first and len(shape) == 3 and isinstance(shape[0], str) and shape[1] == 1:
        net.one_row = True
    return net.reshape(state, (steps.rows, steps.hidden))


def _zeros(net: Importer, steps: _Steps) -> str:
    return net.add("Fill", [net.vector([steps.rows, steps.hidden]), net.const(np.zeros((), FLOAT32), "zero")])


def _weights(op: Op, net: Importer, gates: int, hidden: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The kernels [n, gates·H] and [H, gates·H], and the biases [2·gates·H] of the input and the state."""
    kernel, inner = (net.needed_constant(op.need(i), "the kernel")[0].T for i in (1, 2))
    operand = op.get(3)
    biases = None if operand is None else net.needed_constant(operand, "the bias")[0]
    if {kernel.shape[1], inner.shape[1]} != {gates * hidden} or (
        biases is not None and len(biases) != 2 * gates * hidden
    ):
        raise op.op_error("its kernels and biases do not fit together", "the model is damaged")
    return kernel, inner, biases


def _parts(array: np.ndarray, hidden: int) -> list[np.ndarray]:
    """The columns of each gate."""
    return [array[..., i : i + hidden].copy() for i in range(0, array.shape[-1], hidden)]


def _kernels(op: Op, net: Importer, gates: int, steps: _Steps) -> tuple[str, str, np.ndarray | None]:
    """The input's kernel, the state's, and the sum of both biases."""
    kernel, inner, biases = _weights(op, net, gates, steps.hidden)
    weights = [net.const(k.copy(), "kernel") for k in (kernel, inner)]
    bias = None if biases is None else biases[: len(biases) // 2] + biases[len(biases) // 2 :]
    return weights[0], weights[1], bias


def _outputs(net: Importer, steps: _Steps, run: _Run) -> list[str | None]:
    """Y and the last states, in the layer's own layout."""
    given, states = run
    rows, hidden = steps.rows, steps.hidden
    sequence: tuple[Dim, ...] = (rows, 1, 1, hidden) if steps.batch_first else (1, 1, rows, hidden)
    state: tuple[Dim, ...] = (rows, 1, hidden) if steps.batch_first else (1, rows, hidden)
    each = [net.reshape(y, sequence) for y in given]
    whole = each[0] if len(each) == 1 else net.concat(each, 1 if steps.batch_first else 0)
    return [whole, *(net.reshape(s, state) for s in states)]


def _lstm(op: Op, net: Importer) -> list[str | None]:
    steps = _steps(op, net)
    peepholes = op.get(7)
    if peepholes is not None and net.needed_constant(peepholes, "what its gates see of the cell").any():
        raise op.op_error("it has peepholes", "no trainer writes such a layer")
    kernel, inner, bias = _kernels(op, net, 4, steps)
    products = [net.add("MatMul", [x, kernel]) for x in steps.inputs]

    def turn(product: str, states: Sequence[str | None]) -> Sequence[str]:
        h, c = states
        return nn.lstm(net, product, h=h, c=c, recurrent=inner, bias=bias, gates="iofg")

    return _outputs(net, steps, steps.over(products, turn, [_rows_of(op, net, 5, steps), _rows_of(op, net, 6, steps)]))


def _gru(op: Op, net: Importer) -> list[str | None]:
    steps = _steps(op, net)
    size = steps.hidden
    kernel, inner, biases = _weights(op, net, 3, size)
    kernels, recurrent = ([net.const(k, "kernel") for k in _parts(w, size)] for w in (kernel, inner))
    h = _rows_of(op, net, 5, steps) or _zeros(net, steps)
    parts = None if biases is None else _parts(biases, size)
    after = bool(op.integer("linear_before_reset", 0))

    def turn(x: str, states: Sequence[str | None]) -> Sequence[str]:
        return [nn.gru(net, x, str(states[0]), kernels, recurrent, parts, linear_before_reset=after)]

    return _outputs(net, steps, steps.over(steps.inputs, turn, [h]))


def _rnn(op: Op, net: Importer) -> list[str | None]:
    steps = _steps(op, net)
    kernel, inner, bias = _kernels(op, net, 1, steps)
    products = [net.add("MatMul", [x, kernel]) for x in steps.inputs]

    def turn(product: str, states: Sequence[str | None]) -> Sequence[str]:
        return [nn.rnn(net, product, states[0], inner, bias)]

    return _outputs(net, steps, steps.over(products, turn, [_rows_of(op, net, 5, steps)]))


OPS: Mapping[str, Translate] = {"LSTM": _lstm, "GRU": _gru, "RNN": _rnn}
