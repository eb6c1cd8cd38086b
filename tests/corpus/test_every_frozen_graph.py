"""Every public and genuine frozen graph: four formats, and all agree, in numpy and onnxruntime.

What has an op, a pair of ops or a role that none before had runs in TensorFlow and Node too, the original beside it
(``runtimes_for``); with EXPORT_MODEL_TEST_FULL=1 each file does.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.inspect.inspection import inspect_source
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from tests import known
from tests.conftest import Chosen, formats_in
from tests.corpus.conftest import SHARED, frozen_corpus, genuine_cases
from tests.corpus.false_alarms import genuine_files, seed_of

pytestmark = [pytest.mark.corpus, pytest.mark.slow]

SOURCES = [
    *(pytest.param(p, id=f"corpus-{p.name[:70]}") for p in frozen_corpus()),
    *(pytest.param(f / c["frozen"]["file"], id=f"genuine-{f.name}") for f, c in genuine_cases()),
] or [pytest.param(Path("absent"), id="shared-is-absent")]


@pytest.mark.parametrize("source", SOURCES)
def test_exports_to_four_formats_that_agree(
    source: Path, tmp_path: Path, pool: RuntimePool, runtimes_for: Chosen
) -> None:
    parity = VerifyOptions(seed=seed_of(source))
    runtimes = runtimes_for(known.policies_of(source))
    results = list(export([source], ExportOptions(tmp_path, verify=runtimes, parity=parity), pool=pool))
    assert results
    for result in results:
        assert result.report is not None
        assert result.report.passed is True, "\n".join(failure_lines(result.report))
        assert result.report.reference == ("source/tensorflow" if "tensorflow" in runtimes else "numpy")
        own = {"numpy"} if "tensorflow" in runtimes else set()  # else our kernels would be held against themselves
        assert {c.runtime for c in result.report.comparisons} == {*own, *runtimes}
        assert {c.format for c in result.report.comparisons} >= formats_in(runtimes)
        assert {p.name for p in result.folder.iterdir()} == {
            f"{result.policy.name}.bytes",
            f"{result.policy.name}.onnx",
            "saved_model",
            "tfjs",
            "policy.json",
            "parity.json",
        }


def test_a_nn_in_a_bytes_file_is_named_for_what_it_is_and_exported(tmp_path: Path) -> None:
    source = SHARED / "corpus/bytes/zeroblitz36+ml-agents__3DBallLearning.bytes"
    if not source.is_file():
        pytest.skip("that file is not in ../shared")
    assert inspect_source(source).kind == "a Barracuda .nn model"
    (result,) = export([source], ExportOptions(tmp_path, verify="none"))
    assert [s.name for s in result.policy.signature.inputs] == ["state", "epsilon"]


def test_the_corpus_is_whole() -> None:
    """38 public and 87 genuine frozen graphs, 44 .nn and 24 .onnx: nothing falls out of the tests unseen."""
    assert len(frozen_corpus()) == 38
    assert len(genuine_cases()) == 87
    assert len(genuine_files()) == 155
