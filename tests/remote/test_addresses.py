"""Sources and bundles by address: a memory file system, and a web server on this machine."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from export_model.converters.files import fetch
from export_model.exporter.export.pipeline import ExportOptions
from export_model.exporter.fleet.fleet import export_fleet
from export_model.exporter.fleet.outcome import Outcome
from export_model.exporter.fleet.sources import sources_in
from export_model.exporter.remote import fetching, sending
from export_model.exporter.remote.fetching import nearby
from export_model.exporter.remote.filesystem import remote
from export_model.signatures.contract import POLICY
from export_model.signatures.errors import BundleError, SourceError, UsageError
from fixtures import path as fixture
from tests.comparing import compare_artefacts
from tests.exporting import export_model, inspect_model, verify_bundle

fsspec = pytest.importorskip("fsspec")


@pytest.fixture
def memory() -> Iterator[Any]:
    system = fsspec.filesystem("memory")
    system.store.clear()
    system.pseudo_dirs[:] = [""]
    for name in ("a/continuous", "a/discrete", "b/continuous"):
        system.pipe(f"/runs/{name}.bytes", fixture(Path(name).name).read_bytes())
    system.pipe("/runs/notes.txt", b"no model")
    yield system
    system.store.clear()


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def run(given: list[str], out: str | Path, **more: Any) -> list[Outcome]:
    options = ExportOptions(Path(out), verify="none")
    return list(export_fleet(sources_in([Path(g) for g in given], Path(out)), options, **more))


def test_what_is_written_is_what_files_give(memory: Any, tmp_path: Path) -> None:
    for name in ("a/continuous", "a/discrete", "b/continuous"):
        (tmp_path / "runs" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(fixture(Path(name).name), tmp_path / "runs" / f"{name}.bytes")
    run([str(tmp_path / "runs")], tmp_path / "out")
    made = run(["memory://runs/**/*.bytes"], "memory://out")
    assert not [o.error for o in made if o.error is not None]
    local = {k: v for k, v in files(tmp_path / "out").items() if k != ".exported.jsonl"}
    sent = {path.removeprefix("/out/"): memory.cat(path) for path in memory.find("/out")}
    assert sent == local
    assert {name.split("/")[0] for name in sent} == {"continuous", "discrete", "b-continuous"}


def test_every_job_of_python_takes_addresses(memory: Any) -> None:
    (policy,) = inspect_model("memory://runs/a/continuous.bytes").policies
    assert policy.policy.name == "continuous"
    run(["memory://runs/a/continuous.bytes"], "memory://out")
    again = verify_bundle(
        "memory://out/continuous", source="memory://runs/a/continuous.bytes", runtimes=["onnxruntime"]
    )
    assert again.passed, again.failures
    report = compare_artefacts(
        "memory://runs/a/continuous.bytes", "memory://out/continuous/continuous.onnx", runtimes=["onnxruntime"]
    )
    assert report.passed, report.failures


def test_policy_json_is_sent_last_and_goes_first(memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    run(["memory://runs/a/discrete.bytes"], "memory://out")
    memory.pipe("/out/discrete/policy.old", b"of an older version")
    done: list[str] = []
    kind = type(memory)
    put, rm = kind.put_file, kind.rm_file
    monkeypatch.setattr(kind, "put_file", lambda s, a, b, **k: (done.append(b), put(s, a, b, **k)))
    monkeypatch.setattr(kind, "rm_file", lambda s, a: (done.append(f"- {a}"), rm(s, a)))
    run(["memory://runs/a/discrete.bytes"], "memory://out")
    assert done[0] == "- /out/discrete/policy.json"
    assert done[-2:] == ["/out/discrete/policy.json", "- /out/discrete/policy.sending"]
    assert "- /out/discrete/policy.old" in done
    assert not memory.exists("/out/discrete/policy.old")


@pytest.mark.parametrize("at", ["discrete.onnx", POLICY])
def test_what_was_cut_short_is_sent_again(at: str, memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    given = ["memory://runs/a/discrete.bytes"]
    run(given, "memory://out")
    whole = memory.find("/out")
    kind = type(memory)
    put = kind.put_file

    def cut(system: Any, here: str, there: str, **more: Any) -> None:
        if there.endswith(f"/{at}"):
            raise ConnectionResetError("the line went dead")
        put(system, here, there, **more)

    with monkeypatch.context() as patched:
        patched.setattr(kind, "put_file", cut)
        (refused,) = run(given, "memory://out")
    assert isinstance(refused.error, BundleError)
    assert not memory.exists(f"/out/discrete/{POLICY}")
    assert run(given, "memory://out")[0].error is None
    assert memory.find("/out") == whole


@pytest.mark.parametrize(
    "theirs",
    [
        ["discrete.bytes", "discrete.pt", "discrete.yaml"],
        ["policy.pt"],
        ["saved_model/saved_model.pb", "tfjs/model.json"],
        ["thesis.tex"],
    ],
)
def test_what_is_anothers_stays(theirs: list[str], memory: Any) -> None:
    for name in theirs:
        memory.pipe(f"/models/discrete/{name}", fixture("discrete").read_bytes())
    before = {path: memory.cat(path) for path in memory.find("/models")}
    given = "memory://models/discrete/discrete.bytes" if len(theirs) == 3 else "memory://runs/a/discrete.bytes"
    (refused,) = run([given], "memory://models")
    assert isinstance(refused.error, BundleError)
    assert "memory://models/discrete: already exists" in refused.error.message
    assert {path: memory.cat(path) for path in memory.find("/models")} == before


def test_unchanged_addresses_are_left_out(memory: Any, tmp_path: Path) -> None:
    given = ["memory://runs/**/*.bytes"]
    run(given, tmp_path)
    assert all(o.unchanged for o in run(given, tmp_path))
    memory.pipe("/runs/a/discrete.bytes", fixture("twobrains").read_bytes())
    assert [o.path.name for o in run(given, tmp_path) if not o.unchanged] == ["discrete.bytes"]


def test_a_folder_is_one_source_and_errors_name_the_address(memory: Any) -> None:
    with nearby(Path("memory://runs/a")) as here:
        assert sorted(p.name for p in here.iterdir()) == ["continuous.bytes", "discrete.bytes"]
    assert not here.exists()
    with pytest.raises(SourceError, match=r"^memory://runs/notes\.txt: "):
        export_model("memory://runs/notes.txt", "memory://out", verify="none")
    with pytest.raises(SourceError, match=r"memory://gone\.onnx: no such file"):
        export_model("memory://gone.onnx", "memory://out", verify="none")


def test_more_than_is_fetched_is_refused(memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetching, "MAX_REMOTE_BYTES", 1000)
    with pytest.raises(SourceError, match="has more than"), nearby(Path("memory://runs/a/discrete.bytes")):
        pass
    monkeypatch.setattr(fetching, "MAX_FILES", 1)
    with pytest.raises(SourceError, match="has 2 files"), nearby(Path("memory://runs/a")):
        pass


@pytest.mark.parametrize("name", ["..", "a\\b", "x" * 300])
def test_names_stay_below_the_folder(name: str, memory: Any, tmp_path: Path) -> None:
    memory.store[f"/odd/{name}/m.bytes"] = memory.store["/runs/notes.txt"]
    with pytest.raises(SourceError, match="has a name that it cannot have here"), nearby(Path("memory://odd")):
        pass


@pytest.mark.parametrize(
    "address",
    ["file:///etc/passwd", "local://etc/passwd", "simplecache::memory://a", "memory://a::file://b", "zip://a::s3://b"],
)
def test_protocols_that_are_not_named_are_no_addresses(address: str) -> None:
    assert remote(Path(address)) is None


def test_without_fsspec_an_address_is_no_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(fetch.importlib.util, "find_spec", lambda name, real=importlib.util.find_spec: None)
    with pytest.raises(SourceError, match=r"is an address, not a file(.|\n)*nothing is fetched(.|\n)*\[remote\]"):
        export_model("https://example.com/models/3DBall.onnx", tmp_path, verify="none")
    with pytest.raises(UsageError, match="nothing can be written there"):
        export_model(fixture("discrete"), "s3://bucket/out", verify="none")


def test_nothing_is_written_by_http() -> None:
    with pytest.raises(UsageError, match="nothing can be written there"):
        sending.check_sendable(Path("https://example.com/out"))


@pytest.mark.parametrize("listed", [["/odd/a", "/odd/a/b"], ["/elsewhere/x"]])
def test_a_listing_that_no_folder_can_have(listed: list[str], memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    memory.pipe("/odd/a", b"-")
    monkeypatch.setattr(type(memory), "find", lambda *a, **k: {name: {"size": 1} for name in listed})
    with pytest.raises(SourceError, match=r"^memory://odd: cannot be fetched"), nearby(Path("memory://odd")):
        pass
