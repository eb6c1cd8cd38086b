"""Noise that stays in the graph: whether rows share a draw, and calls."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper, numpy_helper

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.checks.draws import NUMBERS_SEEN
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import Feeds
from export_model.exporter.verify.report import ParityReport
from tests.comparing import compare_artefacts
from tests.faults.artefacts import opened
from tests.faults.test_blind_spots import Arrays, verified
from tests.handmade import constant, dense, graph_bytes, node, placeholder

SEEDS = range(9)


def noisy(tmp_path: Path) -> Path:
    """A policy that draws its action around a mean, for each row."""
    nodes = [
        placeholder("vector_observation"),
        *dense("mean", "vector_observation", 3, 2),
        node("size", "Shape", "mean", T=np.float32, out_type=np.int32),
        node("random_normal/RandomStandardNormal", "RandomStandardNormal", "size", dtype=np.float32, T=np.int32),
        constant("spread", np.array([0.5, 0.2], np.float32)),
        node("scaled", "Mul", "random_normal/RandomStandardNormal", "spread", T=np.float32),
        node("action", "Add", "mean", "scaled", T=np.float32),
    ]
    source = tmp_path / "noisy.bytes"
    source.write_bytes(graph_bytes(nodes))
    return source


def exported(tmp_path: Path) -> Path:
    """A bundle with its noise inside."""
    options = ExportOptions(
        tmp_path / "kept",
        targets=("bytes", "onnx"),
        compile=CompileOptions(noise="keep"),
        verify="none",
    )
    (result,) = export([noisy(tmp_path)], options)
    return result.folder


def share_one_draw(model: onnx.ModelProto) -> None:
    """All rows get the draw of the first."""
    graph = model.graph
    sampler = next(n for n in graph.node if n.op_type.startswith("RandomNormal"))
    drawn = sampler.output[0]
    sampler.output[0] = "each"
    graph.initializer.append(numpy_helper.from_array(np.array([0], np.int64), "first"))
    made = [
        helper.make_node("Gather", ["each", "first"], ["row"], axis=0),
        helper.make_node("Sub", ["each", "each"], ["nothing"]),
        helper.make_node("Add", ["nothing", "row"], [drawn]),
    ]
    place = list(graph.node).index(sampler) + 1
    for number, each in enumerate(made):
        graph.node.insert(place + number, each)


def planted(tmp_path: Path) -> Path:
    folder = exported(tmp_path)
    artefact = opened("onnx", folder)
    share_one_draw(artefact.model)  # type: ignore[attr-defined]
    artefact.save()
    return folder


@pytest.mark.parametrize("seed", SEEDS)
def test_one_draw_for_a_whole_batch_is_found_by_verify(seed: int, tmp_path: Path) -> None:
    folder = planted(tmp_path)
    report = verify_folder(folder, source=noisy(tmp_path), runtimes="onnxruntime", options=VerifyOptions(seed=seed))
    assert found(report) == {("onnx", "action")}


@pytest.mark.parametrize("seed", SEEDS)
def test_one_draw_for_a_whole_batch_is_found_by_compare(seed: int, tmp_path: Path, pool: RuntimePool) -> None:
    folder = planted(tmp_path)
    report = compare_artefacts(
        noisy(tmp_path),
        [folder / "noisy.onnx"],
        runtimes="onnxruntime",
        options=VerifyOptions(seed=seed),
        pool=pool,
    )
    assert "action" in {output for _, output in found(report)}


def found(report: ParityReport) -> set[tuple[str, str]]:
    """Formats and outputs that differ where both sides are given the same noise, row for row."""
    return {(f.format, f.output) for f in report.failures if f.kind == "numbers"}


def test_honest_noise_agrees(tmp_path: Path) -> None:
    folder = exported(tmp_path)
    for seed in (0, 1, 2):
        options = VerifyOptions(seed=seed)
        report = verify_folder(folder, source=noisy(tmp_path), runtimes="onnxruntime", options=options)
        assert report.passed is True, [f.explanation() for f in report.failures]


def test_classes_that_every_call_draws_alike_are_met(tmp_path: Path, processes: RuntimePool) -> None:
    kept: dict[tuple[int, bytes], Any] = {}

    def spoil(feeds: Feeds, answers: Arrays) -> Arrays:
        if "action" in answers:
            key = (len(answers["action"]), feeds["state"].tobytes())
            answers["action"] = kept.setdefault(key, answers["action"])
        return answers

    report = verified("sampled", tmp_path, processes, spoil)
    assert [f.output for f in report.failures] == ["action"]
    assert "in every call" in report.failures[0].reason


def test_a_runtime_that_shares_draws_as_the_reference_does_agrees() -> None:
    from export_model.exporter.verify.checks.densities import _shared_otherwise

    rng = np.random.default_rng(0)
    each, other = rng.standard_normal((2, 512, 2))
    one = np.repeat(other[:1], 512, axis=0)
    assert _shared_otherwise(each, other) is None
    assert _shared_otherwise(one, one + 1) is None
    assert "reference draws for each row" in str(_shared_otherwise(each, one))
    assert "each row is drawn for itself" in str(_shared_otherwise(one, each))
    mixed = np.column_stack([other[:, 0], one[:, 1]])
    assert _shared_otherwise(each, mixed) is not None
    saturated = np.where(rng.random((512, 1)) < 0.01, 0.9, 1.0)
    assert _shared_otherwise(saturated, np.ones((512, 1))) is None


def test_what_a_test_of_draws_would_miss_is_said_with_the_verdict(tmp_path: Path, processes: RuntimePool) -> None:
    """A .nn has no place where our kernels can be cut: it is held to a distribution, by how many draws is said."""
    options = ExportOptions(tmp_path / "out", ("nn",), compile=CompileOptions(noise="keep"), verify=("tensorflow",))
    (result,) = export([noisy(tmp_path)], options, pool=processes)
    assert result.report is not None and not [f for f in result.report.failures if f.judges]
    assert {f.kind for f in result.report.comparisons if f.format == "nn"} >= {"draws"}
    (note,) = (n for n in result.report.notes if n.startswith("nn in numpy"))
    assert note.endswith(f"its samplers are not those of the policy: {NUMBERS_SEEN}")
