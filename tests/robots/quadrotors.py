"""A network as PX4's example has it: 15-64-64-4 with ReLU, weights that no policy has."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
from onnx import helper, numpy_helper

SIZES = (15, 64, 64, 4)


def quadrotor(folder: Path, sizes: Sequence[int] = SIZES, activation: str = "Relu") -> Path:
    """``obs`` [B, 15] to ``actions`` [B, 4], as PyTorch exports it."""
    rng, nodes, weights, last = np.random.default_rng(0), [], [], "obs"
    for layer, (rows, columns) in enumerate(pairwise(sizes)):
        numbers = {f"w{layer}": rng.normal(size=(columns, rows)) / rows**0.5, f"b{layer}": rng.normal(size=columns)}
        weights += [numpy_helper.from_array(v.astype(np.float32), n) for n, v in numbers.items()]
        made = "actions" if layer == len(sizes) - 2 else f"sum{layer}"
        nodes.append(helper.make_node("Gemm", [last, *numbers], [made], transB=1))
        last = made
        if made != "actions":
            nodes.append(helper.make_node(activation, [made], [f"layer{layer}"]))
            last = f"layer{layer}"
    ends = [
        [helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, ["batch", w])]
        for n, w in (("obs", sizes[0]), ("actions", sizes[-1]))
    ]
    graph = helper.make_graph(nodes, "policy", *ends, weights)
    path = folder / "quadrotor.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)
    return path
