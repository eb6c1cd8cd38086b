"""``--batch N``: ONNX and LiteRT files for a fixed number of agents, and what acts with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest

from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.snippets.contract import example_shape, read_bundle
from export_model.signatures.batches import batches_of, put_together, rows_of
from export_model.signatures.errors import UsageError
from fixtures import path
from tests.exporting import load_policy, verify_bundle

Array = npt.NDArray[Any]
FIXED = ("onnxruntime", "litert")


@pytest.fixture(scope="module")
def here(processes: RuntimePool) -> RuntimePool:
    missing = [i for i in available_runtimes() if i.name in FIXED and not i.installed]
    if missing:
        pytest.skip(f"{missing[0].name} is not installed: {missing[0].how}")
    return processes


def dims(file: Path) -> dict[str, list[int]]:
    graph = onnx.load(file).graph
    return {v.name: [d.dim_value for d in v.type.tensor_type.shape.dim] for v in (*graph.input, *graph.output)}


@pytest.mark.parametrize("batch", [1, 5])
@pytest.mark.parametrize("name", ["continuous", "recurrent", "visual", "sampled"])
def test_files_for_so_many_agents_act_as_their_sources(
    name: str, batch: int, tmp_path: Path, here: RuntimePool
) -> None:
    options = ExportOptions(tmp_path, ("bytes", "onnx", "litert"), verify=FIXED, batch=batch)
    (result,) = export([path(name)], options, pool=here)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    found = dims(result.folder / f"{name}.onnx")
    assert {shape[0] for shape in found.values()} == {batch}
    assert json.loads((result.folder / "policy.json").read_text())["tool"]["batch"] == batch
    assert any(f"made for batches of {batch}" in note for note in result.policy.signature.notes)
    assert verify_bundle(result.folder, runtimes=list(FIXED)).passed


def test_both_runtimes_refuse_another_number_of_agents(tmp_path: Path, here: RuntimePool) -> None:
    """So that what is said of the files is true, and a verification that did not cut its inputs would fail."""
    (result,) = export([path("continuous")], ExportOptions(tmp_path, ("onnx", "litert"), verify="none", batch=4))
    import onnxruntime
    from ai_edge_litert.interpreter import Interpreter

    session = onnxruntime.InferenceSession(result.folder / "continuous.onnx", providers=["CPUExecutionProvider"])
    feeds = {"state": np.zeros((3, 8), np.float32), "epsilon": np.zeros((3, 2), np.float32)}
    with pytest.raises(Exception, match="Got: 3 Expected: 4"):
        session.run(None, feeds)
    details = Interpreter(str(result.folder / "continuous.tflite")).get_input_details()
    assert {tuple(d["shape_signature"]) for d in details} == {(4, 8), (4, 2)}


def test_a_loaded_policy_acts_for_any_number_of_agents(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="pip install 'export-model[onnxruntime]'")
    options = ExportOptions(tmp_path, ("bytes", "onnx"), verify="none", batch=4)
    (result,) = export([path("continuous")], options)
    fixed, free = (load_policy(result.folder, runtime=r) for r in ("onnxruntime", "numpy"))
    for agents in (1, 4, 7):
        states = np.random.default_rng(agents).normal(size=(agents, 8)).astype(np.float32)
        ours, theirs = (p.decide(states, deterministic=True).continuous for p in (fixed, free))
        assert ours is not None
        assert theirs is not None
        assert ours.shape == (agents, 2)
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_snippets_feed_as_many_agents_as_the_files_take(tmp_path: Path) -> None:
    (result,) = export([path("continuous")], ExportOptions(tmp_path, ("onnx",), verify="none", batch=6))
    bundle = read_bundle(result.folder)
    assert [example_shape(s) for s in bundle.signature.inputs] == [(6, 8), (6, 2)]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"batch": 0}, "--batch 0"),
        ({"batch": -3}, "--batch -3"),
        ({"batch": 1 << 17}, "--batch 131072"),
        ({"batch": 4, "targets": ("bytes", "tfjs")}, "--batch does not go with --to bytes,tfjs"),
        ({"batch": 4, "profile": "unity6"}, "--batch does not go with --for unity6"),
    ],
)
def test_what_cannot_be_is_refused(asked: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=said):
        list(export([path("continuous")], ExportOptions(tmp_path, verify="none", **asked)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rows", [1, 3, 4, 7, 8])
def test_agents_are_cut_into_batches_and_put_together(rows: int) -> None:
    feeds = {"x": np.arange(rows * 2).reshape(rows, 2), "gain": np.array([3])}
    parts = batches_of(feeds, 4, {"x"})
    assert {part["x"].shape for part in parts} == {(4, 2)}
    assert all(np.array_equal(part["gain"], [3]) for part in parts)
    whole = put_together([{"y": part["x"] * part["gain"]} for part in parts], rows_of(feeds, {"x"}))
    assert np.array_equal(whole["y"], feeds["x"] * 3)
