"""A mean of 10⁵ deviations is taken off exactly in every runtime, whatever its optimiser folds.

Against the formula in float64 (stable_baselines3/common/vec_env/vec_normalize.py, ``_normalize_obs``).
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import FROZEN_GRAPH, LITERT, ONNX, SAVED_MODEL, TFJS
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.converters.trainers.pytorch.network import Network
from export_model.converters.trainers.pytorch.weights import Weights
from export_model.converters.trainers.stable_baselines3.normaliser import ALONE, Moments, Normaliser

RATIOS = np.array([0, 10, 1e2, 1e3, 1e4, 1e5, -1e5, 3e5])
DEVIATION = np.array([1, 0.3, 7, 0.01, 2, 1, 0.37, 0.05])
LIMIT = 10.0
FORMATS = {
    **dict.fromkeys(("tf1.4", "tf1.7"), FROZEN_GRAPH),
    "tensorflow": SAVED_MODEL,
    "tensorflow-python": SAVED_MODEL,
    "onnxruntime": ONNX,
    "openvino": ONNX,
    "litert": LITERT,
    "litert-plain": LITERT,
    "tfjs-cpu": TFJS,
    "tfjs-wasm": TFJS,
    "tensorflow-bytes": FROZEN_GRAPH,
}


def _policy(mean: np.ndarray) -> Policy:
    net = Network(cast(Weights, None))  # it has no weights
    x = net.input("vector_observation", len(mean))
    normaliser = Normaliser("vecnormalize.pkl", {ALONE: Moments(mean, DEVIATION)}, LIMIT)
    net.output("action", normaliser.apply(net, x, "vector_observation", ALONE, mean.shape))
    (policy,) = compile_graph(net.graph(), "far")
    return policy


@pytest.fixture(scope="module")
def case() -> tuple[Policy, np.ndarray, np.ndarray]:
    mean = RATIOS * DEVIATION * (1 + 1e-9)  # which float32 does not have
    rng = np.random.default_rng(0)
    x = (mean + DEVIATION * rng.standard_normal((64, len(mean))) * 6).astype(np.float32)
    expected = np.clip((x - mean) / DEVIATION, -LIMIT, LIMIT)
    return _policy(mean), x, expected


def _check(got: np.ndarray, expected: np.ndarray) -> None:
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("runtime", FORMATS)
def test_runtimes_agree_with_the_formula(
    runtime: str, case: tuple[Policy, np.ndarray, np.ndarray], pool: RuntimePool, tmp_path: Path
) -> None:
    policy, x, expected = case
    form = FORMATS[runtime]
    name = runtime.partition("-bytes")[0]
    found = next(i for i in available_runtimes() if i.name == name)
    if not found.installed:
        pytest.skip(f"{name} is not installed: {found.how}")
    form.artifact(policy, WriteOptions("{}")).write(tmp_path)
    options = {"kind": form.key, "signature": "serving_default"} if form is SAVED_MODEL else form.loader()
    with pool.process(name).load(str(tmp_path / form.main_of("far")), **options) as model:
        _check(model.run({"state": x}, ["action"])["action"], expected)


def test_onnxruntime_at_every_level(case: tuple[Policy, np.ndarray, np.ndarray]) -> None:
    ort = pytest.importorskip("onnxruntime")
    policy, x, expected = case
    (data,) = ONNX.artifact(policy, WriteOptions("{}")).files.values()
    levels = ort.GraphOptimizationLevel
    for level in (levels.ORT_DISABLE_ALL, levels.ORT_ENABLE_BASIC, levels.ORT_ENABLE_EXTENDED, levels.ORT_ENABLE_ALL):
        options = ort.SessionOptions()
        options.graph_optimization_level = level
        session = ort.InferenceSession(b"".join(data.chunks()), options)
        _check(session.run(["action"], {"state": x})[0], expected)
