"""Models and feeds that TensorFlow.js cannot run: errors are answers, and the process lives on."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from tests.runtimes.graph_models import (
    batch,
    edit,
    info,
    node,
    placeholder,
    twins,
    write_model,
)
from tests.runtimes.pipe import NEEDS_NODE, Runner

pytestmark = NEEDS_NODE


def test_unknown_commands_and_models_are_answered(runner: Runner) -> None:
    assert runner.error("fly") == 'unknown command "fly"'
    assert "unknown command" in runner.error("toString")
    assert runner.error("run", batch(1), id="nobody") == "no model 'nobody' is loaded"
    assert runner.error("unload", id="nobody") == "no model 'nobody' is loaded"
    assert runner.error("load", id="m") == 'load needs "id" and "path"'


def test_an_id_can_be_loaded_once(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    assert runner.error("load", id="m", path=str(tmp_path)) == "a model 'm' is loaded already"


def test_feeds_that_do_not_fit_are_answered(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    assert "[-1,4]" in runner.error("run", {**feeds, "goal": np.zeros((2, 5), np.float32)}, id="m")
    assert "must be float32, but was int32" in runner.error("run", {**feeds, "goal": np.zeros((2, 4), "i4")}, id="m")
    assert "not part of graph" in runner.error("run", {**feeds, "gaol": feeds["goal"]}, id="m")
    assert runner.run(feeds).keys() == {"value", "action"}


def test_a_dtype_that_is_not_taken_does_not_lose_the_frames(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    message = runner.error("run", {"state": feeds["state"].astype(np.float64), "goal": feeds["goal"]}, id="m")
    assert message == "tensor 'state' is float64; float32, int32, int64 and bool are taken"
    assert runner.run(feeds).keys() == {"value", "action"}


def test_a_header_that_is_no_object_is_answered(runner: Runner) -> None:
    for text in (b"{", b"[1]", b"null", b"7", b""):
        runner.send(struct.pack("<I", len(text)) + text)
        assert runner.receive()[0]["ok"] is False
    assert runner.ask("hello")[0]["ok"]


def test_models_that_cannot_be_loaded_are_answered_and_leave_nothing(runner: Runner, tmp_path: Path) -> None:
    assert "ENOENT" in runner.error("load", id="m", path=str(tmp_path / "nowhere"))

    folder = twins(tmp_path / "cut")
    shard = next(folder.glob("*.bin"))
    shard.write_bytes(shard.read_bytes()[:-4])
    assert "should have 3 values but has 2" in runner.error("load", id="m", path=str(folder))

    folder = twins(tmp_path / "json")
    (folder / "model.json").write_text('{"modelTopology": ')
    assert "JSON" in runner.error("load", id="m", path=str(folder))

    folder = twins(tmp_path / "empty")
    edit(folder, "modelTopology", value=None)
    assert runner.error("load", id="m", path=str(folder)) == "model.json holds no graph (modelTopology.node)"

    folder = twins(tmp_path / "versions")  # a graph frozen by TensorFlow 1.x has none
    edit(folder, "modelTopology", "versions", value=None)
    assert runner.error("load", id="m", path=str(folder)) == "model.json lacks modelTopology.versions"

    folder = write_model(tmp_path / "dangling", [node("y", "Identity", "x")], {}, {}, {})
    assert runner.error("load", id="m", path=str(folder))


@pytest.mark.parametrize("shard", ["../weights.bin", "/weights.bin", "a/../../weights.bin"])
def test_a_shard_stays_inside_the_folder(runner: Runner, tmp_path: Path, shard: str) -> None:
    folder = twins(tmp_path / "model")
    (tmp_path / "weights.bin").write_bytes(next(folder.glob("*.bin")).read_bytes())
    content = json.loads((folder / "model.json").read_text())
    content["weightsManifest"][0]["paths"] = [shard]
    (folder / "model.json").write_text(json.dumps(content))
    assert runner.error("load", id="m", path=str(folder)) == f"the shard {shard} lies outside the model's folder"


def test_an_op_that_tfjs_does_not_know_is_answered_at_the_run(runner: Runner, tmp_path: Path) -> None:
    nodes = [placeholder("x", "float32", [None]), node("y", "Lgamma", "x", T={"type": "DT_FLOAT"})]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("y:0", "float32", [None])})
    runner.load(write_model(tmp_path, nodes, {}, *signature))
    assert "Unknown op 'Lgamma'" in runner.error("run", {"x": np.ones(2, np.float32)}, id="m")


def test_control_flow_is_an_error_because_predict_is_synchronous(runner: Runner, tmp_path: Path) -> None:
    nodes = [
        placeholder("x", "float32", [None]),
        node("enter", "Enter", "x", T={"type": "DT_FLOAT"}),
        node("exit", "Exit", "enter", T={"type": "DT_FLOAT"}),
    ]
    signature = ({"x": info("x:0", "float32", [None])}, {"y": info("exit:0", "float32", [None])})
    runner.load(write_model(tmp_path, nodes, {}, *signature))
    assert "dynamic op 'Exit'" in runner.error("run", {"x": np.ones(2, np.float32)}, id="m")


def test_after_a_trap_of_webassembly_no_answer_is_given(tmp_path: Path) -> None:
    """The wasm backend's Select writes 4 bytes for every bool, here past the end of the memory that it has.

    With fewer elements it spoils its neighbours instead, and answers; nothing can be believed after a trap.
    """
    nodes = [placeholder("x", "bool", [None]), node("y", "SelectV2", "x", "x", "x", T={"type": "DT_BOOL"})]
    signature = ({"x": info("x:0", "bool", [None])}, {"y": info("y:0", "bool", [None])})
    folder = write_model(tmp_path / "select", nodes, {}, *signature)
    runner = Runner("tfjs-wasm")
    runner.load(twins(tmp_path / "good"), "good")
    runner.load(folder)
    for feeds, name in (({"x": np.ones(16_000_000, np.bool_)}, "m"), (batch(1), "good")):
        header, _ = runner.ask("run", feeds, id=name)
        assert not header["ok"]
        assert header["broken"]
        assert header["error"].startswith("WebAssembly broke down, start a new process: ")
    assert runner.end()[:2] == (0, b"")
