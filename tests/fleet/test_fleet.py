"""Many sources: the same bytes by any number of processes; unchanged ones left out; what dies or is refused is told."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from export_model import export
from export_model.converters.formats.bundle import bundle, exchange
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.exporter.cli.fleet import _Tally
from export_model.exporter.export.names import Claim, Names, Turns
from export_model.exporter.export.pipeline import Exporter, ExportOptions
from export_model.exporter.fleet import batch, fleet
from export_model.exporter.fleet.fleet import export_fleet
from export_model.exporter.fleet.marks import mark, read_key
from export_model.exporter.fleet.outcome import Outcome
from export_model.exporter.fleet.worker import Wanted
from export_model.signatures.errors import UsageError
from fixtures import path as fixture
from fixtures.trained import run_folder
from tests.commands import export_model, python

NAMES = ("continuous", "discrete", "twobrains", "visual")


@pytest.fixture
def sources(tmp_path: Path) -> list[Path]:
    """Policies of the same names in two folders, and one that is none."""
    paths = []
    for folder in ("a", "b"):
        for name in NAMES:
            path = tmp_path / folder / f"{name}.bytes"
            path.parent.mkdir(exist_ok=True)
            shutil.copy(fixture(name), path)
            paths.append(path)
    (tmp_path / "a" / "broken.bytes").write_bytes(fixture("discrete").read_bytes()[:-700])
    paths.insert(2, tmp_path / "a" / "broken.bytes")
    return paths


def contents(folder: Path) -> Mapping[str, bytes]:
    files = (p for p in folder.rglob("*") if p.is_file() and p.name != ".exported.jsonl")
    return {str(p.relative_to(folder)): p.read_bytes() for p in files}


def run(sources: list[Path], out: Path, jobs: int = 1, **more: bool) -> dict[str, Outcome]:
    options = ExportOptions(out, verify="none")
    return {str(o.path): o for o in export_fleet(sources, options, jobs=jobs, **more)}  # type: ignore[arg-type]


def test_what_is_written_does_not_depend_on_the_number_of_processes(sources: list[Path], tmp_path: Path) -> None:
    one, three = run(sources, tmp_path / "one"), run(sources, tmp_path / "three", jobs=3)
    assert contents(tmp_path / "one") == contents(tmp_path / "three")
    assert one.keys() == three.keys() == set(map(str, sources))
    refused = [o for o in three.values() if o.error is not None]
    assert [o.path.name for o in refused] == ["broken.bytes"]
    names = [p.name for o in three.values() for p in o.policies]
    assert len(names) == len(set(names)) == 10
    assert "a-continuous" not in names  # the first in order has the plain name, whoever is quicker
    assert {"continuous", "b-continuous"} < set(names)


@pytest.mark.parametrize("kind", ["files", "folders", "run"])
def test_a_folder_is_exported_the_same_way_whatever_jobs_say(kind: str, sources: list[Path], tmp_path: Path) -> None:
    """The bytes, what is recorded, and by Python, too; another file in the folder changes nothing for the others."""
    folder = {"files": tmp_path / "a", "folders": tmp_path / "made", "run": run_folder("3DBall")}[kind]
    sources[2].unlink()  # the broken one
    for place in ("one", "two/three"):
        shutil.copytree(tmp_path / "b", tmp_path / "made" / place)
    found = {}
    for jobs in ([], ["--jobs", "1"], ["--jobs", "2"]):
        out = tmp_path / f"out{len(found)}"
        assert export_model(folder, "-o", out, "--verify", "none", *jobs).status == 0
        ledger = out / ".exported.jsonl"
        found[" ".join(jobs)] = contents(out), sorted(lines_of(ledger))
    assert found[""] == found["--jobs 1"] == found["--jobs 2"]
    bundles, recorded = found[""]
    assert len(recorded) == {"files": 4, "folders": 8, "run": 0}[kind]  # a run is one source, as a file is
    export(folder, tmp_path / "python", verify="none")
    assert contents(tmp_path / "python") == bundles
    if kind != "run":
        shutil.copy(fixture("recurrent"), folder / "recurrent.bytes")
        assert export_model(folder, "-o", tmp_path / "more", "--verify", "none").status == 0
        more = contents(tmp_path / "more")
        assert {name: more[name] for name in bundles} == bundles
        assert "recurrent/recurrent.bytes" in more


def lines_of(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


def test_what_is_unchanged_is_left_out(sources: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(sources, out, jobs=2)
    before = contents(out)
    again = run(sources, out)
    assert [o.path.name for o in again.values() if not o.unchanged] == ["broken.bytes"]  # which may have been mended
    os.utime(sources[0])  # touched, not changed
    shutil.copy(fixture("recurrent"), sources[1])
    shutil.rmtree(out / "b-visual")
    third = run(sources, out)
    done = {o.path for o in third.values() if not o.unchanged and o.error is None}
    assert done == {sources[1], sources[-1]}
    assert contents(out).keys() == before.keys()
    assert not any(o.unchanged for o in run(sources, out, again=True).values())
    other = export_fleet(sources, ExportOptions(out, verify="none", targets=("onnx",)))
    assert not any(o.unchanged for o in other)


def test_a_bundle_that_was_changed_is_exported_again(tmp_path: Path) -> None:
    """Any file of it, not its contract alone."""
    out = tmp_path / "out"
    run([fixture("continuous")], out)
    whole = contents(out)
    model = out / "continuous" / "continuous.onnx"
    model.write_bytes(model.read_bytes()[:-1] + b"x")
    (second,) = run([fixture("continuous")], out).values()
    assert not second.unchanged
    assert contents(out) == whole


@pytest.mark.parametrize("change", ["another user", "another name", "no mark", "another line"])
def test_a_line_that_this_user_did_not_write_says_nothing(
    change: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder came with a repository: its ledger says that all is done, and its bundle may be anybody's."""
    out = tmp_path / "out"
    run([fixture("continuous")], out)
    ledger = out / ".exported.jsonl"
    (entry,) = lines(ledger)
    if change == "another user":
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    elif change == "another name":
        ((name, written),) = entry["policies"].items()
        entry["policies"] = {f"../out/{name}": written}
        entry["mark"] = mark(read_key() or b"", entry)
    elif change == "no mark":
        del entry["mark"]
    else:
        entry["verified"] = True
    ledger.write_text(json.dumps(entry) + "\n")
    (second,) = run([fixture("continuous")], out).values()
    assert not second.unchanged


def test_without_a_place_for_a_key_all_is_exported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    for _ in range(2):
        (outcome,) = run([fixture("continuous")], tmp_path / "out").values()
        assert outcome.error is None and not outcome.unchanged
    assert not (tmp_path / "out" / ".exported.jsonl").exists()


@pytest.mark.parametrize("step", ["compile_source", "write_jobs"])
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_changes_while_it_is_exported_is_exported_again(
    kind: str, step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if kind == "file":
        source = changing = tmp_path / "policy.bytes"
        shutil.copy(fixture("discrete"), source)
    else:
        source = shutil.copytree(run_folder("3DBall"), tmp_path / "3DBall")
        changing = source / "newer-checkpoint.txt"
    real = getattr(Exporter, step)

    def change(*given: Any) -> Any:
        yield from real(*given)
        shutil.copy(fixture("recurrent"), changing)

    with monkeypatch.context() as patched:
        patched.setattr(Exporter, step, lambda *given: list(change(*given)))
        (first,) = run([source], tmp_path / "out").values()
    (second,) = run([source], tmp_path / "out").values()
    (third,) = run([source], tmp_path / "out").values()
    assert (first.error, first.unchanged, second.unchanged, third.unchanged) == (None, False, False, True)


def test_a_run_that_was_stopped_goes_on(sources: list[Path], tmp_path: Path) -> None:
    run(sources, tmp_path / "whole")
    stopped = export_fleet(sources, ExportOptions(tmp_path / "out", verify="none"), jobs=2)
    for _ in range(3):
        next(stopped)
    stopped.close()
    ledger = tmp_path / "out" / ".exported.jsonl"
    lines = ledger.read_text().splitlines()
    ledger.write_text("\n".join(lines)[:-40])  # cut off in the middle of a line
    rest = run(sources, tmp_path / "out", jobs=2)
    assert sum(o.unchanged for o in rest.values()) == len(lines) - 1
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert not [p for p in (tmp_path / "out").iterdir() if p.name.startswith(".export-model")]


@pytest.mark.parametrize("folder", ["a", "b"])
def test_a_process_that_dies_costs_one_source(
    folder: str, sources: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that it had staged before, another process exports again, once, under the names that they have."""
    real = fleet._Crew._receive
    staged: list[int] = []

    def killing(crew: fleet._Crew, worker: fleet._Worker) -> list[Outcome] | None:
        at = None if worker.at is None else crew.paths[worker.at]
        if at == tmp_path / folder / "discrete.bytes":
            staged.append(len(worker.staged))
            assert worker.process.pid is not None
            os.kill(worker.process.pid, signal.SIGKILL)
            worker.process.join()
            while worker.pipe.poll():
                try:
                    worker.pipe.recv()
                except EOFError:
                    break
        return real(crew, worker)

    monkeypatch.setattr(fleet._Crew, "_receive", killing)
    made = run(sources, tmp_path / "out", jobs=2)
    lost = made.pop(str(tmp_path / folder / "discrete.bytes"))
    assert lost.error is not None
    assert "its status is -9" in lost.error.message
    assert [p for p, o in made.items() if o.error is not None] == [str(tmp_path / "a" / "broken.bytes")]
    assert any(staged) or folder == "a"
    names = sorted(p.name for o in made.values() for p in o.policies)
    assert len(names) == len(set(names)) == 9
    assert names == sorted(contents_of_bundles(tmp_path / "out"))


def contents_of_bundles(out: Path) -> list[str]:
    """The names of the bundles of a folder, each of which is whole; nothing else lies there."""
    inside = [p for p in out.iterdir() if p.name != ".exported.jsonl"]
    for place in inside:
        Bundle.open(place).verify_hashes()
    return [p.name for p in inside]


def test_what_is_only_staged_is_exported_again_once(tmp_path: Path) -> None:
    crew = fleet._Crew(ExportOptions(tmp_path), Wanted(), Turns(Names()), [Path("a"), Path("b"), Path("c")])
    crew.turns.asks(0, "first", Claim(Path("a"), ["x"]))  # type: ignore[arg-type]
    assert [n for _, _, n in crew.turns.answers()] == [[("x", None)]]
    worker = fleet._Worker(SimpleNamespace(exitcode=-9), None, 2, [0, 1])  # type: ignore[arg-type]
    assert [o.path for o in crew._after_death(worker)] == [Path("c")]
    assert list(crew.todo) == [0, 1]
    crew.turns.asks(0, "second", Claim(Path("a"), ["x"]))  # type: ignore[arg-type]
    assert list(crew.turns.answers()) == [(0, "second", [("x", None)])]
    worker = fleet._Worker(SimpleNamespace(exitcode=-9), None, None, [1, 0])  # type: ignore[arg-type]
    assert [o.path for o in crew._after_death(worker)] == [Path("b"), Path("a")]


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere each file is waited for")
def test_a_batch_of_bundles_waits_for_the_disk_once(
    sources: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two waits a batch, of its content before the first exchange and of the names after the last (60 of 200)."""
    waits: list[str] = []
    assert 2 * math.ceil(200 / batch._MOST_BUNDLES) <= 60
    real = exchange.exchange
    monkeypatch.setattr(os, "fsync", lambda number: waits.append("names"))
    monkeypatch.setattr(exchange, "_sync_file_system", lambda folder: not waits.append("content"))
    monkeypatch.setattr(bundle, "exchange", lambda new, place: (waits.append("exchange"), real(new, place)))
    monkeypatch.setattr(batch, "_MOST_BUNDLES", 4)
    made = run([s for s in sources if "twobrains" not in s.name], tmp_path / "out")
    assert sum(len(o.policies) for o in made.values()) == 6
    assert waits == ["content", *["exchange"] * 4, "names", "content", *["exchange"] * 2, "names"]


_KILLED = """
import os, signal, sys
from pathlib import Path
from export_model.converters.formats.bundle import bundle
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.fleet.fleet import export_fleet

out, at, *sources = sys.argv[1:]
left = int(at)
real = getattr(bundle, "exchange" if left else "sync_contents")

def die(*given):
    global left
    if left <= 1:
        os.kill(os.getpid(), signal.SIGKILL)
    left -= 1
    real(*given)

setattr(bundle, real.__name__, die)
options = ExportOptions(Path(out), targets=("onnx",), verify="none")
list(export_fleet(list(map(Path, sources)), options))
"""


@pytest.mark.parametrize("at", [0, 1, 4])
def test_a_batch_that_is_killed_tears_nothing(at: int, sources: list[Path], tmp_path: Path) -> None:
    """Before the disk was waited for, or between two exchanges; over an older bundle of each."""
    out = tmp_path / "out"
    sources = [s for s in sources if s.name != "broken.bytes"]
    run(sources, out)
    before = contents(out)
    ran = python("-c", _KILLED, out, at, *sources)
    assert ran.status == -signal.SIGKILL, ran
    names = [p.name for p in out.iterdir() if not p.name.startswith(".")]
    assert len(names) == 10
    for name in names:
        Bundle.open(out / name).verify_hashes()
    old = {name for name in before if (out / name).exists() and (out / name).read_bytes() == before[name]}
    assert len([n for n in names if f"{n}/policy.json" in old]) == 10 - max(at - 1, 0)
    options = ExportOptions(out, targets=("onnx",), verify="none")
    assert not any(o.unchanged or o.failed for o in export_fleet(sources, options))  # none of them was recorded
    assert sorted(contents_of_bundles(out)) == sorted(names)


def test_a_bundle_that_cannot_be_put_in_its_place_costs_its_source(
    sources: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = exchange.exchange

    def refuse(new: Path, place: Path) -> None:
        if place.name == "discrete":
            raise OSError(5, "Input/output error")
        real(new, place)

    monkeypatch.setattr(bundle, "exchange", refuse)
    made = run(sources, tmp_path / "out")
    refused = {o.path: o.error for o in made.values() if o.error is not None}
    assert set(refused) == {tmp_path / "a" / "broken.bytes", tmp_path / "a" / "discrete.bytes"}
    assert "Input/output error" in refused[tmp_path / "a" / "discrete.bytes"].message
    assert len(contents_of_bundles(tmp_path / "out")) == 9
    monkeypatch.setattr(exchange, "_sync_file_system", lambda folder: (_ for _ in ()).throw(OSError(28, "No space")))
    assert all("No space" in o.error.message for o in run(sources[:2], tmp_path / "full").values() if o.error)
    assert contents_of_bundles(tmp_path / "full") == []


def test_the_first_failure_may_be_the_end(sources: list[Path], tmp_path: Path) -> None:
    made = list(export_fleet(sources, ExportOptions(tmp_path / "out", verify="none"), fail_fast=True))
    assert made[-1].error is not None
    assert len(made) == 3


@pytest.mark.parametrize("jobs", [0, -1])
def test_some_number_of_processes_is_needed(jobs: int, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--jobs"):
        next(export_fleet([fixture("continuous")], ExportOptions(tmp_path), jobs=jobs))


@pytest.mark.runtimes
def test_the_command_line_sums_up(sources: list[Path], tmp_path: Path) -> None:
    ran = export_model(tmp_path / "a", "-o", tmp_path / "out", "--jobs", "2", "--verify", "onnxruntime")
    assert ran.status == 2
    assert "5 of 5 sources in" in ran.out
    assert "5 policies exported (5 verified), 1 source REFUSED" in ran.out
    assert "broken.bytes" in ran.err
    (tmp_path / "a" / "broken.bytes").unlink()
    ran = export_model(tmp_path / "a", "-o", tmp_path / "out", "--jobs", "1", "--verify", "onnxruntime", "--json")
    assert (ran.status, ran.json) == (0, {"policies": [], "unchanged": 4})
    ran = export_model(tmp_path / "a", "-o", tmp_path / "new", "--again", "--json", "--verify", "none")
    assert sorted(p["name"] for p in ran.json["policies"]) == sorted(
        p.name for p in (tmp_path / "new").iterdir() if p.is_dir()
    )


def lines(path: Path) -> Iterator[dict[str, object]]:
    return (json.loads(line) for line in path.read_text().splitlines())


def test_only_what_is_in_its_place_is_recorded(sources: list[Path], tmp_path: Path) -> None:
    run(sources, tmp_path / "out")
    assert {entry["source"] for entry in lines(tmp_path / "out" / ".exported.jsonl")} == {
        str(s) for s in sources if s.name != "broken.bytes"
    }


def test_very_many_failures_are_counted() -> None:
    tally = _Tally(80)
    for i in range(80):
        tally.count(Outcome(Path(f"p{i}"), error=UsageError("no", fix="yes")))
    assert len(tally.failures) == 51
    assert tally.failures[-1].startswith("… and 30 more sources")
