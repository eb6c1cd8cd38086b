"""How TensorFlow.js reads a signature, and which signatures the runner refuses."""

from __future__ import annotations

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
    twins_by_numpy,
    write_model,
)
from tests.runtimes.pipe import NEEDS_NODE, Runner

pytestmark = NEEDS_NODE


def test_two_keys_on_one_tensor_are_refused(runner: Runner, tmp_path: Path) -> None:
    """tfjs would keep the later key only, and structuredOutputKeys would slip by one."""
    folder = twins(tmp_path)
    outputs = {name: info("out_1:0", "float32", [None, 3]) for name in ("action", "continuous_actions")}
    edit(folder, "signature", "outputs", value=outputs)
    edit(folder, "userDefinedMetadata", "structuredOutputKeys", value=list(outputs))
    message = runner.error("load", id="m", path=str(folder))
    assert "[action,continuous_actions]" in message
    assert "[continuous_actions]" in message


def test_two_outputs_of_one_node_are_refused(runner: Runner, tmp_path: Path) -> None:
    """tfjs would answer the later one under both names."""
    nodes = [
        placeholder("x", "float32", [None, 4]),
        node("cut", "Split", "axis", "x", num_split={"i": "2"}, T={"type": "DT_FLOAT"}),
    ]
    outputs = {name: info(f"cut:{i}", "float32", [None, 2]) for i, name in enumerate(("left", "right"))}
    inputs = {"x": info("x:0", "float32", [None, 4])}
    folder = write_model(tmp_path, nodes, {"axis": np.array(1, np.int32)}, inputs, outputs)
    assert "two keys on one node" in runner.error("load", id="m", path=str(folder))


def test_an_output_whose_node_is_missing_is_refused(runner: Runner, tmp_path: Path) -> None:
    folder = twins(tmp_path)
    edit(folder, "signature", "outputs", "value", "name", value="nowhere:0")
    assert "[action]" in runner.error("load", id="m", path=str(folder))


@pytest.mark.parametrize("keys", [["action", "value"], ["value"], ["value", "action", "more"], ["value", "value"]])
def test_output_keys_that_contradict_the_signature_are_refused(runner: Runner, tmp_path: Path, keys: list[str]) -> None:
    folder = twins(tmp_path)
    edit(folder, "userDefinedMetadata", "structuredOutputKeys", value=keys)
    assert "[value,action]" in runner.error("load", id="m", path=str(folder))


def test_keys_that_look_like_integers_come_first(runner: Runner, tmp_path: Path) -> None:
    """JavaScript sorts them to the front of an object, so the list of keys must have them there too."""
    nodes = [
        placeholder("x", "float32", [None]),
        node("out", "Identity", "x", T={"type": "DT_FLOAT"}),
        node("21", "Square", "x", T={"type": "DT_FLOAT"}),
    ]
    inputs = {"5": info("x:0", "float32", [None])}
    outputs = {"out": info("out:0", "float32", [None]), "21": info("21:0", "float32", [None])}
    folder = write_model(tmp_path, nodes, {}, inputs, outputs)
    assert "[out,21]" in runner.error("load", id="m", path=str(folder))
    edit(folder, "userDefinedMetadata", "structuredOutputKeys", value=["21", "out"])
    runner.load(folder)
    got = runner.run({"5": np.array([3], np.float32)})
    assert {name: value.tolist() for name, value in got.items()} == {"out": [3], "21": [9]}


def test_without_structured_output_keys_the_keys_of_the_signature_name_the_outputs(
    runner: Runner, tmp_path: Path
) -> None:
    folder = twins(tmp_path)
    edit(folder, "userDefinedMetadata", value=None)
    assert [output["name"] for output in runner.load(folder)["outputs"]] == ["value", "action"]
    feeds = batch(2)
    got = runner.run(feeds)
    for name, value in twins_by_numpy(**feeds).items():
        np.testing.assert_allclose(got[name], value, rtol=1e-5, atol=1e-5)


def test_a_signature_without_inputs_leaves_the_names_of_the_placeholders(runner: Runner, tmp_path: Path) -> None:
    """What the official converter writes for a frozen graph."""
    folder = twins(tmp_path)
    edit(folder, "signature", value={"outputs": {"out_1": {"name": "out_1"}, "out_2": {"name": "out_2"}}})
    edit(folder, "userDefinedMetadata", value=None)
    header = runner.load(folder)
    assert header["inputs"] == [
        {"name": "ph_a", "dtype": "float32", "shape": [None, 4]},
        {"name": "ph_b", "dtype": "float32", "shape": [None, 4]},
    ]
    assert header["outputs"] == [{"name": name, "dtype": None, "shape": None} for name in ("out_1", "out_2")]
    feeds = batch(2)
    got = runner.run({"ph_a": feeds["state"], "ph_b": feeds["goal"]})
    np.testing.assert_allclose(got["out_1"], twins_by_numpy(**feeds)["action"], rtol=1e-5, atol=1e-5)
