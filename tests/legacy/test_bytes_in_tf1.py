"""Every ``.bytes`` that is written loads and runs in the runtimes of TensorFlow 1.4 and 1.7, and agrees.

Agreement is judged by exporter.parity, in which the old runtime takes the place of today's TensorFlow: the same inputs,
tolerances, steps with the memory fed back and draws. The reference is numpy.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from converters.frozen_graph.reader import read_graph
from converters.graph.options import CompileOptions
from converters.runner.process import RunFailedError, RuntimeProcess
from exporter.parity.pool import RuntimePool
from exporter.parity.report import Comparison
from exporter.parity.subject import Subject
from exporter.parity.verify import verify
from exporter.pipeline import ExportOptions, ExportResult, export
from fixtures import FIXTURES, path
from fixtures.goldens import read_npz
from signatures.errors import RuntimeUnavailableError
from tests.corpus.conftest import frozen_corpus, genuine_cases
from tests.legacy.runtime import WHEELS, legacy_process, unsupported_reason

pytestmark = [pytest.mark.legacy, pytest.mark.slow]

SHARED = [
    *(pytest.param(p, id=f"corpus-{p.name[:70]}") for p in frozen_corpus()),
    *(pytest.param(f / c["frozen"]["file"], id=f"genuine-{f.name}") for f, c in genuine_cases()),
] or [pytest.param(Path("absent"), id="shared-is-absent")]


@pytest.fixture(
    scope="module",
    # A group per version: with several test processes, each version is started in one of them only.
    params=[pytest.param(v, id=f"tf{v}", marks=pytest.mark.xdist_group(f"tf{v}")) for v in WHEELS],
)
def legacy(request: pytest.FixtureRequest) -> Iterator[RuntimeProcess]:
    reason = unsupported_reason()
    if reason is not None:
        pytest.skip(reason)
    try:
        process = legacy_process(request.param)
    except RuntimeUnavailableError as error:
        pytest.skip(f"{error.what}: {error.why}")
    with process:
        assert process.start() == request.param
        yield process


@pytest.fixture(scope="module")
def pool(legacy: RuntimeProcess) -> Iterator[RuntimePool]:
    """Processes in which "tensorflow" is the old one."""
    with RuntimePool() as opened:
        opened._processes["tensorflow"] = legacy
        yield opened


def exported(source: Path, out: Path, **options: Any) -> list[ExportResult]:
    return list(export([source], ExportOptions(out, targets=("bytes",), verify="none", **options)))


def compared(result: ExportResult, pool: RuntimePool) -> list[Comparison]:
    file = result.folder / f"{result.policy.name}.bytes"
    subject = Subject(
        name=result.policy.name,
        signature=result.policy.signature,
        graph=result.policy.graph,
        artefacts={"bytes": file},
        sizes=result.sizes,
        reference=file,
    )
    report = verify(subject, ("numpy", "tensorflow"), (), pool)
    return [c for c in report.comparisons if c.runtime == "tensorflow"]


def assert_agrees(source: Path, out: Path, pool: RuntimePool) -> None:
    results = exported(source, out)
    assert results
    for result in results:
        found = compared(result, pool)
        failed = [f"{c.output}, {c.kind}, {c.worst_input}: {c.max_abs_diff} {c.reason}" for c in found if not c.passed]
        assert not failed, "\n".join(failed)
        assert {c.output for c in found} == {s.name for s in result.policy.signature.outputs}
        memory = result.policy.signature.memory
        if memory is not None and memory.output is not None:
            assert "rollout" in {c.kind for c in found}


@pytest.mark.parametrize("name", FIXTURES)
def test_fixtures_agree(name: str, tmp_path: Path, pool: RuntimePool) -> None:
    assert_agrees(path(name), tmp_path, pool)


@pytest.mark.corpus
@pytest.mark.parametrize("source", SHARED)
def test_public_and_genuine_policies_agree(source: Path, tmp_path: Path, pool: RuntimePool) -> None:
    if not source.is_file():
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")
    assert_agrees(source, tmp_path, pool)


@pytest.mark.parametrize("name", FIXTURES)
def test_goldens_come_out_under_the_names_of_the_source(name: str, tmp_path: Path, legacy: RuntimeProcess) -> None:
    """Nodes are found by the trainer's names, as in Unity's plug-in. The goldens are today's TensorFlow's.

    What a sampler drew then is fed in its place.
    """
    goldens = read_npz(path(name).with_suffix(".npz"))
    runs = dict.fromkeys(key.split("/", 1)[0] for key in goldens)
    for result in exported(path(name), tmp_path, compile=CompileOptions(names="source", noise="keep")):
        file = result.folder / f"{result.policy.name}.bytes"
        nodes = {n.name for n in read_graph(file.read_bytes()).nodes}
        model = legacy.load(str(file))
        for run in runs:
            feeds, expected = {}, {}
            for key, value in goldens.items():
                owner, kind, node = key.split("/", 2)
                if owner == run and node in nodes:
                    (expected if kind == "out" else feeds)[node] = value
            assert set(expected) >= {t for t in result.policy.fetches.values() if f"{run}/out/{t}" in goldens}
            for node, value in model.run(feeds, list(expected)).items():
                np.testing.assert_allclose(value, expected[node], rtol=1e-5, atol=1e-5, err_msg=f"{run}/{node}")
        model.unload()


def test_a_newer_graph_is_refused_in_the_words_of_tensorflow(legacy: RuntimeProcess) -> None:
    """The fixture itself, not what is exported from it: it has AddV2, which came between 1.4 and 1.7."""
    if legacy.version == "1.4.0":
        with pytest.raises(RunFailedError, match="Op type not registered 'AddV2'"):
            legacy.load(str(path("discrete")))
    else:
        legacy.load(str(path("discrete"))).unload()


def test_a_run_that_fails_leaves_the_process_at_work(legacy: RuntimeProcess) -> None:
    model = legacy.load(str(path("continuous")))
    feeds = {"state": np.zeros((2, 8), np.float32), "epsilon": np.zeros((2, 2), np.float32)}
    with pytest.raises(RunFailedError, match="You must feed a value for placeholder tensor 'epsilon'"):
        model.run({"state": feeds["state"]}, ["action"])
    with pytest.raises(RunFailedError, match="Expects arg"):
        model.run({**feeds, "state": feeds["state"].astype(np.float64)}, ["action"])
    with pytest.raises(RunFailedError, match="the graph has no tensor 'nothing:1'"):
        model.run(feeds, ["nothing:1"])
    assert model.run(feeds, ["action:0"])["action:0"].shape == (2, 2)
    model.unload()
