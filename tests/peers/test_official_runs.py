"""What the official converter makes of our SavedModels runs in TensorFlow.js and agrees, on cpu and on wasm.

By itself it fuses what TensorFlow.js has no kernel for (converters/compiler/passes/unjoined_products.py).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.compiler.targets import SAVED_MODEL, prepare
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import SAVED_MODEL as FORMAT
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.activations import NAMED, gelu
from export_model.converters.graph.nodes import Graph, NameScope, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.sampling import draw_cases
from fixtures import FOLDER
from tests.comparing import compare_artefacts
from tests.peers.conftest import resident
from tests.peers.environment import Peers

pytestmark = [pytest.mark.slow, pytest.mark.peers, pytest.mark.xdist_group("peers")]
Convert = Callable[[Path, Path], Path]
F32 = np.dtype(np.float32)

#: Of each family of trainers: tanh and squashed, memories of every kind, one-hot actions, cameras, attention.
SOURCES = (
    *("recurrent.bytes", "visual.bytes", "sampled.bytes"),
    *("sb3_zip/ppo_box.zip", "sb3_zip/sac_box.zip", "sb3/sb3_discrete.onnx", "sb3/torch_actor.onnx"),
    *("torch_checkpoint/ppo_0_21_discrete_lstm.pt", "torch_checkpoint/ppo_1_1_hybrid_lstm.pt"),
    *("torch_checkpoint/sac_0_28_hybrid_lstm.pt", "torch_checkpoint/poca_0_26_discrete.pt"),
    *("torchscript/isaac_gru_script.pt", "torchscript/legged_lstm_script.pt", "torchscript/bent_script.pt"),
    *(
        "torchscript/convolved_trace.pt",
        "torchscript/painted_trace.pt",
        "torchscript/shrunk_trace.pt",
        "torchscript/attending_trace.pt",
    ),
)


@pytest.fixture(scope="module")
def convert(peers: Peers) -> Iterator[Convert]:
    with resident(peers, "tensorflowjs.converters.converter", "pip_main") as converter:

        def run(saved_model: Path, out: Path) -> Path:
            converter(["--input_format=tf_saved_model", str(saved_model), str(out)])
            return out

        yield run


def ops_of(model: Path) -> dict[str, str]:
    return {n["name"]: n["op"] for n in json.loads((model / "model.json").read_text())["modelTopology"]["node"]}


@pytest.mark.parametrize("source", SOURCES)
def test_a_policy_of_each_family_agrees(source: str, convert: Convert, tmp_path: Path, pool: RuntimePool) -> None:
    options = ExportOptions(tmp_path, targets=("saved_model",), verify="none")
    for made in export([FOLDER / source], options):
        saved_model = made.folder / "saved_model"
        theirs = convert(saved_model, tmp_path / f"{made.policy.name}-official")
        report = compare_artefacts(
            saved_model,
            [theirs],
            runtimes="tensorflow,tfjs-cpu,tfjs-wasm",
            options=VerifyOptions(samples=2, steps=3),
            pool=pool,
        )
        assert {c.runtime for c in report.comparisons} == {"tfjs-cpu", "tfjs-wasm"}
        assert report.passed, report.failures


def _net(layer: str, *, bias: bool = True) -> Graph:
    """Each activation behind a product and its bias, all beside each other, then one number of each."""
    b, rng = Builder(NameScope(())), np.random.default_rng(0)
    shape = (None, 6) if layer == "MatMul" else (None, 5, 5, 2)
    image = layer != "MatMul"
    b.append(
        Node(
            "visual_observation_0" if image else "vector_observation",
            "Placeholder",
            (),
            {"dtype": F32, "shape": TensorShape(shape)},
        )
    )
    x, found = b.nodes[0].name, []
    kernel = {"MatMul": (6, 4), "Conv2D": (3, 3, 2, 4), "DepthwiseConv2dNative": (3, 3, 2, 2)}[layer]
    attrs = {} if not image else {"strides": (1, 1, 1, 1), "padding": "VALID", "dilations": (1, 1, 1, 1)}
    activations = {**NAMED, "gelu by tanh": lambda b, x: gelu(b, x, tanh=True), "hard swish": _hard_swish}
    for activation in activations.values():
        product = b.add(layer, [x, b.floats(rng.standard_normal(kernel) * 0.5)], **attrs)
        y = activation(b, b.add("BiasAdd", [product, b.floats(rng.standard_normal(4))]))
        found.append(b.reduce("Mean", y, (1, 2), keep=False) if image else y)
    if not image:  # the sums of a recurrent cell, of a matrix and of a scalar
        products = [b.add("MatMul", [x, b.floats(rng.standard_normal(kernel))]) for _ in range(5)]
        found.append(b.add("Add", products[:2]))
        found.append(b.add("Add", [products[2], b.floats(rng.standard_normal((1, 4)))]))
        found.append(b.add("Tanh", [b.add("Add", [products[3], b.floats(0.3)])]))
        turned = b.add("MatMul", [x, b.floats(rng.standard_normal((4, 6)))], transpose_b=True)
        found.append(b.add("BiasAdd", [turned, b.floats(rng.standard_normal(4))]))
    b.add("Identity", [b.concat(found, 1)], "action")
    return b.graph()


def _hard_swish(b: Builder, x: str) -> str:
    inner = b.add("Relu6", [b.add("Add", [x, b.number(x, 3)])])
    return b.add("Mul", [x, b.add("Mul", [inner, b.number(x, 1 / 6)])])


@pytest.mark.parametrize("layer", ["MatMul", "Conv2D", "DepthwiseConv2dNative"])
def test_every_activation_behind_every_layer(layer: str, convert: Convert, tmp_path: Path, pool: RuntimePool) -> None:
    (policy,) = compile_graph(_net(layer), "net")
    FORMAT.artifact(policy, WriteOptions("{}")).write(tmp_path)
    theirs = convert(tmp_path / "saved_model", tmp_path / "official")
    cases = draw_cases(policy.signature)
    for runtime in ("tfjs-cpu", "tfjs-wasm"):
        with pool.process(runtime).load(str(theirs)) as model:
            for case in cases[:4]:
                expected = run_graph(policy.graph, case.feeds, ["action"])["action"]
                np.testing.assert_allclose(model.run(case.feeds, ["action"])["action"], expected, 1e-4, 1e-4)


def test_what_tensorflow_js_fuses_is_still_fused(convert: Convert, tmp_path: Path) -> None:
    """Only where its kernels lack the activation is a bias subtracted."""
    (policy,) = compile_graph(_net("MatMul"), "net")
    FORMAT.artifact(policy, WriteOptions("{}")).write(tmp_path)
    ops = list(ops_of(convert(tmp_path / "saved_model", tmp_path / "official")).values())
    written = [n.op for n in prepare(policy, SAVED_MODEL).nodes]
    lacked = 2  # tanh and the GELU
    assert written.count("BiasAdd") == ops.count("_FusedMatMul") == len(NAMED) + 2 - lacked
    assert "BiasAdd" not in ops
