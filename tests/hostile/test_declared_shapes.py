"""Small files that declare huge inputs: what a command computes of shapes alone has a bound, in every format."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from export_model.converters.formats.registry import WRITTEN
from tests.exporting import export_model

#: What ``inspect``, which asks all writers, may take beside the modules that it imports: bytes, seconds of processor.
MEMORY, SECONDS = 256 << 20, 10.0
_INSPECT = """
import json, resource, sys
from export_model.exporter.inspect.inspection import inspect_source
inspect_source(sys.argv[1])
base = resource.getrusage(resource.RUSAGE_SELF)
try:
    told = {t: r for p in inspect_source(sys.argv[2]).policies for t, r in p.targets.items()}
except Exception as error:
    told = {"error": f"{type(error).__name__}: {error}"}
end = resource.getrusage(resource.RUSAGE_SELF)
grown = (end.ru_maxrss - base.ru_maxrss) << 10
print(json.dumps([grown, end.ru_utime - base.ru_utime, told]))
"""
Node = tuple[str, list[str], list[str], dict[str, object]]

#: Of each: the input's lengths per agent, and the nodes that make three numbers ``m`` of it.
HUGE: dict[str, tuple[list[int], list[Node]]] = {
    "axes": ([3, 250, 300, 280], [("ReduceMean", ["x"], ["m"], {"axes": [2, 3, 4], "keepdims": 0})]),
    "vector": ([60_000_000], [("Slice", ["x", "zero", "three", "one"], ["m"], {})]),
    "image": ([3, 4000, 4000], [("GlobalAveragePool", ["x"], ["p"], {}), ("Flatten", ["p"], ["m"], {})]),
    "convolution": (
        [1, 900, 900],
        [
            ("Conv", ["x", "kernel"], ["c"], {"kernel_shape": [64, 64]}),
            ("GlobalAveragePool", ["c"], ["p"], {}),
            ("Flatten", ["p"], ["m"], {}),
        ],
    ),
    "draws": (
        [3],
        [
            ("RandomNormal", [], ["r"], {"shape": [1, 3, 20_000_000]}),
            ("ReduceMean", ["r"], ["mean"], {"axes": [2], "keepdims": 0}),
            ("Add", ["x", "mean"], ["m"], {}),
        ],
    ),
}
CONSTANTS = {
    "zero": np.array([0]), "one": np.array([1]), "three": np.array([3]), "weights": np.ones((3, 2), np.float32),
    "kernel": np.ones((3, 1, 64, 64), np.float32), "memories": np.array([1, 20_000_000]),
}  # fmt: skip


def write_onnx(file: Path, lengths: list[int], nodes: list[Node], output: list[int] | None = None) -> Path:
    made = [helper.make_node(op, given, outputs, **attributes) for op, given, outputs, attributes in nodes]
    if output is None:
        made.append(helper.make_node("MatMul", ["m", "weights"], ["action"]))
    read = {name for node in made for name in node.input}
    graph = helper.make_graph(
        made, "huge",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, ["B", *lengths])],
        [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["B", *(output or [2])])],
        [numpy_helper.from_array(value, name) for name, value in CONSTANTS.items() if name in read],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.save(model, file)
    return file


def inspected(file: Path, small: Path) -> dict[str, str | None]:
    """What each target says of a file; fails where that took more than it may."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", _INSPECT, str(small), str(file)]
    limit = 4 << 30  # a machine that runs tests is not to be filled by the fault that is looked for
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
    )  # fmt: skip
    grown, seconds, told = json.loads(done.stdout)
    assert grown < MEMORY, (grown >> 20, told)
    assert seconds < SECONDS, (seconds, told)
    found: dict[str, str | None] = told
    return found


@pytest.fixture(scope="session")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is inspected before, so that the modules of all writers are there."""
    return write_onnx(tmp_path_factory.mktemp("small") / "small.onnx", [3], [("Relu", ["x"], ["m"], {})])


@pytest.mark.parametrize("name", HUGE)
def test_what_is_computed_of_a_declared_shape_has_a_bound(name: str, small: Path, tmp_path: Path) -> None:
    told = inspected(write_onnx(tmp_path / "huge.onnx", *HUGE[name]), small)
    assert not any("memory" in (reason or "") for reason in told.values()), told


@pytest.mark.parametrize("target", ["bytes", "saved_model", "tfjs", "litert"])
def test_it_has_in_every_format(target: str, small: Path, tmp_path: Path) -> None:
    source = write_onnx(tmp_path / "huge.onnx", *HUGE["convolution"])
    (result,) = export_model(source, tmp_path / "out", to=[target], verify="none")
    told = inspected(result.folder / WRITTEN[target].main_of(result.policy.name), small)
    assert told["c"] is None, told


def test_a_tensor_that_is_repeated_has_a_bound_in_a_nn(small: Path, tmp_path: Path) -> None:
    nodes: list[Node] = [
        ("MatMul", ["x", "weights"], ["y"], {}),
        ("Tile", ["y", "memories"], ["action"], {}),
    ]
    told = inspected(write_onnx(tmp_path / "huge.onnx", [3], nodes, [40_000_000]), small)
    assert "repeats a tensor 20000000 times" in str(told["nn"]), told


def test_noise_of_more_numbers_than_any_policy_has_is_refused_by_name(small: Path, tmp_path: Path) -> None:
    told = inspected(write_onnx(tmp_path / "huge.onnx", *HUGE["draws"]), small)
    assert "60000000 numbers for an agent" in str(told["error"]), told
