"""``.nn`` files through the whole pipeline: four formats, compared in the real runtimes (``runtimes_for``)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify.options import VerifyOptions
from tests import known
from tests.barracuda.cases import Case, all_cases
from tests.barracuda.conftest import BROKEN, genuine_files, params, public_files
from tests.barracuda.test_layers import expected_of, feeds_of, policy_of
from tests.conftest import Chosen, formats_in
from tests.corpus.false_alarms import seed_of

pytestmark = pytest.mark.slow

SOURCES = [
    *public_files(),
    *(nn for nn, _, case in genuine_files() if nn.parent.name != BROKEN),
]


@pytest.mark.corpus
@pytest.mark.parametrize("path", params(SOURCES, lambda p: f"{p.parent.name}-{p.name}"[:90]))
def test_a_nn_exports_to_four_formats_that_agree(
    path: Path, shared: Path, tmp_path: Path, pool: RuntimePool, runtimes_for: Chosen
) -> None:
    runtimes = runtimes_for(known.policies_of(path))
    (result,) = export(
        [path], ExportOptions(tmp_path, verify=runtimes, parity=VerifyOptions(seed=seed_of(path))), pool=pool
    )
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert {c.runtime for c in result.report.comparisons} == set(runtimes)  # numpy would be held against itself
    assert {c.format for c in result.report.comparisons} >= formats_in(runtimes)
    assert not result.report.reference.startswith("source/")


# ------------------------------------------------------------------ every kind of layer in every runtime


def groups(cases: list[Case], size: int = 20) -> Iterator[list[Case]]:
    for start in range(0, len(cases), size):
        yield cases[start : start + size]


@pytest.mark.parametrize("cases", [pytest.param(g, id=f"{g[0].name}-to-{g[-1].name}") for g in groups(all_cases())])
def test_every_layer_computes_the_same_in_every_runtime(cases: list[Case], tmp_path: Path, pool: RuntimePool) -> None:
    for case in cases:
        policy = policy_of(case)
        feeds, expected = feeds_of(case, policy), expected_of(case)
        for target, runtime in (
            ("bytes", "tensorflow"),
            ("onnx", "onnxruntime"),
            ("tfjs", "tfjs-cpu"),
            ("tfjs", "tfjs-wasm"),
        ):
            artifact = WRITTEN[target].artifact(policy, WriteOptions("{}"))
            folder = tmp_path / case.name / runtime
            artifact.write(folder)
            model = pool.process(runtime).load(str(folder / artifact.main), kind="graph")
            got: Any = model.run(feeds, ["action"])["action"]
            model.unload()
            np.testing.assert_allclose(
                got, expected, atol=5e-5, rtol=5e-5, err_msg=f"{case.name}: {target} in {runtime}"
            )
