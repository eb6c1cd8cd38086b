"""ONNX models in onnxruntime-web: what a run answers, which models and feeds are refused, how the process ends.

The oracle is numpy, on models that onnx's own helpers write.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from onnx import TensorProto, helper, numpy_helper

from export_model.converters.runtimes.javascript.node import JS_SOURCE
from tests.runtimes.pipe import HOME, NEEDS_NODE, Array, Runner, frame

pytestmark = [
    *NEEDS_NODE,
    pytest.mark.skipif(
        not (HOME / "node_modules" / "onnxruntime-web").is_dir(), reason="the npm package onnxruntime-web is not here"
    ),
]

RUNTIME = "onnxruntime-web"
DTYPES = ["float32", "float64", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "bool"]


@pytest.fixture(scope="module")
def shared() -> Iterator[Runner]:
    runner = Runner(RUNTIME)
    yield runner
    status, _, err = runner.end()
    assert (status, err) == (0, "")


@pytest.fixture
def runner(shared: Runner) -> Iterator[Runner]:
    """The shared process, without the model of the test before."""
    yield shared
    shared.ask("unload", id="m")


def element(dtype: str) -> int:
    return int(helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))


def value(name: str, dtype: str, shape: Sequence[int | str | None]) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, element(dtype), list(shape))


def write_model(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    inputs: Sequence[onnx.ValueInfoProto],
    outputs: Sequence[onnx.ValueInfoProto],
    weights: Mapping[str, Array] | None = None,
) -> Path:
    initializers = [numpy_helper.from_array(v, n) for n, v in (weights or {}).items()]
    graph = helper.make_graph(list(nodes), "g", list(inputs), list(outputs), initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(model.SerializeToString())
    return path


def identity(path: Path, dtype: str, shape: Sequence[int | str | None] = (None,)) -> Path:
    nodes = [helper.make_node("Identity", ["x"], ["y"])]
    return write_model(path, nodes, [value("x", dtype, shape)], [value("y", dtype, shape)])


W = np.random.default_rng(3).standard_normal((4, 3)).astype(np.float32)


def policy(path: Path) -> Path:
    """A product, its best column as int64, and whether it is positive: three kinds of outputs."""
    nodes = [
        helper.make_node("MatMul", ["state", "w"], ["value"]),
        helper.make_node("ArgMax", ["value"], ["action"], axis=1, keepdims=0),
        helper.make_node("Greater", ["value", "zero"], ["positive"]),
    ]
    outputs = [value("value", "float32", ["batch", 3]), value("action", "int64", ["batch"])]
    outputs.append(value("positive", "bool", ["batch", 3]))
    weights = {"w": W, "zero": np.zeros((), np.float32)}
    return write_model(path, nodes, [value("state", "float32", ["batch", 4])], outputs, weights)


def states(rows: int, seed: int = 0) -> Array:
    return np.random.default_rng(seed).standard_normal((rows, 4)).astype(np.float32)


# ---- what a run answers ----------------------------------------------------------------------------------------------


def test_hello_names_runtime_and_version(shared: Runner) -> None:
    header, _ = shared.ask("hello")
    pinned = json.loads((JS_SOURCE / "package.json").read_text())["dependencies"][RUNTIME]
    assert header == {"ok": True, "runtime": RUNTIME, "version": pinned}


def test_load_describes_the_model(runner: Runner, tmp_path: Path) -> None:
    header = runner.load(policy(tmp_path / "m.onnx"))
    assert header["inputs"] == [{"name": "state", "dtype": "float32", "shape": [None, 4]}]
    assert header["outputs"] == [
        {"name": "value", "dtype": "float32", "shape": [None, 3]},
        {"name": "action", "dtype": "int64", "shape": [None]},
        {"name": "positive", "dtype": "bool", "shape": [None, 3]},
    ]


def test_outputs_have_the_values_of_numpy_and_their_own_dtypes(runner: Runner, tmp_path: Path) -> None:
    runner.load(policy(tmp_path / "m.onnx"))
    for seed, rows in enumerate((1, 2, 7, 64)):
        state = states(rows, seed)
        got = runner.run({"state": state})
        assert list(got) == ["value", "action", "positive"]
        assert [v.dtype.name for v in got.values()] == ["float32", "int64", "bool"]
        np.testing.assert_allclose(got["value"], state @ W, rtol=1e-5, atol=1e-5)
        np.testing.assert_array_equal(got["action"], (state @ W).argmax(1))
        np.testing.assert_array_equal(got["positive"], state @ W > 0)


@pytest.mark.parametrize("dtype", DTYPES)
def test_every_dtype_crosses_bit_for_bit(runner: Runner, tmp_path: Path, dtype: str) -> None:
    runner.load(identity(tmp_path / "m.onnx", dtype))
    kind = np.dtype(dtype)
    edges: list[Any] = [True, False] if dtype == "bool" else [0, 1, 7]
    if kind.kind in "iu":
        edges += [np.iinfo(kind).min, np.iinfo(kind).max]
    if kind.kind == "f":
        edges += [np.nan, np.inf, -np.inf, -0.0, np.finfo(kind).tiny, np.finfo(kind).max, 1 / 3]
    values = np.array(edges, kind)
    got = runner.run({"x": values})["y"]
    assert got.dtype == kind
    assert got.tobytes() == values.tobytes()


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(
    array=st.sampled_from(DTYPES).flatmap(
        lambda dtype: arrays.arrays(
            np.dtype(dtype), arrays.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4)
        )
    )
)
def test_any_tensor_comes_back_as_it_was(runner: Runner, tmp_path: Path, array: Array) -> None:
    runner.ask("unload", id="m")
    runner.load(identity(tmp_path / "m.onnx", array.dtype.name, [None] * array.ndim))
    got = runner.run({"x": array})["y"]
    assert (got.shape, got.dtype) == (array.shape, array.dtype)
    assert got.tobytes() == array.tobytes()


def test_fetch_gives_these_outputs_in_this_order(runner: Runner, tmp_path: Path) -> None:
    runner.load(policy(tmp_path / "m.onnx"))
    for names in (["positive"], ["action", "value"], ["value", "action"]):
        assert list(runner.run({"state": states(2)}, fetch=names)) == names


def test_two_models_do_not_disturb_each_other(runner: Runner, tmp_path: Path) -> None:
    runner.load(policy(tmp_path / "a.onnx"))
    runner.load(identity(tmp_path / "b.onnx", "int64"), "other")
    before = runner.run({"state": states(3)})
    runner.run({"x": np.arange(9)}, "other")
    runner.ask("unload", id="other")
    np.testing.assert_array_equal(runner.run({"state": states(3)})["value"], before["value"])


def test_the_same_input_gives_the_same_bits(runner: Runner, tmp_path: Path) -> None:
    runner.load(policy(tmp_path / "m.onnx"))
    answers = {runner.run({"state": states(64)})["value"].tobytes() for _ in range(3)}
    assert len(answers) == 1


# ---- errors are answers ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fetch", [[], "action", ["nothing"], ["state"]])
def test_a_bad_fetch_is_an_error(runner: Runner, tmp_path: Path, fetch: Any) -> None:
    runner.load(policy(tmp_path / "m.onnx"))
    assert "fetch" in runner.error("run", {"state": states(1)}, id="m", fetch=fetch)
    assert runner.run({"state": states(1)})["value"].shape == (1, 3)


def test_feeds_that_do_not_fit_are_answered(runner: Runner, tmp_path: Path) -> None:
    runner.load(policy(tmp_path / "m.onnx"))
    assert "'state' is missing" in runner.error("run", {}, id="m")
    assert "Expected: 4" in runner.error("run", {"state": np.zeros((2, 5), np.float32)}, id="m")
    assert "expected: (tensor(float))" in runner.error("run", {"state": np.zeros((2, 4), np.int64)}, id="m")
    assert runner.run({"state": states(2)})["value"].shape == (2, 3)


def test_models_that_cannot_be_loaded_are_answered(runner: Runner, tmp_path: Path) -> None:
    assert "ENOENT" in runner.error("load", id="m", path=str(tmp_path / "nowhere.onnx"))
    good = policy(tmp_path / "good.onnx").read_bytes()
    for name, data in (("cut", good[:-20]), ("empty", b""), ("noise", bytes(range(256)))):
        (tmp_path / name).write_bytes(data)
        assert runner.error("load", id="m", path=str(tmp_path / name))
    unknown = [helper.make_node("Frobnicate", ["x"], ["y"])]
    ends = [value("x", "float32", [1])], [value("y", "float32", [1])]
    path = write_model(tmp_path / "op.onnx", unknown, *ends)
    assert "Frobnicate" in runner.error("load", id="m", path=str(path))
    runner.load(tmp_path / "good.onnx")


def test_strings_cannot_be_sent(runner: Runner, tmp_path: Path) -> None:
    nodes = [helper.make_node("Cast", ["x"], ["y"], to=TensorProto.STRING)]
    ends = [value("x", "int64", [None])], [helper.make_tensor_value_info("y", TensorProto.STRING, [None])]
    runner.load(write_model(tmp_path / "m.onnx", nodes, *ends))
    message = runner.error("run", {"x": np.arange(2)}, id="m")
    assert message == "the output 'y' is of type string, which cannot be sent"


def test_unknown_commands_and_models_are_answered(runner: Runner, tmp_path: Path) -> None:
    assert runner.error("fly") == 'unknown command "fly"'
    assert runner.error("run", {"state": states(1)}, id="nobody") == "no model 'nobody' is loaded"
    assert runner.error("memory") == "onnxruntime-web does not count its memory"
    runner.load(policy(tmp_path / "m.onnx"))
    assert runner.error("load", id="m", path=str(tmp_path / "m.onnx")) == "a model 'm' is loaded already"


# ---- the process -----------------------------------------------------------------------------------------------------


def test_frames_that_cannot_be_followed_end_it_after_a_last_answer() -> None:
    runner = Runner(RUNTIME)
    runner.send(struct.pack("<I", 2**31))
    assert runner.receive()[0]["error"].startswith("lost: ")
    status, out, err = runner.end()
    assert (status, out) == (1, b"")
    assert err.startswith("runner.mjs: ")


def test_requests_may_be_sent_ahead(tmp_path: Path) -> None:
    runner = Runner(RUNTIME)
    data = frame({"cmd": "load", "id": "m", "path": str(policy(tmp_path / "m.onnx"))})
    batches = [states(3, seed) for seed in range(4)]
    runner.send(data + b"".join(frame({"cmd": "run", "id": "m"}, {"state": each}) for each in batches))
    assert runner.receive()[0]["ok"]
    for each in batches:
        np.testing.assert_allclose(runner.receive()[1]["value"], each @ W, rtol=1e-5, atol=1e-5)
    assert runner.end() == (0, b"", "")


def test_a_missing_package_is_an_answer(tmp_path: Path) -> None:
    runner = Runner(RUNTIME, modules=tmp_path)
    assert runner.error("hello") == runner.error("hello") == "Cannot find module 'onnxruntime-web/wasm'"
    assert runner.end()[:2] == (0, b"")


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="memory is read from /proc")
def test_models_that_were_unloaded_do_not_pile_up(tmp_path: Path) -> None:
    weights = {"w": np.ones(10_000_000, np.float32)}
    nodes = [helper.make_node("Gather", ["w", "x"], ["y"])]
    path = write_model(tmp_path / "m.onnx", nodes, [value("x", "int64", [1])], [value("y", "float32", [1])], weights)
    runner = Runner(RUNTIME)

    def resident() -> int:
        """MB of the process."""
        (line,) = (x for x in Path(f"/proc/{runner.process.pid}/status").read_text().splitlines() if "VmRSS" in x)
        return int(line.split()[1]) // 1024

    sizes = []
    for _ in range(10):
        runner.load(path)
        runner.ask("unload", id="m")
        sizes.append(resident())
    assert sizes[-1] - sizes[3] < 100, sizes  # 6 models of 40 MB each, were they kept
    assert runner.end()[0] == 0
