"""What is made of ONNX models runs in the TensorFlow of 2017 and 2018, which had no attention and no hybrid actions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.children.process import RuntimeProcess
from export_model.converters.formats.frozen_graph.writer import frozen_graph
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.sources import read_source
from export_model.exporter.verify.difference import compare, floor_log_probs
from export_model.exporter.verify.rounding import Rounding
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.roles import Role
from export_model.signatures.sampling import FAR_CASES, draw_cases
from fixtures.sb3 import FOLDER, POLICIES
from tests.corpus.conftest import SHARED
from tests.legacy.installed import VERSIONS, ensure

pytestmark = [pytest.mark.legacy, pytest.mark.slow]

SOURCES = [*(FOLDER / f"{n}.onnx" for n in POLICIES), *sorted(SHARED.glob("corpus/onnx/*.onnx"))]
#: Log-probabilities of classes that are next to impossible follow from differences of large logits.
CLOSE = Tolerance(5e-4, 1e-5)
#: What rounding makes there is measured, as in verification: SoccerTwos has logits of 36,000 for whole numbers, and at
#: the edges of the clip such that a unit in the last place is 2⁻⁹.
_ROUNDED = ("whole numbers", "clip edges")


@pytest.fixture(scope="module", params=VERSIONS)
def legacy(request: pytest.FixtureRequest, processes: RuntimePool) -> RuntimeProcess:
    return processes.process(ensure(request.param))


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.stem[:80])
def test_runs_there_and_agrees(source: Path, legacy: RuntimeProcess, tmp_path: Path) -> None:
    (policy,) = read_source(source).policies()
    path = tmp_path / "policy.bytes"
    frozen_graph(policy).write(path)
    model = legacy.load(str(path))
    outputs = [s for s in policy.signature.outputs if s.role is not Role.SAMPLED]
    rounding = Rounding(0, [s.name for s in outputs], dict)
    for case in draw_cases(policy.signature):
        if case.name in FAR_CASES:
            continue
        names = [s.name for s in outputs]
        got, wanted = model.run(case.feeds, names), run_graph(policy.graph, case.feeds, names)
        for spec in outputs:
            pair = [wanted[spec.name], got[spec.name]]
            if spec.role is Role.LOG_PROBS:
                pair = [floor_log_probs(a, policy.signature.branches) for a in pair]
            if pair[0].dtype.kind == "f":
                bounds = (
                    rounding.inner(legacy.name, policy.graph, case.feeds, spec.name) if case.name in _ROUNDED else None
                )
                difference = compare(*pair, CLOSE, rounding=bounds)
                assert difference.passed, f"{case.name}: {spec.name}: {difference}"
                if bounds is not None and np.abs(pair[0]).max() > 1:
                    assert not compare(pair[0], pair[0] * 0, CLOSE, rounding=bounds).passed
            else:  # a tie may fall either way
                assert np.mean(pair[0] == pair[1]) > 0.8
    model.unload()
