"""What a run of a TensorFlow.js graph model answers, all of it or some outputs, and what it leaves in memory."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.runtimes.javascript.node import JS_SOURCE
from tests.runtimes.graph_models import (
    B2,
    CHOICE_FEEDS,
    W2,
    batch,
    choice,
    info,
    node,
    placeholder,
    twins,
    twins_by_numpy,
    write_model,
)
from tests.runtimes.pipe import NEEDS_NODE, Runner

pytestmark = NEEDS_NODE


def test_hello_names_runtime_and_version(shared: Runner) -> None:
    header, _ = shared.ask("hello")
    pinned = json.loads((JS_SOURCE / "package.json").read_text())["dependencies"]["@tensorflow/tfjs"]
    assert header["ok"]
    assert header["version"] == pinned
    assert header["runtime"] in ("tfjs-cpu", "tfjs-wasm")


def test_load_describes_the_signature(runner: Runner, tmp_path: Path) -> None:
    header = runner.load(choice(tmp_path))
    assert header["inputs"] == [
        {"name": "prev_action", "dtype": "int64", "shape": [None, 2]},
        {"name": "action_masks", "dtype": "bool", "shape": [None, 2]},
        {"name": "state", "dtype": "float32", "shape": [None, 2]},
    ]
    assert header["outputs"] == [
        {"name": "next", "dtype": "int64", "shape": [None, 2]},
        {"name": "closed", "dtype": "bool", "shape": [None, 2]},
        {"name": "deterministic_action", "dtype": "int64", "shape": [None]},
    ]


def test_keys_of_the_signature_feed_and_name_the_right_tensors(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    for seed, rows in enumerate((1, 2, 7, 1, 64)):
        feeds = batch(rows, seed)
        got = runner.run(feeds)
        want = twins_by_numpy(**feeds)
        assert list(got) == ["value", "action"]
        for name, value in want.items():
            assert got[name].dtype == np.float32
            assert got[name].shape == value.shape
            np.testing.assert_allclose(got[name], value, rtol=1e-5, atol=1e-5)


def test_the_order_of_the_feeds_does_not_matter(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(3)
    there, back = runner.run(feeds), runner.run(dict(reversed(feeds.items())))
    for name, value in there.items():
        np.testing.assert_array_equal(back[name], value)


def test_int64_is_narrowed_and_bool_stays_bool(runner: Runner, tmp_path: Path) -> None:
    runner.load(choice(tmp_path))
    got = runner.run(CHOICE_FEEDS)
    assert {name: value.dtype for name, value in got.items()} == {
        "next": np.dtype(np.int32),
        "closed": np.dtype(np.bool_),
        "deterministic_action": np.dtype(np.int32),
    }
    np.testing.assert_array_equal(got["next"], CHOICE_FEEDS["prev_action"] + 1)
    np.testing.assert_array_equal(got["closed"], ~CHOICE_FEEDS["action_masks"])
    np.testing.assert_array_equal(got["deterministic_action"], [1, 1, 0])


@pytest.mark.parametrize("value", [2**31, -(2**31) - 1, 2**63 - 1])
def test_an_int64_that_does_not_fit_is_an_error(runner: Runner, tmp_path: Path, value: int) -> None:
    runner.load(choice(tmp_path))
    feeds = {**CHOICE_FEEDS, "prev_action": np.full((3, 2), value, np.int64)}
    assert runner.error("run", feeds, id="m") == f"tensor 'prev_action': {value} does not fit int32"
    assert set(runner.run(CHOICE_FEEDS)) == {"next", "closed", "deterministic_action"}


def test_every_float_arrives_bit_for_bit(runner: Runner, tmp_path: Path) -> None:
    nodes = [placeholder("x", "float32", [None]), node("y", "Identity", "x", T={"type": "DT_FLOAT"})]
    signature = ({"a": info("x:0", "float32", [None])}, {"b": info("y:0", "float32", [None])})
    runner.load(write_model(tmp_path, nodes, {}, *signature))
    values = np.array([np.nan, np.inf, -np.inf, -0.0, 1e-45, 3.4e38, 1 / 3], np.float32)
    assert runner.run({"a": values})["b"].tobytes() == values.tobytes()
    assert runner.run({"a": np.zeros(0, np.float32)})["b"].shape == (0,)


def test_weights_may_lie_in_several_shards(runner: Runner, tmp_path: Path) -> None:
    folder = twins(tmp_path, shard_bytes=37)  # cuts through the elements
    assert len(list(folder.glob("*.bin"))) == 4
    runner.load(folder)
    feeds = batch(2)
    for name, value in twins_by_numpy(**feeds).items():
        np.testing.assert_allclose(runner.run(feeds)[name], value, rtol=1e-5, atol=1e-5)


def test_two_models_do_not_disturb_each_other(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path / "a"))
    runner.load(choice(tmp_path / "b"), "other")
    feeds = batch(2)
    before = runner.run(feeds)
    runner.run(CHOICE_FEEDS, "other")
    runner.ask("unload", id="other")
    np.testing.assert_array_equal(runner.run(feeds)["action"], before["action"])


def test_fetch_gives_these_outputs_in_this_order(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    want = twins_by_numpy(**feeds)
    for names in (["action"], ["value"], ["action", "value"]):
        got = runner.run(feeds, fetch=names)
        assert list(got) == names
        for name in names:
            np.testing.assert_allclose(got[name], want[name], rtol=1e-5, atol=1e-5)


def test_fetch_needs_only_the_inputs_that_these_outputs_need(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    got = runner.run({"state": feeds["state"]}, fetch=["value"])
    np.testing.assert_allclose(got["value"], twins_by_numpy(**feeds)["value"], rtol=1e-5, atol=1e-5)
    assert "[ph_b]" in runner.error("run", {"state": feeds["state"]}, id="m")


def test_fetch_reaches_inner_nodes(runner: Runner, tmp_path: Path) -> None:
    runner.load(twins(tmp_path))
    feeds = batch(2)
    got = runner.run(feeds, fetch=["mm_b", "sum_b:0", "action"])
    np.testing.assert_allclose(got["mm_b"], feeds["goal"] @ W2, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(got["sum_b:0"], feeds["goal"] @ W2 + B2, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("fetch", [[], "action", ["nothing"]])
def test_a_bad_fetch_is_an_error(runner: Runner, tmp_path: Path, fetch: Any) -> None:
    runner.load(twins(tmp_path))
    assert runner.error("run", batch(1), id="m", fetch=fetch)


def test_runs_leave_no_tensors_behind(runner: Runner, tmp_path: Path) -> None:
    empty = runner.tensors_alive()
    runner.load(twins(tmp_path))
    loaded = runner.tensors_alive()
    assert loaded == empty + 4
    for seed in range(20):
        runner.run(batch(1 + seed % 3, seed))
        runner.run(batch(1), fetch=["value", "mix"])
        runner.error("run", {"state": np.zeros((1, 5), np.float32)}, id="m")
    assert runner.tensors_alive() == loaded
    assert runner.ask("unload", id="m")[0] == {"ok": True}
    assert runner.tensors_alive() == empty


def test_an_output_that_is_a_weight_or_an_input_survives_the_run(runner: Runner, tmp_path: Path) -> None:
    nodes = [placeholder("x", "float32", [None]), node("w_out", "Identity", "w", T={"type": "DT_FLOAT"})]
    signature = (
        {"x": info("x:0", "float32", [None])},
        {"size": info("w:0", "float32", [2]), "copy": info("w_out:0", "float32", [2])},
    )
    runner.load(write_model(tmp_path, nodes, {"w": np.array([3, 4], np.float32)}, *signature))
    for _ in range(3):
        got = runner.run({"x": np.ones(2, np.float32)})
        assert got["size"].tolist() == got["copy"].tolist() == [3, 4]
        assert runner.run({"x": np.ones(2, np.float32)}, fetch=["x", "w"])["x"].tolist() == [1, 1]
