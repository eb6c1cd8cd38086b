"""onnxruntime's own operators: those that compute are handed to it, any other is refused by name."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper

from export_model.converters.formats.onnx.vetted import COMPUTING, self_contained_model
from export_model.signatures.errors import UnsupportedOpError
from tests.onnx_reader.models import floats, model, node

IN = {"obs": (np.float32, ["batch", 3])}
INSTALLED = pytest.mark.skipif(importlib.util.find_spec("onnxruntime") is None, reason="onnxruntime is not installed")
#: What it has kernels for and is not handed: graphs run as often as an input says, patterns, an example.
LEFT_OUT = {"BeamSearch", "GreedySearch", "Sampling", "WhisperBeamSearch", "Tokenizer", "SampleOp"}


def asked(script: str, *arguments: str) -> Any:
    """What a process that has onnxruntime prints, as JSON."""
    done = subprocess.run(
        [sys.executable, "-c", script, *arguments], capture_output=True, text=True, timeout=120, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


KERNELS = """
import json
from onnxruntime.capi import onnxruntime_pybind11_state as state
found = [k.op_name for k in state.get_all_opkernel_def()
         if (k.provider, k.domain) == ("CPUExecutionProvider", "com.microsoft")]
schemas = [s for s in state.get_all_operator_schema() if s.domain == "com.microsoft"]
graphs = [s.name for s in schemas if any(str(a.type).split(".")[-1] in ("GRAPH", "GRAPHS")
          for a in s.attributes.values())]
print(json.dumps([sorted(set(found)), sorted(set(graphs))]))
"""


@pytest.mark.runtimes
@INSTALLED
def test_the_list_is_what_the_installed_runtime_has() -> None:
    kernels, with_graphs = map(set, asked(KERNELS))
    assert kernels == COMPUTING | LEFT_OUT
    assert not COMPUTING & with_graphs


def write(tmp_path: Path, *nodes: Any, domains: dict[str, int] | None = None) -> Path:
    made = model(nodes, IN, ["action"], {"w": floats(3, 3)}, domains=domains or {"com.microsoft": 1})
    (tmp_path / "m.onnx").write_bytes(made.SerializeToString())
    return tmp_path / "m.onnx"


def test_an_operator_that_computes_is_handed_over(tmp_path: Path) -> None:
    path = write(tmp_path, node("FusedMatMul", ["obs", "w"], "action", domain="com.microsoft", alpha=2.0))
    assert [n.op_type for n in self_contained_model(path).graph.node] == ["FusedMatMul"]


@pytest.mark.parametrize("kind", [*sorted(LEFT_OUT), "EPContext", "PythonOp", "ExternalOp", "Snpe", "NotYetThere"])
def test_any_other_is_refused(kind: str, tmp_path: Path) -> None:
    path = write(tmp_path, node(kind, ["obs"], "action", domain="com.microsoft", name="n"))
    with pytest.raises(UnsupportedOpError, match=rf"onnxruntime's operator com\.microsoft::{kind} \(node 'n'\)"):
        self_contained_model(path)


def test_a_function_of_the_file_does_not_stand_for_an_operator_of_the_runtime(tmp_path: Path) -> None:
    """Of two with one name the runtime takes its own."""
    made = onnx.load(write(tmp_path, node("EPContext", ["obs"], "action", domain="com.microsoft")))
    body = [node("Identity", ["x"], "y")]
    made.functions.append(
        helper.make_function("com.microsoft", "EPContext", ["x"], ["y"], body, [helper.make_opsetid("", 15)])
    )
    (tmp_path / "m.onnx").write_bytes(made.SerializeToString())
    with pytest.raises(UnsupportedOpError, match="EPContext"):
        self_contained_model(tmp_path / "m.onnx")


@pytest.mark.parametrize("domain", ["com.microsoft.nchwc", "com.ms.internal.nhwc"])
def test_what_was_laid_out_for_a_processor_says_what_to_do(domain: str, tmp_path: Path) -> None:
    path = write(tmp_path, node("Conv", ["obs", "w"], "action", domain=domain), domains={domain: 1})
    with pytest.raises(UnsupportedOpError, match=r"laid out for one kind of processor") as refused:
        self_contained_model(path)
    assert "ORT_ENABLE_EXTENDED" in str(refused.value)


OPTIMISE = """
import sys, onnxruntime
options = onnxruntime.SessionOptions()
options.optimized_model_filepath = sys.argv[2]
options.graph_optimization_level = getattr(onnxruntime.GraphOptimizationLevel, sys.argv[3])
options.log_severity_level = 3
onnxruntime.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
print("null")
"""


@pytest.mark.runtimes
@INSTALLED
def test_what_the_optimiser_saved_is_handed_over_or_said(tmp_path: Path) -> None:
    """The advice is good: what it saves at the level it names passes."""
    nodes = [
        node("Conv", ["obs", "k"], "c", kernel_shape=[3, 3]),
        node("Relu", ["c"], "r"),
        node("Flatten", ["r"], "f"),
        node("MatMul", ["f", "w"], "m"),
        node("Add", ["m", "b"], "action"),
    ]
    weights = {"k": floats(16, 16, 3, 3), "w": floats(16 * 36, 2), "b": floats(2)}
    made = model(nodes, {"obs": (np.float32, ["batch", 16, 8, 8])}, ["action"], weights)
    (tmp_path / "m.onnx").write_bytes(made.SerializeToString())
    for level in ("ORT_ENABLE_EXTENDED", "ORT_ENABLE_ALL"):
        asked(OPTIMISE, str(tmp_path / "m.onnx"), str(tmp_path / f"{level}.onnx"), level)
    saved = self_contained_model(tmp_path / "ORT_ENABLE_EXTENDED.onnx")
    assert "com.microsoft" in {n.domain for n in saved.graph.node}
    laid_out = {n.domain for n in onnx.load(tmp_path / "ORT_ENABLE_ALL.onnx").graph.node}
    if "com.microsoft.nchwc" in laid_out:  # as on every x86 processor; others have layouts of their own, or none
        with pytest.raises(UnsupportedOpError, match="laid out for one kind of processor"):
            self_contained_model(tmp_path / "ORT_ENABLE_ALL.onnx")
