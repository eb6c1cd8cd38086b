"""Every ``.bytes`` that is written loads and runs in the runtimes of TensorFlow 1.4 and 1.7, and agrees.

Agreement is judged by exporter/verify, as in ``--verify tf1.4``: its inputs, tolerances, steps with the memory fed back
and draws. The reference is numpy.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.tensorflow.release import RELEASES
from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from export_model.exporter.verify.findings import Finding
from export_model.exporter.verify.participants import PolicyUnderTest
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.verification import verify
from fixtures import FIXTURES, path
from fixtures.goldens import read_npz
from tests import known
from tests.corpus.conftest import frozen_corpus, genuine_cases
from tests.legacy.installed import VERSIONS, ensure

pytestmark = [pytest.mark.legacy, pytest.mark.slow]

SHARED = [
    *(pytest.param(p, id=f"corpus-{p.name[:70]}") for p in frozen_corpus()),
    *(pytest.param(f / c["frozen"]["file"], id=f"genuine-{f.name}") for f, c in genuine_cases()),
] or [pytest.param(Path("absent"), id="shared-is-absent")]


@pytest.fixture(scope="module", params=VERSIONS)
def legacy(request: pytest.FixtureRequest) -> str:
    """The name of the old runtime, installed."""
    return ensure(request.param)


@pytest.fixture(scope="session")
def pool(processes: RuntimePool) -> RuntimePool:
    return processes


def exported(source: Path, out: Path, **options: Any) -> list[ExportResult]:
    return list(export([source], ExportOptions(out, targets=("bytes",), verify="none", **options)))


def compared(result: ExportResult, legacy: Sequence[str], pool: RuntimePool) -> list[Finding]:
    file = result.folder / f"{result.policy.name}.bytes"
    tested = PolicyUnderTest(
        name=result.policy.name,
        signature=result.policy.signature,
        graph=result.policy.graph,
        artefacts={"bytes": file},
        sizes=result.sizes,
        reference=file,
    )
    report = verify(tested, Session(("numpy", *legacy), (), pool))
    return [c for c in report.comparisons if c.runtime in legacy]


def assert_agrees(source: Path, out: Path, legacy: Sequence[str], pool: RuntimePool) -> None:
    results = exported(source, out)
    assert results
    for result in results:
        found = compared(result, legacy, pool)
        failed = [c for c in found if not c.passed]
        lines = [f"{c.runtime}, {c.output}, {c.kind}, {c.worst_input}: {c.max_abs_diff} {c.reason}" for c in failed]
        assert not lines, "\n".join(lines)
        outputs, memory = {s.name for s in result.policy.signature.outputs}, result.policy.signature.memory
        assert {(c.runtime, c.output) for c in found} == set(itertools.product(legacy, outputs))
        if memory is not None and memory.output is not None:
            assert {c.runtime for c in found if c.kind == "rollout"} == set(legacy)


@pytest.mark.parametrize("name", FIXTURES)
def test_fixtures_agree(name: str, tmp_path: Path, legacy: str, pool: RuntimePool) -> None:
    assert_agrees(path(name), tmp_path, [legacy], pool)


@pytest.mark.corpus
@pytest.mark.parametrize("source", SHARED)
def test_public_and_genuine_policies_agree(
    source: Path, tmp_path: Path, pool: RuntimePool, is_new: Callable[[str, Sequence[Policy]], bool]
) -> None:
    """What has nothing new runs in 1.4 alone, which knows fewer ops than 1.7."""
    if not source.is_file():
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")
    releases = RELEASES if is_new("TensorFlow 1", known.policies_of(source)) else RELEASES[:1]
    assert_agrees(source, tmp_path, [ensure(release) for release in releases], pool)


@pytest.mark.parametrize("name", FIXTURES)
def test_goldens_come_out_under_the_names_of_the_source(
    name: str, tmp_path: Path, legacy: str, pool: RuntimePool
) -> None:
    """Nodes are found by the trainer's names, as in Unity's plug-in. The goldens are today's TensorFlow's.

    What a sampler drew then is fed in its place.
    """
    goldens = read_npz(path(name).with_suffix(".npz"))
    runs = dict.fromkeys(key.split("/", 1)[0] for key in goldens)
    for result in exported(path(name), tmp_path, compile=CompileOptions(names="source", noise="keep")):
        file = result.folder / f"{result.policy.name}.bytes"
        nodes = {n.name for n in read_graph(file.read_bytes()).nodes}
        model = pool.process(legacy).load(str(file))
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


def test_the_version_is_what_the_library_says(legacy: str, pool: RuntimePool) -> None:
    pool.process(legacy)
    assert pool.versions()[legacy] == next(r.version for r in RELEASES if r.runtime == legacy)


def test_a_newer_graph_is_refused_in_the_words_of_tensorflow(legacy: str, pool: RuntimePool) -> None:
    """The fixture itself, not what is exported from it: it has AddV2, which came between 1.4 and 1.7."""
    process = pool.process(legacy)
    if legacy == "tf1.4":
        with pytest.raises(RunFailedError, match="Op type not registered 'AddV2'"):
            process.load(str(path("discrete")))
    else:
        process.load(str(path("discrete"))).unload()


def test_a_run_that_fails_leaves_the_process_at_work(legacy: str, pool: RuntimePool) -> None:
    model = pool.process(legacy).load(str(path("continuous")))
    feeds = {"state": np.zeros((2, 8), np.float32), "epsilon": np.zeros((2, 2), np.float32)}
    with pytest.raises(RunFailedError, match="You must feed a value for placeholder tensor 'epsilon'"):
        model.run({"state": feeds["state"]}, ["action"])
    with pytest.raises(RunFailedError, match="Expects arg"):
        model.run({**feeds, "state": feeds["state"].astype(np.float64)}, ["action"])
    with pytest.raises(RunFailedError, match="the graph has no tensor 'nothing:1'"):
        model.run(feeds, ["nothing:1"])
    assert model.run(feeds, ["action:0"])["action:0"].shape == (2, 2)
    model.unload()


def test_what_aborts_there_ends_the_child_and_is_an_answer(legacy: str, tmp_path: Path) -> None:
    """Bytes that are no graph are refused; the process that refused them serves the next model."""
    bad = tmp_path / "bad.bytes"
    bad.write_bytes(b"not a graph" * 9)
    with RuntimePool() as own:
        with pytest.raises(RunFailedError, match="Invalid GraphDef"):
            own.process(legacy).load(str(bad))
        own.process(legacy).load(str(path("continuous"))).unload()


def test_verification_by_name_takes_part_in_an_export(legacy: str, tmp_path: Path) -> None:
    options = ExportOptions(tmp_path, targets=("bytes", "onnx"), verify=legacy)
    (result,) = export([path("continuous")], options)
    assert result.report is not None
    assert result.report.passed
    assert {(c.format, c.runtime) for c in result.report.comparisons} == {("bytes", legacy)}
    assert result.report.runtimes[legacy]["status"] == "ran"
