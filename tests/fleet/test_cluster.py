"""A Dask cluster on this machine: a scheduler and two workers as processes, one of them killed midway."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from export_model.exporter.export.names import Claim
from export_model.exporter.export.pipeline import ExportOptions
from export_model.exporter.fleet import cluster as fleet_cluster
from export_model.exporter.fleet.fleet import export_fleet
from export_model.exporter.fleet.outcome import Outcome
from export_model.exporter.fleet.worker import Wanted
from export_model.signatures.errors import RuntimeUnavailableError
from fixtures import path as fixture
from tests.commands import PYTHONPATH, export_model
from tests.fleet.test_fleet import contents, lines

distributed = pytest.importorskip("distributed")

pytestmark = pytest.mark.runtimes

NAMES = ("continuous", "discrete", "twobrains", "recurrent")
#: Four sources each, which are five policies; 400 are the 2,000 that docs/figures.md tells of.
COPIES = int(os.environ.get("EXPORT_MODEL_TEST_COPIES", "6"))


@pytest.fixture
def sources(tmp_path: Path) -> list[Path]:
    """Policies of the same names in many folders, and one that is none."""
    for number in range(COPIES):
        folder = tmp_path / f"run{number:02}"
        folder.mkdir()
        for name in NAMES:
            shutil.copy(fixture(name), folder)
    (tmp_path / "run03" / "broken.bytes").write_bytes(fixture("discrete").read_bytes()[:-700])
    return sorted(tmp_path.glob("run*/*.bytes"))


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """The scheduler's address, and its workers."""
    place = tmp_path / "scheduler.json"
    environment = {**os.environ, "PYTHONPATH": PYTHONPATH, "DASK_DISTRIBUTED__WORKER__DAEMON": "false"}
    log = (tmp_path / "dask.log").open("wb")

    def start(*arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "dask", *arguments, "--no-dashboard", "--scheduler-file", str(place)]
        return subprocess.Popen(command, env=environment, cwd=tmp_path, stdout=log, stderr=log)

    scheduler = start("scheduler", "--host", "127.0.0.1", "--port", "0")
    workers = [start("worker", "--host", "127.0.0.1", "--nthreads", "1", "--no-nanny") for _ in range(2)]
    try:
        deadline = time.monotonic() + 600
        while not place.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        with distributed.Client(scheduler_file=str(place), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=600)
            address = client.scheduler.address
        yield address, workers
    finally:
        for process in (*workers, scheduler):  # one by one: Dask's worker hangs where its scheduler ends meanwhile
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        log.close()


def test_a_worker_is_killed(
    sources: list[Path], cluster: tuple[str, list[subprocess.Popen[bytes]]], tmp_path: Path
) -> None:
    address, workers = cluster
    one = list(export_fleet(sources, ExportOptions(tmp_path / "one", verify="none")))
    made = []
    for outcome in export_fleet(sources, ExportOptions(tmp_path / "many", verify="none"), cluster=address):
        made.append(outcome)
        if len(made) == len(sources) // 2:
            os.kill(workers[0].pid, signal.SIGKILL)
    assert workers[0].wait() == -signal.SIGKILL
    assert [o.path.name for o in made if o.error is not None] == ["broken.bytes"]
    assert Counter(o.path for o in made) == Counter(o.path for o in one) == Counter(sources)
    written = Counter(p.name for o in made for p in o.policies)
    assert written == Counter(p.name for o in one for p in o.policies)
    assert set(written.values()) == {1}
    assert contents(tmp_path / "many") == contents(tmp_path / "one")
    assert len({e["source"] for e in lines(tmp_path / "many" / ".exported.jsonl")}) == len(sources) - 1
    assert len((tmp_path / "many" / ".exported.jsonl").read_text().splitlines()) == len(sources) - 1
    ran = export_model(*sources[:2], "-o", tmp_path / "again", "--cluster", address, "--verify", "onnxruntime")
    assert ran.status == 0, ran.err
    assert "(2 verified)" in ran.out


def test_a_scheduler_that_ends(
    sources: list[Path], cluster: tuple[str, list[subprocess.Popen[bytes]]], tmp_path: Path
) -> None:
    address, _ = cluster
    with distributed.Client(address, set_as_default=False) as client:
        scheduler = client.run_on_scheduler(os.getpid)
    options, made = ExportOptions(tmp_path / "many", verify="none"), []
    with pytest.raises(RuntimeUnavailableError, match=f"the cluster at {address} was lost"):
        for outcome in export_fleet(sources, options, cluster=address):
            made.append(outcome.path)
            if len(made) == 2:
                os.kill(scheduler, signal.SIGKILL)
    rest = list(export_fleet(sources, options))
    assert {o.path for o in rest if o.unchanged} == set(made)


def test_two_runs_leave_each_other_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(distributed, "get_worker", lambda: SimpleNamespace(address="here"))
    monkeypatch.setattr(fleet_cluster, "_states", {})
    begun: list[Path] = []
    closed: list[str] = []
    real, close = fleet_cluster.export_source, fleet_cluster._WorkerState._close

    def counted(exporter: Any, path: Path, *more: Any) -> Outcome:
        begun.append(path)
        return real(exporter, path, *more)

    monkeypatch.setattr(fleet_cluster, "export_source", counted)
    monkeypatch.setattr(fleet_cluster._WorkerState, "_close", lambda s: (closed.append(s.run.identity), close(s)))
    source = fixture("discrete")
    a, b, c = (fleet_cluster.Run(n, ExportOptions(tmp_path / n, verify="none"), Wanted()) for n in "abc")
    for run in (a, b):
        assert isinstance(fleet_cluster.compile_task(run, source)[1], Claim)
    for run in (a, b):
        assert fleet_cluster.finish_task(run, source, [("discrete", None)]).error is None
    assert (len(begun), closed) == (2, [])
    monkeypatch.setattr(fleet_cluster, "_FORGOTTEN", -1)
    with fleet_cluster._state_of(b).hold_lock():  # it is at work
        fleet_cluster._state_of(c)
        assert closed == ["a"]
        fleet_cluster.shutdown("b")
        assert closed == ["a"]
    assert closed == ["a", "b"]


@pytest.mark.parametrize("scheme", ["tcp", "tls"])
def test_a_scheduler_that_is_not_there(scheme: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fleet_cluster, "_PATIENCE", 0.5)
    with pytest.raises(RuntimeUnavailableError, match="no scheduler answers"):
        list(export_fleet([fixture("discrete")], ExportOptions(tmp_path), cluster=f"{scheme}://127.0.0.1:9"))
