"""Every public and genuine ONNX model: four formats that agree with the file itself, goldens, the frozen graph."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.tolerances import Tolerance
from tests import known
from tests.conftest import NEEDED, Chosen, formats_in
from tests.corpus.conftest import SHARED
from tests.corpus.false_alarms import seed_of
from tests.onnx_reader.models import Bench

pytestmark = [pytest.mark.corpus, pytest.mark.slow, pytest.mark.xdist_group("onnx-corpus")]

CORPUS = sorted(SHARED.glob("corpus/onnx/*.onnx"))
GENUINE = sorted(SHARED.glob("genuine/*/*.onnx"))
ABSENT = [pytest.param(Path("absent"), id="shared-is-absent")]
#: tf2onnx folds x/d to x·(1/d) and 1/3 to a constant, so numbers may differ from TensorFlow's by some units in the
#: last place before the layers amplify them.
CLOSE = Tolerance(1e-5, 1e-5)


@pytest.fixture(autouse=True)
def _shared_data() -> None:
    if not SHARED.is_dir():
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")


def test_nothing_has_fallen_out() -> None:
    assert (len(CORPUS), len(GENUINE)) == (18, 24)


@pytest.mark.parametrize(
    "source",
    [pytest.param(p, id=f"{p.parent.name}-{p.stem}"[:90]) for p in (*CORPUS, *GENUINE)] or ABSENT,
)
def test_exports_to_four_formats_that_agree(source: Path, bench: Bench, tmp_path: Path, runtimes_for: Chosen) -> None:
    for runtime in NEEDED:
        bench.need(runtime)
    runtimes = runtimes_for(known.policies_of(source))
    options = ExportOptions(tmp_path, verify=runtimes, parity=VerifyOptions(seed=seed_of(source)))
    (result,) = export([source], options, pool=bench.pool)
    report = result.report
    assert report is not None
    assert report.passed is True, "\n".join(failure_lines(report))
    assert report.reference == "source/onnxruntime"
    assert {c.runtime for c in report.comparisons} == {"numpy", *runtimes}
    assert {c.format for c in report.comparisons} >= formats_in(runtimes)


def test_what_the_generations_are() -> None:
    families: dict[str, Any] = {}
    for path in CORPUS:
        (policy,) = read_source(path).policies()
        families.setdefault(policy.signature.family, []).append(path.name)
    assert {family: len(names) for family, names in families.items()} == {
        "ML-Agents 0.20-0.22 (PyTorch)": 2,
        "ML-Agents 0.23-0.25 (PyTorch)": 6,
        "ML-Agents 0.24-0.25 (PyTorch)": 2,
        "ML-Agents 0.25 (PyTorch)": 1,
        "ML-Agents 0.26-0.27 (PyTorch)": 4,
        "ML-Agents 0.28-1.1 (PyTorch)": 3,
    }
