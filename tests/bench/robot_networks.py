"""Networks of the sizes that robots are trained with, as ONNX files: the hard cases of ``tests.bench.robots``."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Shapes = Mapping[str, tuple[int, ...]]


class _Maker:
    """Nodes and seeded weights in the making."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.weights: list[Any] = []
        self.products: list[tuple[int, int]] = []
        self._random = np.random.default_rng(0)

    def weight(self, *shape: int) -> str:
        name = f"w{len(self.weights)}"
        value = self._random.standard_normal(shape) / np.sqrt(max(1, shape[-2] if len(shape) > 1 else 10))
        self.weights.append(numpy_helper.from_array(value.astype(np.float32), name))
        return name

    def node(self, op: str, *inputs: str, result: str = "", **attributes: Any) -> str:
        name = result or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, inputs, [name], **attributes))
        return name

    def dense(self, x: str, sizes: tuple[int, ...], activation: str, result: str = "action") -> str:
        for i, (a, b) in enumerate(itertools.pairwise(sizes)):
            last = i == len(sizes) - 2
            x = self.node("Gemm", x, self.weight(a, b), self.weight(b), result=result if last else "")
            self.products.append((a, b))
            x = x if last else self.node(activation, x)
        return x


@dataclass(frozen=True)
class Network:
    """An ONNX model: what it takes and gives, and who makes its nodes."""

    name: str
    inputs: Shapes
    outputs: Shapes
    make: Callable[[_Maker], None]

    def save(self, path: Path) -> None:
        """Write the model."""
        made = self._made()

        def ports(shapes: Shapes) -> list[Any]:
            return [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items()]

        graph = helper.make_graph(made.nodes, self.name, ports(self.inputs), ports(self.outputs), made.weights)
        onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))

    def _made(self) -> _Maker:
        maker = _Maker()
        self.make(maker)
        return maker

    @property
    def products(self) -> list[tuple[int, int]]:
        """The matrices that vectors are multiplied by."""
        return self._made().products

    @property
    def multiply_adds(self) -> int:
        """Products that one decision adds up."""
        return sum(a * b for a, b in self.products)


def dense_network(name: str, sizes: tuple[int, ...], activation: str) -> Network:
    """Dense layers, each but the last with an activation."""

    def make(m: _Maker) -> None:
        m.dense("obs", sizes, activation)

    return Network(name, {"obs": (1, sizes[0])}, {"action": (1, sizes[-1])}, make)


def _recurrent(op: str, gates: int) -> Callable[[_Maker], None]:
    def make(m: _Maker) -> None:
        m.weights.append(numpy_helper.from_array(np.array([0], np.int64), "axis"))
        x = m.node("Unsqueeze", "obs", "axis")
        kernels = (m.weight(1, gates * 256, 48), m.weight(1, gates * 256, 256), m.weight(1, 2 * gates * 256))
        states = ("h_in", "c_in")[: 2 if op == "LSTM" else 1]
        outputs = ["", *(s.replace("in", "out") for s in states)]
        extra = {"linear_before_reset": 1} if op == "GRU" else {}
        m.nodes.append(helper.make_node(op, [x, *kernels, "", *states], outputs, hidden_size=256, **extra))
        m.products += [(48, gates * 256), (256, gates * 256)]
        m.dense(m.node("Squeeze", "h_out", "axis"), (256, 12), "Relu")

    return make


def _history(m: _Maker) -> None:
    """15 frames of 64 numbers, convolved in time, then dense."""
    x = "obs"
    for channels, filters in ((64, 32), (32, 32)):
        x = m.node("Conv", x, m.weight(filters, channels, 5), m.weight(filters), pads=[2, 2])
        x = m.node("Elu", x)
        m.products += [(5 * channels, filters)] * 15
    m.dense(m.node("Flatten", x), (15 * 32, 128, 12), "Elu")


def _camera(m: _Maker) -> None:
    """84 × 84 × 3 in Nature's convolutions (Mnih et al. 2015)."""
    x, channels, side = "obs", 3, 84
    for filters, size, stride in ((32, 8, 4), (64, 4, 2), (64, 3, 1)):
        x = m.node("Conv", x, m.weight(filters, channels, size, size), m.weight(filters), strides=[stride, stride])
        x, side = m.node("Relu", x), (side - size) // stride + 1
        m.products += [(size * size * channels, filters)] * side**2
        channels = filters
    m.dense(m.node("Flatten", x), (side**2 * 64, 512, 6), "Relu")


_STATE = (1, 1, 256)
NETWORKS = (
    dense_network("robot", (48, 512, 256, 128, 12), "Elu"),
    dense_network("tanh64", (17, 64, 64, 6), "Tanh"),
    Network("lstm256", {"obs": (1, 48), "h_in": _STATE, "c_in": _STATE},
            {"action": (1, 12), "h_out": _STATE, "c_out": _STATE}, _recurrent("LSTM", 4)),
    Network("gru256", {"obs": (1, 48), "h_in": _STATE}, {"action": (1, 12), "h_out": _STATE}, _recurrent("GRU", 3)),
    Network("history", {"obs": (1, 64, 15)}, {"action": (1, 12)}, _history),
    Network("camera", {"obs": (1, 3, 84, 84)}, {"action": (1, 6)}, _camera),
)  # fmt: skip
