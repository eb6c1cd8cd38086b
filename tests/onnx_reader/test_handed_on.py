"""Inputs that come out as they went in (Godot RL Agents' ``state_ins``): no memory, in no format.

The files are what godot_rl writes (wrappers/onnx/stable_baselines_export.py, examples/clean_rl_example.py and
clean_rl_pqn_example.py: torch.onnx.export with input_names obs, state_ins and output_names output, state_outs, opset 15
and 17); the oracle is onnxruntime on the file itself.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.errors import SignatureError
from export_model.signatures.roles import Role
from tests.onnx_reader.models import Bench, floats, model, node, save

pytestmark = pytest.mark.xdist_group("onnx-policies")

B = "batch_size"
STATE = ("state_ins", "state_outs")
Kind = tuple[Any, list[int | str]]


def godot(
    size: int = 4,
    *,
    rows: int | str = B,
    state: list[int | str] | None = None,
    names: tuple[str, str] = STATE,
    camera: bool = False,
    second: str | None = None,
    end: str | None = None,
    norm: bool = False,
    opset: int = 17,
) -> Any:
    """One of godot_rl's files: ``size`` actions, logits of all branches or means side by side; ``second``: what the
    second of two observations is called; ``end``: what squashes the action; ``norm``: CleanRL's PQN.
    """
    held: list[int | str] = [rows] if state is None else state
    inputs: dict[str, Kind] = {"obs": (np.float32, [rows, 3, 20, 20] if camera else [rows, 6])}
    constants = {"b": floats(8, seed=3), "v": floats(size, 8, seed=4), "c": floats(size, seed=5)}
    nodes, width = [], 6
    x = "obs"
    if camera:
        constants |= {"k": floats(4, 3, 8, 8, seed=1, scale=0.1), "kb": floats(4, seed=2)}
        nodes += [
            node("Conv", [x, "k", "kb"], "conv", strides=[4, 4], kernel_shape=[8, 8]),
            node("Relu", ["conv"], "r"),
        ]
        x, width = "r", 4 * 4 * 4
    nodes.append(node("Flatten", [x], "flat", axis=1))
    x = "flat"
    if second:
        inputs[second] = (np.float32, [rows, 5])
        nodes += [node("Flatten", [second], "flat_1", axis=1), node("Concat", ["flat", "flat_1"], "both", axis=1)]
        x, width = "both", width + 5
    inputs[names[0]] = (np.float32, held)
    constants["w"] = floats(8, width, seed=6, scale=0.4)
    nodes.append(node("Gemm", [x, "w", "b"], "h", transB=1))
    x = "h"
    if norm:
        constants |= {"g": floats(8, seed=8), "gb": floats(8, seed=9)}
        nodes.append(node("LayerNormalization", [x, "g", "gb"], "ln", axis=-1))
        x = "ln"
    nodes += [node("Tanh", [x], "t"), node("Gemm", ["t", "v", "c"], "mean" if end else "output", transB=1)]
    nodes += [node(end, ["mean"], "output")] if end else []
    nodes.append(node("Identity", [names[0]], names[1]))
    outputs: dict[str, Kind] = {"output": (np.float32, [rows, size]), names[1]: (np.float32, held)}
    return model(nodes, inputs, outputs, constants, opset=opset)


FILES: dict[str, dict[str, Any]] = {
    "continuous": {},
    "older": {"opset": 15},
    "one_choice": {"size": 9},
    "several_spaces": {"size": 2 + 3 + 5},
    "sac": {"end": "Tanh"},
    "pqn": {"norm": True},
    "camera": {"camera": True},
    "camera_of_one_agent": {"camera": True, "rows": 1},
    "one_agent": {"rows": 1},
    "one_agent_any_state": {"rows": 1, "state": [B]},
    "state_of_one": {"state": [1]},
    "state_of_a_row": {"state": [B, 7]},
    "two_observations": {"second": "other", "state": [1]},
    "two_observations_misnamed": {"second": "state_ins", "names": ("onnx::Identity_2", "state_outs"), "state": [1]},
    "camera_and_vector": {"camera": True, "second": "state_ins", "names": ("state_ins.1", "state_outs"), "state": [1]},
}


def compiled(message: Any, folder: Path, **options: Any) -> Policy:
    (policy,) = read_source(save(message, folder)).policies(CompileOptions(**options))
    return policy


@pytest.mark.parametrize("name", FILES)
def test_what_is_handed_on_is_left_out_and_the_rest_is_as_it_was(name: str, bench: Bench, tmp_path: Path) -> None:
    path = bench.place(godot(**FILES[name]))
    runtimes = ("onnxruntime", "tensorflow") if name in ("continuous", "camera_of_one_agent") else ("onnxruntime",)
    (result,) = export([path], ExportOptions(tmp_path, verify=runtimes), pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert result.report.reference == "source/onnxruntime"
    signature = result.policy.signature
    assert signature.memory is None
    assert {s.role for s in signature.inputs} <= {Role.VECTOR, Role.VISUAL}
    assert [s.name for s in signature.outputs] == ["action", "deterministic_action"]
    (note,) = [n for n in signature.notes if "handed on" in n]
    given, made = FILES[name].get("names", STATE)
    assert given in note
    assert made in note


def test_a_state_that_the_network_changes_is_a_memory(tmp_path: Path) -> None:
    nodes = [
        node("Concat", ["obs", "state_ins"], "x", axis=1), node("MatMul", ["x", "w"], "h"),
        node("Tanh", ["h"], "state_outs"), node("MatMul", ["state_outs", "v"], "output"),
    ]  # fmt: skip
    weights = {"w": floats(6 + 4, 4), "v": floats(4, 2)}
    inputs = {"obs": (np.float32, [B, 6]), "state_ins": (np.float32, [B, 4])}
    policy = compiled(model(nodes, inputs, ["output", "state_outs"], weights), tmp_path)
    assert policy.signature.memory is not None
    assert policy.signature.memory.size == 4


def test_a_state_that_is_read_as_well_is_asked_for(tmp_path: Path) -> None:
    """It is handed back unchanged, and still the action depends on it."""
    nodes = [
        node("Concat", ["obs", "carry"], "x", axis=1), node("MatMul", ["x", "w"], "output"),
        node("Identity", ["carry"], "hidden"),
    ]  # fmt: skip
    inputs = {"obs": (np.float32, [B, 6]), "carry": (np.float32, [B, 4])}
    with pytest.raises(SignatureError, match="memory"):
        compiled(model(nodes, inputs, ["output", "hidden"], {"w": floats(10, 2)}), tmp_path)


def test_what_the_user_says_goes_first(tmp_path: Path) -> None:
    given: dict[str, Any] = {"inputs": {"state_ins": Role.PARAMETER}, "outputs": {"state_outs": Role.OTHER}}
    policy = compiled(godot(state=[B, 7]), tmp_path, **given)
    assert policy.signature.output("state_outs").role is Role.OTHER
    assert policy.signature.input("state_ins").role is Role.PARAMETER
