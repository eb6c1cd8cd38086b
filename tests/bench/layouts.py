"""``python -m tests.bench.layouts``: what telling a policy's layout costs, in seconds of the processor.

Whole processes of ``export-model layout``, smallest of ``ROUNDS``, beside the interpreter's own start. Aimed at:
1 s for 48-512-256-128-12, 3 s for an LSTM of 256 before the same layers. Weights are random, so every layout is tried,
and none fits; where one fits, small changes of it are tried too: the walker of ``fixtures/layout`` shows that.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from fixtures.layout import FOLDER

ROUNDS = 3
SIZES, MEMORY = (48, 512, 256, 128, 12), 256


def network(path: Path, *, memory: bool) -> Path:
    """ELU layers as legged_gym trains them, behind an LSTM where ``memory``, as ONNX."""
    rng = np.random.default_rng(0)
    weights, nodes = [], []

    def constant(name: str, shape: Sequence[int]) -> str:
        value = rng.standard_normal(shape).astype(np.float32) / shape[-2] ** 0.5 if len(shape) > 1 else np.zeros(shape)
        weights.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    sizes, x = SIZES, "obs"
    ports = [("obs", [1, SIZES[0]])], [("actions", [1, SIZES[-1]])]
    if memory:
        sizes = (MEMORY, *SIZES[1:])
        states = [1, 1, MEMORY]
        ports[0].extend([("h_in", states), ("c_in", states)])
        ports[1].extend([("h_out", states), ("c_out", states)])
        weights.append(numpy_helper.from_array(np.array([0], np.int64), "first"))
        w = [
            constant("W", (1, 4 * MEMORY, SIZES[0])),
            constant("R", (1, 4 * MEMORY, MEMORY)),
            constant("B", (1, 8 * MEMORY)),
        ]
        nodes += [
            helper.make_node("Unsqueeze", ["obs", "first"], ["steps"]),
            helper.make_node("LSTM", ["steps", *w, "", "h_in", "c_in"], ["", "h_out", "c_out"], hidden_size=MEMORY),
            helper.make_node("Squeeze", ["h_out", "first"], ["seen"]),
        ]
        x = "seen"
    layers = list(pairwise(sizes))
    for i, pair in enumerate(layers):
        last = i == len(layers) - 1
        made = "actions" if last else f"layer{i}"
        nodes.append(helper.make_node("Gemm", [x, constant(f"w{i}", pair), constant(f"b{i}", pair[1:])], [made]))
        if not last:
            nodes.append(helper.make_node("Elu", [made], [f"elu{i}"]))
        x = f"elu{i}"
    taken, given = ([helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in row] for row in ports)
    graph = helper.make_graph(nodes, "policy", taken, given, weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8), path)
    return path


def seconds(*command: str) -> float:
    """The smallest time of the processor, user and system, that a command takes."""
    times = []
    for _ in range(ROUNDS):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *command], capture_output=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        times.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(times)


def main() -> int:
    layout = ("-m", "export_model", "layout")
    with tempfile.TemporaryDirectory() as folder:
        made = {
            "48-512-256-128-12 (1 s)": network(Path(folder) / "mlp.onnx", memory=False),
            "LSTM 256, then the same (3 s)": network(Path(folder) / "lstm.onnx", memory=True),
            "walker.pt, with small changes": FOLDER / "walker.pt",
            "walker_lstm.pt, with small changes": FOLDER / "walker_lstm.pt",
        }
        print(f"layout, s of the processor, smallest of {ROUNDS}")
        print(f"  {'export-model --version':36}{seconds('-m', 'export_model', '--version'):.2f}")
        for name, path in made.items():
            print(f"  {name:36}{seconds(*layout, str(path)):.2f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
