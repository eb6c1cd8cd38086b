"""The checkpoints of ../shared: golden values, the frozen graphs beside them, the originals restored by TensorFlow."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_cases
from tests.conftest import Chosen
from tests.corpus.conftest import SHARED

pytestmark = pytest.mark.corpus

ABSENT = [pytest.param(Path("absent"), id="shared-is-absent")]


def indexes(folder: str) -> list[Path]:
    return sorted(SHARED.glob(f"{folder}/*/*.index"))


def params(found: list[Path]) -> list[Any]:
    return [pytest.param(p, id=p.parent.name[:60]) for p in found] or ABSENT


#: Folders whose frozen graphs are of another training than the checkpoint.
OTHERS = ("ml-agents0.3_python_models_ppo-48fab8",)


@pytest.fixture(autouse=True)
def _shared_data() -> None:
    if not SHARED.is_dir():
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")


def options_for(path: Path) -> CompileOptions:
    """The DQN of a fork has two networks, and no node called action."""
    return CompileOptions(outputs={"best_action": Role.ACTION} if "_dqn-" in path.parent.name else {})


def test_none_is_missing() -> None:
    assert (len(indexes("corpus/ckpt")), len(indexes("genuine"))) == (9, 40)


def frozen_beside(index: Path) -> Path | None:
    folder = index.parent
    if any(name in folder.name for name in OTHERS):
        return None
    found = sorted([*folder.glob("frozen_graph_def.pb"), *folder.glob("*.bytes")])
    return found[-1] if found else None  # of two, UFOGridWorld2.bytes is of another training


PAIRS = [p for p in [*indexes("genuine"), *indexes("corpus/ckpt")] if frozen_beside(p) is not None]


@pytest.mark.parametrize("index", params(PAIRS))
def test_the_frozen_graph_beside_it_computes_the_same(index: Path) -> None:
    other = frozen_beside(index)
    assert other is not None
    policies = read_source(index).policies(options_for(index))
    frozen = read_source(other).policies()
    assert len(policies) == len(frozen)
    for one, two in zip(policies, frozen, strict=True):
        mine, theirs = one.signature, two.signature
        assert [s.to_dict() for s in mine.inputs] == [s.to_dict() for s in theirs.inputs]
        assert {s.name: s.role for s in mine.outputs} == {s.name: s.role for s in theirs.outputs}
        assert (mine.family, mine.constants, mine.branches) == (theirs.family, theirs.constants, theirs.branches)
        names = [s.name for s in mine.outputs if s.role is not Role.SAMPLED]
        for case in draw_cases(mine, seed=3, samples=2):
            got, wanted = (run_graph(p.graph, case.feeds, names) for p in (one, two))
            for name in names:
                np.testing.assert_allclose(got[name], wanted[name], rtol=1e-6, atol=1e-6, err_msg=name)


def test_the_case_that_the_trainer_could_not_export() -> None:
    """0.3.0, behavioural cloning, discrete: "action is not in graph"."""
    folder = SHARED / "genuine/0.3.0-bc-discrete"
    case = json.loads((folder / "case.json").read_text())
    assert case["export_error"] == "AssertionError: action is not in graph"
    (policy,) = read_source(folder).policies()
    assert policy.name == "0.3.0-bc-discrete"
    assert policy.signature.output("action").role is Role.SAMPLED


@pytest.mark.slow
@pytest.mark.parametrize("index", params([*indexes("genuine"), *indexes("corpus/ckpt")]))
def test_agrees_in_the_runtimes_with_the_restored_original(
    index: Path,
    tmp_path: Path,
    pool: RuntimePool,
    runtimes_for: Chosen,
) -> None:
    runtimes = runtimes_for(read_source(index).policies(options_for(index)))
    for result in export([index], ExportOptions(tmp_path, compile=options_for(index), verify=runtimes), pool=pool):
        assert result.report is not None
        assert result.report.passed is True, "\n".join(failure_lines(result.report))
        assert result.report.reference == ("source/tensorflow" if "tensorflow" in runtimes else "numpy")
        own = {"numpy"} if "tensorflow" in runtimes else set()  # else our kernels would be held against themselves
        assert {c.runtime for c in result.report.comparisons} == {*own, *runtimes}
