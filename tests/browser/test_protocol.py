"""What a page answers: tensors bit for bit, errors as answers, and what WebGL cannot hold."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from export_model.converters.files.children.process import RunFailedError, RuntimeProcess
from export_model.converters.runtimes.javascript.node import JS_SOURCE
from tests.runtimes.graph_models import CHOICE_FEEDS, batch, choice, info, node, placeholder, twins, twins_by_numpy
from tests.runtimes.graph_models import write_model as write_tfjs

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.xdist_group("browser")]

FLOAT = {"T": {"type": "DT_FLOAT"}}
#: The webgl backend computes on the processor what has fewer than 128 elements.
MANY = 64
ODD = np.array([np.nan, np.inf, -np.inf, -0.0, 1e-45, 3.4e38, 1 / 3], np.float32)


def doubling(folder: Path, dtype: str) -> Path:
    """y = x + x, which every backend has to compute (an Identity might never leave the page's memory)."""
    enum = {"type": {"float32": "DT_FLOAT", "int32": "DT_INT32"}[dtype]}
    nodes = [placeholder("x", dtype, [None]), node("y", "AddV2", "x", "x", T=enum)]
    return write_tfjs(folder, nodes, {}, {"a": info("x:0", dtype, [None])}, {"b": info("y:0", dtype, [None])})


def through(folder: Path) -> Path:
    """An ONNX with an input and an output of each of the dtypes that policies have."""
    kinds = {"f": TensorProto.FLOAT, "i": TensorProto.INT64, "j": TensorProto.INT32, "b": TensorProto.BOOL}
    graph = helper.make_graph(
        [helper.make_node("Identity", [k], [f"{k}_out"]) for k in kinds]
        + [helper.make_node("Add", ["f", "f"], ["f_twice"])],
        "through",
        [helper.make_tensor_value_info(k, t, ["n"]) for k, t in kinds.items()],
        [helper.make_tensor_value_info(f"{k}_out", t, ["n"]) for k, t in kinds.items()]
        + [helper.make_tensor_value_info("f_twice", TensorProto.FLOAT, ["n"])],
    )
    path = folder / "through.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8), path)
    return path


THROUGH: dict[str, Any] = {
    "f": ODD,
    "i": np.array([2**63 - 1, -(2**63), 0, 1, 2, 3, 4], np.int64),
    "j": np.array([2**31 - 1, -(2**31), 0, 1, 2, 3, 4], np.int32),
    "b": np.array([True, False, True, True, False, False, True]),
}


# ---- what a run answers ----------------------------------------------------------------------------------------------


def test_the_version_names_the_package_and_chromium(browser: RuntimeProcess) -> None:
    package = "onnxruntime-web" if browser.name.startswith("onnx") else "@tensorflow/tfjs"
    pinned = json.loads((JS_SOURCE / "package.json").read_text())["dependencies"][package]
    version = browser.start()
    assert version.startswith(f"{pinned} in Chromium 1")
    assert version.endswith(" (SwiftShader)") == (browser.name == "tfjs-webgl")


def test_keys_of_the_signature_feed_and_name_the_right_tensors(tfjs: RuntimeProcess, tmp_path: Path) -> None:
    model = tfjs.load(str(twins(tmp_path, shard_bytes=37)))
    for seed, rows in enumerate((1, 2, 7, 1)):
        feeds = batch(rows, seed)
        for got in (model.predict(feeds, ["value", "action"]), model.run(feeds, ["action", "value", "mm_b"])):
            for name, value in twins_by_numpy(**feeds).items():
                assert (got[name].dtype, got[name].shape) == (np.float32, value.shape)
                np.testing.assert_allclose(got[name], value, rtol=1e-5, atol=1e-5)
    model.unload()


def test_int64_is_narrowed_and_bool_stays_bool(tfjs: RuntimeProcess, tmp_path: Path) -> None:
    model = tfjs.load(str(choice(tmp_path)))
    feeds = {**CHOICE_FEEDS, "prev_action": np.array([[0, -5], [2**24 - 1, -(2**24)], [7, 8]], np.int64)}
    got = model.predict(feeds, ["next", "closed", "deterministic_action"])
    assert {n: a.dtype.name for n, a in got.items()} == {
        "next": "int32",
        "closed": "bool",
        "deterministic_action": "int32",
    }
    np.testing.assert_array_equal(got["next"], feeds["prev_action"] + 1)
    np.testing.assert_array_equal(got["closed"], ~feeds["action_masks"])
    np.testing.assert_array_equal(got["deterministic_action"], [1, 1, 0])
    with pytest.raises(RunFailedError, match="does not fit int32"):
        model.predict({**feeds, "prev_action": np.full((3, 2), 2**31, np.int64)}, ["next"])
    model.unload()


def test_nan_infinity_and_the_edges_of_float32(tfjs: RuntimeProcess, tmp_path: Path) -> None:
    model = tfjs.load(str(doubling(tmp_path, "float32")))
    odd = np.tile(ODD, MANY)
    got = model.predict({"a": odd}, ["b"])["b"]
    with np.errstate(over="ignore"):
        want = odd + odd
    if tfjs.name == "tfjs-webgl":
        want[4 :: ODD.size] = 0.0  # shaders may flush what is below 1.2e-38 to zero, and do
    np.testing.assert_array_equal(got, want)
    assert model.predict({"a": np.zeros(0, np.float32)}, ["b"])["b"].shape == (0,)
    model.unload()


def test_webgl_holds_integers_to_2_24_and_the_others_all(tfjs: RuntimeProcess, tmp_path: Path) -> None:
    """Its textures are floats. No policy has such integers, but a page that multiplies indices may."""
    model = tfjs.load(str(doubling(tmp_path, "int32")))
    values = np.array([2**23, -(2**23), 2**24 + 1, 2**29 + 1], np.int32)
    got = model.predict({"a": np.tile(values, MANY)}, ["b"])["b"]
    exact = got.reshape(MANY, 4) == values + values
    assert exact.all(axis=0).tolist() == [True, True, *([tfjs.name != "tfjs-webgl"] * 2)]
    model.unload()


def test_onnx_keeps_every_dtype_bit_for_bit(onnx_web: RuntimeProcess, tmp_path: Path) -> None:
    model = onnx_web.load(str(through(tmp_path)))
    got = model.run(THROUGH, ["b_out", "f_out", "i_out", "j_out"])
    for name, value in THROUGH.items():
        assert got[f"{name}_out"].dtype == value.dtype
        assert got[f"{name}_out"].tobytes() == value.tobytes()
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(model.run(THROUGH, ["f_twice"])["f_twice"], ODD + ODD)
    model.unload()


def test_megabytes_cross(browser: RuntimeProcess, tmp_path: Path) -> None:
    values = np.random.default_rng(5).standard_normal(1 << 20, np.float32)
    if browser.name.startswith("onnx"):
        rest = {n: np.zeros(1 << 20, THROUGH[n].dtype) for n in "ijb"}
        got = browser.load(str(through(tmp_path))).run({"f": values, **rest}, ["f_twice"])["f_twice"]
    else:
        got = browser.load(str(doubling(tmp_path, "float32"))).predict({"a": values}, ["b"])["b"]
    np.testing.assert_array_equal(got, values + values)


# ---- errors are answers ----------------------------------------------------------------------------------------------


def alive(process: RuntimeProcess) -> None:
    assert process.request({"cmd": "hello"})[0]["version"] == process.version


def test_unknown_commands_models_and_files_are_answered(browser: RuntimeProcess, tmp_path: Path) -> None:
    for header, message in (
        ({"cmd": "fly"}, 'unknown command "fly"'),
        ({"cmd": "start"}, 'unknown command "start"'),  # of the page, not of the protocol
        ({"cmd": "run", "id": "nobody"}, "no model 'nobody' is loaded"),
        ({"cmd": "unload", "id": "nobody"}, "no model 'nobody' is loaded"),
        ({"cmd": "load", "id": "x"}, 'load needs "id" and "path"'),
        ({"cmd": "load", "id": "x", "path": str(tmp_path / "nowhere")}, "ENOENT"),
    ):
        with pytest.raises(RunFailedError) as caught:
            browser.request(header)
        assert message in (caught.value.why or "")
    alive(browser)


def test_what_does_not_fit_is_answered(tfjs: RuntimeProcess, tmp_path: Path) -> None:
    model = tfjs.load(str(twins(tmp_path / "twins")))
    feeds = batch(2)
    for wrong, message in (
        ({**feeds, "goal": np.zeros((2, 5), np.float32)}, r"\[-1,4\]"),
        ({**feeds, "goal": np.zeros((2, 4), np.int32)}, "must be float32, but was int32"),
        ({"state": feeds["state"]}, "ph_b"),
        ({**feeds, "state": np.zeros((2, 4), np.float64)}, "'state' is float64"),
    ):
        with pytest.raises(RunFailedError, match=message):
            model.predict(wrong, ["value", "action"])
    with pytest.raises(RunFailedError, match="nothing"):
        model.run(feeds, ["nothing"])
    with pytest.raises(RunFailedError, match="gave no output 'nothing'"):
        model.predict(feeds, ["value", "nothing"])
    bad = [placeholder("x", "float32", [None]), node("y", "Lgamma", "x", **FLOAT)]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("y:0", "float32", [None])})
    unknown = tfjs.load(str(write_tfjs(tmp_path / "op", bad, {}, *signature)))
    with pytest.raises(RunFailedError, match="Unknown op 'Lgamma'"):
        unknown.predict({"x": np.ones(2, np.float32)}, ["y"])
    unknown.unload()
    assert set(model.predict(feeds, ["value", "action"])) == {"value", "action"}
    model.unload()


def test_damaged_models_are_answered_and_leave_nothing(tfjs: RuntimeProcess, tmp_path: Path) -> None:
    before = tfjs.request({"cmd": "memory"})[0]["numTensors"]
    folder = twins(tmp_path / "cut")
    shard = next(folder.glob("*.bin"))
    shard.write_bytes(shard.read_bytes()[:-4])
    with pytest.raises(RunFailedError, match="should have 3 values but has 2"):
        tfjs.load(str(folder))
    folder = twins(tmp_path / "outside")
    content = json.loads((folder / "model.json").read_text())
    content["weightsManifest"][0]["paths"] = ["../cut/model.json"]
    (folder / "model.json").write_text(json.dumps(content))
    with pytest.raises(RunFailedError, match="lies outside the model's folder"):
        tfjs.load(str(folder))
    assert tfjs.request({"cmd": "memory"})[0]["numTensors"] == before


def test_onnx_that_does_not_fit_is_answered(onnx_web: RuntimeProcess, tmp_path: Path) -> None:
    (tmp_path / "bad.onnx").write_bytes(b"\x08\x08\x12\x01x")
    with pytest.raises(RunFailedError, match="onnxruntime-web@chromium failed"):
        onnx_web.load(str(tmp_path / "bad.onnx"))
    model = onnx_web.load(str(through(tmp_path)))
    with pytest.raises(RunFailedError):
        model.run({**THROUGH, "f": np.zeros((2, 2), np.float32)}, ["f_out"])
    with pytest.raises(RunFailedError, match="nothing"):
        model.run(THROUGH, ["nothing"])
    with pytest.raises(RunFailedError):
        model.run({n: a for n, a in THROUGH.items() if n != "f"}, ["f_out"])
    assert model.run(THROUGH, ["j_out"])["j_out"].dtype == np.int32
    model.unload()


def test_runs_leave_no_tensors_behind(tfjs: RuntimeProcess, tmp_path: Path) -> None:
    count = lambda: tfjs.request({"cmd": "memory"})[0]["numTensors"]  # noqa: E731
    empty = count()
    model = tfjs.load(str(twins(tmp_path)))
    loaded = count()
    assert loaded == empty + 4
    for seed in range(5):
        model.predict(batch(2, seed), ["value", "action"])
        model.run(batch(2), ["mm_a"])
    assert count() == loaded
    model.unload()
    assert count() == empty
