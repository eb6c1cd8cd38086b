"""The PyTorch generations of ML-Agents: names, ranks, kinds of actions, memories, and the faults that are named."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from tests.onnx_reader.mlagents import ACTIONS, HIDDEN, OBS, policy
from tests.onnx_reader.models import Bench, floats, helper, node, save

pytestmark = pytest.mark.xdist_group("onnx-policies")

MEMORY = 2 * HIDDEN


def shapes(specs: Any) -> dict[str, tuple[str, tuple[int | None, ...]]]:
    return {s.name: (s.role.value, s.shape) for s in specs}


def compiled(message: Any, folder: Path) -> Policy:
    (result,) = read_source(save(message, folder)).policies()
    return result


def agrees(message: Any, bench: Bench, folder: Path) -> Policy:
    """Export to all formats; ours in onnxruntime and the original in onnxruntime must agree."""
    path = bench.place(message)
    options = ExportOptions(folder, verify=("onnxruntime",))
    (result,) = export([path], options, pool=bench.pool)
    assert result.report is not None
    assert result.report.reference == "source/onnxruntime"
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    return result.policy


CASES: dict[str, tuple[Any, str, str]] = {
    "0.20 continuous": (policy("0.20", continuous=True), "0.20-0.22", "continuous"),
    "0.22 continuous": (policy("0.22", continuous=True), "0.20-0.22", "continuous"),
    "0.22 discrete": (policy("0.22", branches=[3, 2]), "0.20-0.22", "discrete"),
    "0.22 recurrent": (policy("0.22", branches=[3], recurrent=True), "0.20-0.22", "discrete"),
    "0.23 continuous": (policy("0.23", continuous=True), "0.23-0.25", "continuous"),
    "0.23 discrete": (policy("0.23", branches=[3, 2]), "0.23-0.25", "discrete"),
    "0.23 hybrid": (policy("0.23", continuous=True, branches=[3, 2]), "0.23-0.25", "hybrid"),
    "0.23 recurrent": (policy("0.23", continuous=True, recurrent=True), "0.23-0.24", "continuous"),
    "0.25 recurrent": (policy("0.25", branches=[3, 2], recurrent=True), "0.25", "discrete"),
    "0.25 recurrent hybrid": (policy("0.25", continuous=True, branches=[4], recurrent=True), "0.25", "hybrid"),
    "0.26 continuous": (policy("0.26", continuous=True), "0.26-0.27", "continuous"),
    "0.26 discrete": (policy("0.26", branches=[3, 2]), "0.26-0.27", "discrete"),
    "0.26 recurrent": (policy("0.26", branches=[3, 2], recurrent=True), "0.26-0.27", "discrete"),
    "0.26 recurrent hybrid": (policy("0.26", continuous=True, branches=[3, 2], recurrent=True), "0.26-0.27", "hybrid"),
    "0.28 continuous": (policy("0.28", continuous=True), "0.28-1.1", "continuous"),
    "0.28 discrete": (policy("0.28", branches=[3, 2]), "0.28-1.1", "discrete"),
    "0.28 hybrid": (policy("0.28", continuous=True, branches=[3, 2]), "0.28-1.1", "hybrid"),
    "0.28 SAC": (policy("0.28", continuous=True, sac=True), "0.28-1.1", "continuous"),
    "1.1 constants by Identity": (policy("0.28", branches=[3, 2], identities=True), "0.28-1.1", "discrete"),
    "1.1 without masks": (policy("0.28", branches=[3], masks=False), "0.28-1.1", "discrete"),
}


@pytest.mark.parametrize("name", CASES)
def test_generation_and_numbers(name: str, bench: Bench, tmp_path: Path) -> None:
    message, span, space = CASES[name]
    result = agrees(message, bench, tmp_path)
    assert result.signature.family == f"ML-Agents {span} (PyTorch)"
    assert result.signature.action_space == space
    assert result.signature.constants["version_number"] in (2, 3)
    assert result.signature.constants["memory_size"] == (MEMORY if "recurrent" in name else 0)


def test_old_actions_keep_their_rank(tmp_path: Path) -> None:
    signature = compiled(policy("0.20", continuous=True), tmp_path).signature
    assert shapes(signature.inputs) == {
        "state": ("vector_observation", (None, OBS)),
        "epsilon": ("noise", (None, ACTIONS)),
    }
    assert shapes(signature.outputs) == {
        "action": ("continuous", (None, ACTIONS, 1)),
        "deterministic_action": ("deterministic", (None, ACTIONS, 1)),
    }
    assert signature.algorithm == "PPO"


def test_the_normaliser_is_found(tmp_path: Path) -> None:
    found = compiled(policy("0.26", continuous=True), tmp_path).signature.input("state").distribution
    assert found is not None
    np.testing.assert_allclose(found["mean"], floats(OBS, seed=90))


def test_two_draws_of_one_action_are_named(tmp_path: Path) -> None:
    result = compiled(policy("0.23", continuous=True), tmp_path)
    assert [s.name for s in result.signature.noise] == ["epsilon"]
    assert any("two independent draws" in note for note in result.signature.notes)
    assert "continuous_actions" not in [s.name for s in result.signature.outputs]


def test_hybrid_policies_have_both_heads(tmp_path: Path) -> None:
    signature = compiled(policy("0.28", continuous=True, branches=[3, 2]), tmp_path).signature
    assert shapes(signature.outputs) == {
        "continuous_actions": ("continuous", (None, ACTIONS)),
        "discrete_actions": ("sampled", (None, 2)),
        "deterministic_continuous_actions": ("deterministic", (None, ACTIONS)),
        "deterministic_discrete_actions": ("deterministic", (None, 2)),
        "action_log_probs": ("log_probs", (None, 5)),
    }
    assert signature.branches == (3, 2)
    assert signature.output("deterministic_discrete_actions").source == "deterministic_discrete_actions"


def test_hybrid_policies_of_log_probabilities(tmp_path: Path) -> None:
    signature = compiled(policy("0.23", continuous=True, branches=[3, 2]), tmp_path).signature
    assert signature.output("discrete_actions").role.value == "log_probs"
    assert signature.output("continuous_actions").role.value == "continuous"


def test_memory_is_hidden_state_first(tmp_path: Path) -> None:
    memory = compiled(policy("0.26", branches=[3], recurrent=True), tmp_path).signature.memory
    assert memory is not None
    assert memory.to_dict() == {
        "size": MEMORY, "input": "recurrent_in", "output": "recurrent_out", "layout": ["h", "c"]
    }  # fmt: skip


def test_old_memories_are_right_for_one_row_only_in_the_source(bench: Bench, tmp_path: Path) -> None:
    result = agrees(policy("0.25", branches=[3, 2], recurrent=True), bench, tmp_path)
    assert result.source.rows == 1
    assert shapes(result.signature.outputs)["recurrent_out"] == ("memory_out", (None, 1, MEMORY))
    assert any("one row only" in note for note in result.signature.notes)


def test_a_lost_memory_output_is_named(tmp_path: Path) -> None:
    signature = compiled(policy("0.22", branches=[3], recurrent=True), tmp_path).signature
    assert signature.memory is not None
    assert signature.memory.output is None
    assert any("does not give it back" in note for note in signature.notes)


def test_the_raw_mean_of_sac_is_named(tmp_path: Path) -> None:
    signature = compiled(policy("0.28", continuous=True, sac=True), tmp_path).signature
    assert signature.algorithm == "SAC"
    assert any("raw mean of SAC" in note for note in signature.notes)


def test_missing_masks_are_not_asked_for(tmp_path: Path) -> None:
    signature = compiled(policy("0.28", branches=[3], masks=False), tmp_path).signature
    assert [s.name for s in signature.inputs] == ["state"]


def test_images_are_channels_first(bench: Bench, tmp_path: Path) -> None:
    nodes = [
        node("Conv", ["obs_0", "k"], "a", kernel_shape=[8, 8], strides=[4, 4], pads=[0, 0, 0, 0]),
        node("LeakyRelu", ["a"], "b", alpha=0.01),
        node("Conv", ["b", "l"], "c", kernel_shape=[4, 4], strides=[2, 2], pads=[0, 0, 0, 0]),
        node("LeakyRelu", ["c"], "d", alpha=0.01),
        node("Flatten", ["d"], "e"),
        node("Gemm", ["e", "w"], "continuous_actions", transB=1),
    ]
    constants = {
        "k": floats(4, 3, 8, 8, seed=1, scale=0.1), "l": floats(6, 4, 4, 4, seed=2, scale=0.2),
        "w": floats(2, 6 * 3 * 4, seed=3, scale=0.2), "version_number": np.array([3.0], np.float32),
    }  # fmt: skip
    message = model_of(nodes, {"obs_0": ["batch", 3, 36, 44]}, constants, ["continuous_actions", "version_number"])
    result = agrees(message, bench, tmp_path)
    assert result.signature.preprocess["observation_0"]["layout"] == "NCHW"
    assert result.signature.input("observation_0").shape == (None, 3, 36, 44)
    # one transpose to NHWC, one back before the flattening
    assert sum(n.op == "Transpose" for n in result.graph.nodes) == 2


def model_of(nodes: Any, inputs: Any, constants: Any, outputs: Any) -> Any:
    from tests.onnx_reader.models import model

    return model(nodes, {n: (np.float32, dims) for n, dims in inputs.items()}, outputs, constants, opset=11)


def test_goal_conditioned_policies(bench: Bench, tmp_path: Path) -> None:
    """Release 18 and later: a HyperNetwork makes the weights of a layer from the goal (ConditionalEncoder)."""
    size, out = OBS, 5
    nodes = [
        node("Gemm", ["obs_1", "g", "gb"], "flat", transB=1),
        helper.make_node("Slice", ["flat", "s0", "e0", "ax"], ["wf"]),
        helper.make_node("Slice", ["flat", "e0", "e1", "ax"], ["bias"]),
        node("Reshape", ["wf", "shape"], "weights"),
        node("Unsqueeze", ["obs_0"], "row", axes=[1]),
        node("MatMul", ["row", "weights"], "product"),
        node("Squeeze", ["product"], "made", axes=[1]),
        node("Add", ["made", "bias"], "sum"),
        node("Tanh", ["sum"], "act"),
        node("Gemm", ["act", "w"], "continuous_actions", transB=1),
    ]
    constants = {
        "g": floats(size * out + out, 3, seed=1), "gb": floats(size * out + out, seed=2),
        "s0": np.array([0]), "e0": np.array([size * out]), "e1": np.array([2**62]), "ax": np.array([1]),
        "shape": np.array([-1, size, out]), "w": floats(2, out, seed=3),
        "version_number": np.array([3.0], np.float32),
    }  # fmt: skip
    inputs = {"obs_0": ["batch", size], "obs_1": ["batch", 3]}
    result = agrees(model_of(nodes, inputs, constants, ["continuous_actions", "version_number"]), bench, tmp_path)
    assert [s.name for s in result.signature.observations] == ["state", "state_1"]
    assert "BatchMatMul" in {n.op for n in result.graph.nodes}


def test_variable_length_observations(bench: Bench, tmp_path: Path) -> None:
    """Entities through one attention head with masked softmax and decomposed layer normalisation, as 0.24 writes it."""
    n, width, d = 7, 4, 6
    nodes = [
        node("Pow", ["obs_1", "two"], "sq"),
        node("ReduceSum", ["sq"], "norm", axes=[2], keepdims=0),
        node("Less", ["norm", "small"], "is_padding"),
        node("Cast", ["is_padding"], "padding", to=1),
        node("MatMul", ["obs_1", "e"], "entities"),
        node("ReduceMean", ["entities"], "mean", axes=[-1], keepdims=1),
        node("Sub", ["entities", "mean"], "centred"),
        node("Pow", ["centred", "two"], "square"),
        node("ReduceMean", ["square"], "variance", axes=[-1], keepdims=1),
        node("Add", ["variance", "tiny"], "safe"),
        node("Sqrt", ["safe"], "deviation"),
        node("Div", ["centred", "deviation"], "x"),
        *(node("MatMul", ["x", w], out) for w, out in (("wq", "q"), ("wk", "k"), ("wv", "v"))),
        *(node("Reshape", [t, "heads"], f"{t}h") for t in "qkv"),
        *(node("Transpose", [f"{t}h"], f"{t}t", perm=[0, 2, 1, 3]) for t in "qv"),
        node("Transpose", ["kh"], "kt", perm=[0, 2, 3, 1]),
        node("MatMul", ["qt", "kt"], "scores"),
        node("Reshape", ["padding", "wide"], "mask"),
        node("Mul", ["mask", "never"], "off"),
        node("Add", ["scores", "off"], "masked"),
        node("Softmax", ["masked"], "attention", axis=3),
        node("MatMul", ["attention", "vt"], "mixed"),
        node("Transpose", ["mixed"], "back", perm=[0, 2, 1, 3]),
        node("Reshape", ["back", "joined"], "flat"),
        node("ReduceSum", ["flat"], "pooled", axes=[1], keepdims=0),
        node("Concat", ["pooled", "obs_0"], "all", axis=1),
        node("Gemm", ["all", "w"], "continuous_actions", transB=1),
    ]
    heads = 2
    constants = {
        "two": np.array(2, np.float32), "small": np.array(0.01, np.float32), "tiny": np.array(1e-5, np.float32),
        "never": np.array(-1e6, np.float32), "e": floats(width, d, seed=1),
        **{w: floats(d, d, seed=i, scale=0.4) for i, w in enumerate(("wq", "wk", "wv"), 2)},
        "heads": np.array([-1, n, heads, d // heads]), "wide": np.array([-1, 1, 1, n]), "joined": np.array([-1, n, d]),
        "w": floats(2, d + 3, seed=6), "version_number": np.array([3.0], np.float32),
    }  # fmt: skip
    inputs = {"obs_0": ["batch", 3], "obs_1": ["batch", n, width]}
    result = agrees(model_of(nodes, inputs, constants, ["continuous_actions", "version_number"]), bench, tmp_path)
    assert result.signature.input("entities_0").shape == (None, n, width)
    softmax = [x for x in result.graph.nodes if x.op == "Softmax"]
    assert len(softmax) == 1  # on two axes, as TF 1.x takes it
    assert result.graph.producer(softmax[0].inputs[0]).op == "Reshape"
