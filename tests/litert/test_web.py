"""Files for one agent in LiteRT.js, in Chromium: they act as their sources do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.children.process import RunFailedError
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from export_model.exporter.reports.summary import failure_lines
from fixtures import FIXTURES, path
from tests import known
from tests.conftest import Chosen
from tests.exporting import verify_bundle
from tests.litert.sweep import WEB, agents
from tests.onnx_reader.models import floats, model, node, save

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.xdist_group("browser")]


@pytest.fixture(scope="module")
def page() -> Iterator[RuntimePool]:
    info = next(i for i in available_runtimes() if i.name == WEB)
    if not info.installed:
        pytest.skip(f"{WEB} is not installed: {info.how}")
    with RuntimePool() as pool:
        yield pool


def exported(source: Path, folder: Path, pool: RuntimePool, batch: int | None = 0) -> list[ExportResult]:
    """For one agent; where classes are drawn, which takes thousands of runs of one, for several."""
    batch = agents(source) if batch == 0 else batch
    return list(export([source], ExportOptions(folder, ("litert",), verify=(WEB,), batch=batch), pool=pool))


@pytest.mark.parametrize("name", FIXTURES)
def test_fixtures_agree_under_both_signatures(name: str, tmp_path: Path, page: RuntimePool) -> None:
    for result in exported(path(name), tmp_path, page):
        report = result.report
        assert report is not None
        assert report.passed is True, "\n".join(failure_lines(report))
        assert {c.format for c in report.comparisons if c.runtime == WEB} == {"litert", "litert:deterministic"}
        assert " in Chromium " in str(report.runtimes[WEB]["version"])


def test_files_for_any_number_of_agents_are_not_given_to_it(tmp_path: Path, page: RuntimePool) -> None:
    """LiteRT.js refuses them, so no verdict may rest on it; the report says why it did not run."""
    (result,) = exported(path("continuous"), tmp_path, page, batch=None)
    assert result.report is not None
    assert result.report.passed is None
    assert "--batch" in str(result.report.runtimes[WEB]["reason"])
    file = result.folder / "continuous.tflite"
    model = page.process(WEB).load(str(file), kind="litert", signature="deterministic")
    with pytest.raises(RunFailedError) as caught:
        model.run({"state": np.zeros((1, 8), np.float32)}, ["deterministic_action"])
    model.unload()
    assert "does not match expected ranked tensor type Float32[-1, 8]" in str(caught.value)


def test_a_bundle_is_verified_again_and_several_agents_are_cut_up(tmp_path: Path, page: RuntimePool) -> None:
    options = ExportOptions(tmp_path, ("bytes", "litert"), verify=(WEB,), batch=3)
    (result,) = export([path("recurrent")], options, pool=page)
    assert result.report is not None and result.report.passed
    assert verify_bundle(result.folder, runtimes=[WEB]).passed


def test_a_policy_that_is_fed_other_dtypes_is_not_given_to_it(tmp_path: Path, page: RuntimePool) -> None:
    """Four of 449 policies at hand are fed truths or int64, which LiteRT has and LiteRT.js has not."""
    nodes = [
        node("Cast", ["flags"], "numbers", to=1),
        node("MatMul", ["numbers", "w"], "h"),
        node("Tanh", ["h"], "action"),
    ]
    fed, given = {"flags": (np.bool_, ["batch", 4])}, {"action": (np.float32, ["batch", 2])}
    source = save(model(nodes, fed, given, {"w": floats(4, 2)}), tmp_path)
    (result,) = export([source], ExportOptions(tmp_path, ("litert",), verify=(WEB, "litert"), batch=1), pool=page)
    assert result.report is not None
    assert result.report.passed, "\n".join(failure_lines(result.report))
    assert {c.runtime for c in result.report.comparisons if c.format == "litert"} == {"litert"}
    assert result.report.runtimes[WEB]["reason"] == "has no tensors of bool, as the input state is"


@pytest.mark.corpus
@pytest.mark.parametrize("source", known.params(known.sources()[::48]))
def test_a_sample_of_policies_agrees(source: Path, tmp_path: Path, page: RuntimePool, is_new: Chosen) -> None:
    """``python -m tests.figures --litert-web`` runs all of them, for an hour."""
    if not is_new(WEB, known.policies_or_skip(source)):  # type: ignore[call-arg, arg-type]
        return
    for result in exported(source, tmp_path, page):
        assert result.report is not None
        assert result.report.passed is True, "\n".join(failure_lines(result.report))
