"""OpenVINO as a judge of the ONNX, on request (``pip install 'export-model[openvino]'``)."""

from __future__ import annotations

from pathlib import Path

import pytest

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.pool import RuntimePool, chosen_runtimes
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from fixtures import path

pytestmark = pytest.mark.xdist_group("openvino")


@pytest.fixture(scope="module")
def here(processes: RuntimePool) -> RuntimePool:
    (info,) = (i for i in available_runtimes() if i.name == "openvino")
    if not info.installed:
        pytest.skip(f"openvino is not installed: {info.how}")
    return processes


def test_it_is_asked_only_by_its_name() -> None:
    assert "openvino" in WRITTEN["onnx"].runtimes
    assert "openvino" not in chosen_runtimes("auto", [WRITTEN["onnx"]])[0]


@pytest.mark.parametrize("name", ["continuous", "discrete", "recurrent", "visual"])
def test_fixtures_agree(name: str, tmp_path: Path, here: RuntimePool) -> None:
    (result,) = export([path(name)], ExportOptions(tmp_path, ("onnx",), verify=("openvino",)), pool=here)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert "openvino" in {c.runtime for c in result.report.comparisons}


def test_that_its_own_draws_are_a_note_and_what_is_made_of_them_a_number(tmp_path: Path, here: RuntimePool) -> None:
    """OpenVINO 2026.4 gives Multinomial the same numbers in every call; a session that begins anew does not help."""
    (result,) = export([path("sampled")], ExportOptions(tmp_path, ("onnx",), verify=("openvino",)), pool=here)
    assert result.report is not None
    assert result.report.passed is True
    own = {(c.output, c.kind) for c in result.report.comparisons if c.runtime == "openvino"}
    assert ("action", "numbers") in own
    assert ("action", "draws") not in own
    assert any("the same classes in every call" in note for note in result.report.notes)
