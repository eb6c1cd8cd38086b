"""Normalisations, recurrent layers, bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.onnx_reader.models import OPSETS, Case, constant, declared, floats, helper, node

B, N, H = 3, 5, 4
X = floats(3, 5)
IMAGE = floats(2, 4, 6, 5)
SEQUENCE = floats(1, B, N)
STATES = {"h": floats(1, B, H, seed=1), "c": floats(1, B, H, seed=2)}
SHAPES = {"x": [1, "batch", N], "h": [1, "batch", H], "c": [1, "batch", H]}
STATISTICS = {
    "scale": floats(4, seed=1), "bias": floats(4, seed=2), "mean": floats(4, seed=3), "var": np.abs(floats(4, seed=4))
}  # fmt: skip


def recurrent(
    op: str, gates: int, title: str, *, bias: bool = True, states: Sequence[str] = (), steps: int = 1, **more: Any
) -> Case:
    """A layer of ``steps`` steps; all of its outputs are asked for."""
    constants = {"w": floats(1, gates * H, N, seed=5), "r": floats(1, gates * H, H, seed=6)}
    inputs = ["x", "w", "r", "b" if bias else "", "", *states]
    if bias:
        constants["b"] = floats(1, 2 * gates * H, seed=7)
    outputs = ["y", "yh", "yc"][: 3 if op == "LSTM" else 2]
    feeds = {"x": floats(steps, B, N), **{s: STATES[s] for s in states}}
    return Case(
        op, title, lambda _: [node(op, inputs, outputs, hidden_size=H, **more)], feeds, constants, tuple(outputs),
        shapes=SHAPES | {"x": [steps, "batch", N]},
    )  # fmt: skip


def batch_first(op: str, gates: int) -> Case:
    constants = {"w": floats(1, gates * H, N, seed=5), "r": floats(1, gates * H, H, seed=6)}
    return Case(
        op, "rows first", lambda _: [node(op, ["x", "w", "r"], ["y", "yh"], hidden_size=H, layout=1)],
        {"x": floats(B, 1, N)}, constants, ("y", "yh"), opsets=(15, 18), oracle="onnx",
    )  # fmt: skip


def batch_norm(opset: int) -> Sequence[Any]:
    return [node("BatchNormalization", ["x", "scale", "bias", "mean", "var"], epsilon=1e-3)]


def branch(name: str, kind: str) -> Any:
    """A body that reads a value from outside."""
    out = f"{name}_out"
    return helper.make_graph([node(kind, ["x"], out)], name, [], [declared(out, np.float32, ["batch", 5])])


def conditional(value: bool) -> Any:
    def build(_: int) -> Sequence[Any]:
        branches = {"then_branch": branch("then", "Relu"), "else_branch": branch("else", "Neg")}
        return [constant("c", value, np.bool_), node("If", ["c"], "y", **branches)]

    return build


def scan(_: int) -> Sequence[Any]:
    """tf2onnx's loop over time with one state; the body reads the weights from outside."""
    body = helper.make_graph(
        [
            node("MatMul", ["step", "w"], "m"),
            node("Add", ["state", "m"], "next"),
            node("Tanh", ["next"], "shown"),
            node("Identity", ["next"], "end"),
        ],
        "body",
        [declared("state", np.float32, ["batch", H]), declared("step", np.float32, ["batch", N])],
        [declared("end", np.float32, ["batch", H]), declared("shown", np.float32, ["batch", H])],
    )
    return [node("Scan", ["s", "x"], ["y", "all"], body=body, num_scan_inputs=1)]


CASES = [
    Case("BatchNormalization", "an image", batch_norm, {"x": IMAGE}, STATISTICS),
    Case("BatchNormalization", "a vector", batch_norm, {"x": floats(3, 4)}, STATISTICS),
    Case("InstanceNormalization", "an image",
         lambda _: [node("InstanceNormalization", ["x", "scale", "bias"], epsilon=1e-3)], {"x": IMAGE},
         {k: STATISTICS[k] for k in ("scale", "bias")}),
    Case("LayerNormalization", "last axis",
         lambda _: [node("LayerNormalization", ["x", "s", "b"])], {"x": X},
         {"s": floats(5, seed=1), "b": floats(5, seed=2)}, opsets=(17, 18)),
    Case("LayerNormalization", "two axes, no bias, statistics too",
         lambda _: [node("LayerNormalization", ["x", "s"], ["y", "m", "d"], axis=1, epsilon=1e-3)],
         {"x": floats(3, 4, 5)}, {"s": floats(4, 5, seed=1)}, ("y", "m", "d"), opsets=(17, 18)),
    Case("LpNormalization", "length", lambda _: [node("LpNormalization", ["x"], axis=-1)], {"x": X}),
    Case("LpNormalization", "zeros", lambda _: [node("LpNormalization", ["x"], axis=-1)],
         {"x": np.array([[0, 0, 0], [0, 3, 4]], np.float32)}),
    Case("LRN", "neighbours", lambda _: [node("LRN", ["x"], size=3, alpha=0.3, beta=0.6, bias=2.0)],
         {"x": floats(2, 5, 3, 4)}),
    Case("LpNormalization", "sum", lambda _: [node("LpNormalization", ["x"], axis=-1, p=1)], {"x": X}),
    recurrent("LSTM", 4, "with states", states=("h", "c")),
    recurrent("LSTM", 4, "from zero"),
    recurrent("LSTM", 4, "no bias", bias=False, states=("h", "c")),
    recurrent("LSTM", 4, "said to be forward", direction="forward", states=("h", "c"),
              activations=["Sigmoid", "Tanh", "Tanh"]),
    batch_first("LSTM", 4),
    recurrent("GRU", 3, "with a state", states=("h",)),
    recurrent("GRU", 3, "from zero"),
    recurrent("GRU", 3, "no bias", bias=False, states=("h",)),
    recurrent("GRU", 3, "linear before reset (PyTorch)", states=("h",), linear_before_reset=1),
    batch_first("GRU", 3),
    recurrent("RNN", 1, "with a state", states=("h",)),
    recurrent("RNN", 1, "from zero", bias=False),
    recurrent("LSTM", 4, "over a history", states=("h", "c"), steps=3),
    recurrent("GRU", 3, "over a history, backwards", steps=3, direction="reverse"),
    recurrent("RNN", 1, "over a history, backwards", states=("h",), steps=2, direction="reverse"),
    Case("If", "taken", conditional(True), {"x": X}),
    Case("If", "not taken", conditional(False), {"x": X}),
    Case("Scan", "one step", scan, {"x": SEQUENCE, "s": floats(B, H, seed=9)}, {"w": floats(N, H, seed=10)},
         ("y", "all"), shapes={"x": [1, "batch", N]}),
    Case("GroupNormalization", "per channel",
         lambda _: [node("GroupNormalization", ["x", "s", "b"], num_groups=2)], {"x": IMAGE},
         {"s": floats(4, seed=1), "b": floats(4, seed=2)}, opsets=(21,), oracle="onnx"),
    Case("GroupNormalization", "per group",
         lambda _: [node("GroupNormalization", ["x", "s", "b"], num_groups=2)], {"x": IMAGE},
         {"s": floats(2, seed=1), "b": floats(2, seed=2)}, opsets=(18,)),
    # defined by ONNX in terms of others; inlined by the reader
    Case("MeanVarianceNormalization", "by its definition",
         lambda _: [node("MeanVarianceNormalization", ["x"], axes=[2, 3])], {"x": IMAGE}, opsets=(13, 15)),
]  # fmt: skip
__all__ = ["CASES", "OPSETS"]
