"""Sources and bundles by address: a memory file system, and a web server on this machine."""

from __future__ import annotations

import gzip
import importlib.util
import os
import shutil
import socket
import threading
from collections.abc import Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from converters.files import fetch
from converters.files.fetch import address_of
from exporter import compare_artefacts, export_model, inspect_model, verify_bundle
from exporter.export.pipeline import ExportOptions
from exporter.fleet.fleet import export_fleet
from exporter.fleet.sources import sources_in
from exporter.fleet.worker import Outcome
from exporter.remote import fetching, filesystem, sending
from exporter.remote.fetching import nearby
from exporter.remote.filesystem import asking, matching, remote
from fixtures import path as fixture
from signatures.contract import POLICY
from signatures.errors import BundleError, SourceError, UsageError
from tests.commands import export_model as command

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
    with pytest.raises(SourceError, match=r"memory://gone\.onnx: there is no such file"):
        export_model("memory://gone.onnx", "memory://out", verify="none")


def test_more_than_is_fetched_is_refused(memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fetching, "MAX_BYTES", 1000)
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


# ------------------------------------------------------------------ a web server


class _Redirecting(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(302)
        self.send_header("Location", f"file://{fixture('discrete')}")
        self.end_headers()

    do_HEAD = do_GET  # noqa: N815

    def log_message(self, *args: Any) -> None:
        pass


def test_a_server_that_does_not_answer_is_not_a_missing_file() -> None:
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{taken.getsockname()[1]}/x.onnx"
        with pytest.raises(SourceError, match=r"cannot be fetched\n  why: Client.*connect"):
            export_model(address, "out", verify="none")


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args: Any) -> None:
        pass


@pytest.fixture
def serving() -> Iterator[Any]:
    servers = []

    def serve(handler: Any) -> str:
        server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}"

    yield serve
    for server in servers:
        server.shutdown()
        server.server_close()


def test_a_web_server(serving: Any, tmp_path: Path) -> None:
    shutil.copy(fixture("discrete"), tmp_path / "discrete.bytes")
    place = serving(partial(_Quiet, directory=str(tmp_path)))
    run([f"{place}/discrete.bytes?raw=true"], tmp_path / "one")
    export_model(fixture("discrete"), tmp_path / "two", verify="none")
    assert files(tmp_path / "one" / "discrete") == files(tmp_path / "two" / "discrete")
    ran = command("inspect", f"{place}/discrete.bytes")
    assert (ran.status, "discrete" in ran.out) == (0, True)
    ran = command(f"{place}/gone.bytes", "-o", tmp_path / "out", "--verify", "none")
    assert ran.status == 2
    assert f"{place}/gone.bytes" in ran.err


def test_passwords_and_signatures_are_told_and_written_nowhere(serving: Any, tmp_path: Path) -> None:
    for name in "ab":
        (tmp_path / "there" / name).mkdir(parents=True)
        shutil.copy(fixture("discrete"), tmp_path / "there" / name / "discrete.bytes")
    place = serving(partial(_Quiet, directory=str(tmp_path / "there")))
    signed = f"{place}/b/discrete.bytes?sig=secret"
    given = [f"{place.replace('://', '://user:secret@')}/a/discrete.bytes", signed]
    (tmp_path / "here").mkdir()
    report = ("--html", tmp_path / "here" / "report.html")
    out = ("-o", tmp_path / "here" / "out", "--verify", "none")
    gone = [address.replace("discrete", "gone") for address in given]
    ran = [
        command(*given, *gone, *out, "-v"),
        command(*given, *out, "--json"),
        command("inspect", given[0]),
        command("inspect", signed),
        command("inspect", *gone, "--json"),
        command("compare", given[0], signed, "--runtimes", "none", "--allow-unverified", *report),
        command(f"{place}/?sig=secret*", *out),
    ]
    assert [r.status for r in ran] == [2, 0, 0, 0, 2, 0, 2]
    assert '"unchanged": 2' in ran[1].out
    written = files(tmp_path / "here")
    assert {"out/discrete/policy.json", "out/b-discrete/policy.json", "report.html"} < written.keys()
    assert [name for name, data in written.items() if b"secret" in data or "secret" in name] == []
    assert [r for r in ran if "secret" in r.out + r.err] == []
    assert f"called b-discrete: discrete is the policy of {place}/a/discrete.bytes" in ran[0].out


@pytest.mark.parametrize(
    ("address", "told"),
    [
        ("https://u:p@h:8/a//b.onnx?X-Amz-Signature=1#x", "https://h:8/a/b.onnx"),
        ("s3://key:hidden@bucket/run#1/p.onnx", "s3://bucket/run#1/p.onnx"),
        ("hf://gpt2@main/p.onnx", "hf://gpt2@main/p.onnx"),
        ("memory://out/discrete", "memory://out/discrete"),
        ("runs/a@b/p.onnx", "runs/a@b/p.onnx"),
    ],
)
def test_an_address_is_told_in_its_own_spelling(address: str, told: str) -> None:
    assert fetch.shown(Path(address)) == told
    text = f"403, message='Forbidden', url='{address}'"
    with pytest.raises(SourceError) as raised, asking(address):
        raise ValueError(text)
    assert raised.value.why == f"ValueError: {text.replace(address, told)}"
    assert raised.value.where == told


def test_unchanged_files_of_a_web_server_are_left_out(serving: Any, tmp_path: Path) -> None:
    shutil.copy(fixture("discrete"), tmp_path / "discrete.bytes")
    given = [f"{serving(partial(_Quiet, directory=str(tmp_path)))}/discrete.bytes"]  # which tells Last-Modified alone
    assert [run(given, tmp_path / "out")[0].unchanged for _ in range(2)] == [False, True]
    os.utime(tmp_path / "discrete.bytes", (1, 1))
    assert not run(given, tmp_path / "out")[0].unchanged


def test_a_pattern_follows_the_links_of_each_level(
    serving: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a/p 1.onnx", "a/q.txt", "b/p.onnx", "b/inside/p.onnx", "notes.txt"):
        (tmp_path / "runs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "runs" / name).write_bytes(b"-")
    place = serving(partial(_Quiet, directory=str(tmp_path)))
    found = [address_of(p) for p in matching(f"{place}/runs/*/*.onnx")]
    assert found == [f"{place}/runs/a/p%201.onnx", f"{place}/runs/b/p.onnx"]
    assert [address_of(p) for p in matching(f"{place}/runs/[b]/p.onnx")] == [f"{place}/runs/b/p.onnx"]
    with pytest.raises(UsageError, match=r"\*\* is not for a web server"):
        matching(f"{place}/runs/**/*.onnx")
    with monkeypatch.context() as patched, pytest.raises(SourceError, match="lists more than is read"):
        patched.setattr(filesystem, "MAX_FILES", 1)
        matching(f"{place}/runs/*/*.onnx")
    monkeypatch.setattr(filesystem, "MAX_LISTING", 100)
    with pytest.raises(SourceError, match="lists more than is read"):
        matching(f"{place}/runs/*/*.onnx")


class _Pages(_Redirecting):
    """Pages that link out of their folder."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        for link in ("../p.onnx", "//elsewhere.example/p.onnx", "/runs/p.onnx", "/else/p.onnx", "?C=N", "p.onnx?x=1"):
            self.wfile.write(f"<a href='{link}'>p</a>".encode())


def test_links_lead_nowhere_else(serving: Any) -> None:
    place = serving(_Pages)
    assert [address_of(p) for p in matching(f"{place}/runs/*.onnx")] == [f"{place}/runs/p.onnx"]


def test_a_file_may_take_longer_than_five_minutes() -> None:
    system, _ = filesystem.filesystem("https://example.com/p.onnx")
    timeout = system.client_kwargs["timeout"]
    assert (timeout.total >= 3600, timeout.sock_connect, timeout.sock_read) == (True, 30, 60)


@pytest.mark.parametrize("address", ["http://[/x.onnx", "http://*", "http://*/x.onnx", "http://a b/x"])
def test_a_host_is_no_pattern(address: str, tmp_path: Path) -> None:
    """Patterns are of paths: a bracket in a host ended in StopIteration."""
    (tmp_path / "list.txt").write_text(address)
    ran = command(tmp_path / "list.txt", "-o", tmp_path / "out", "--verify", "none")
    assert (ran.status, "Traceback" in ran.err) == (2, False)
    assert address in ran.err


class _Packed(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Encoding", "gzip")
        self.end_headers()
        self.wfile.write(gzip.compress(bytes(1 << 26)))

    do_HEAD = do_GET  # noqa: N815

    def log_message(self, *args: Any) -> None:
        pass


def test_what_comes_is_not_unpacked_on_the_way(serving: Any) -> None:
    with nearby(Path(f"{serving(_Packed)}/policy.onnx")) as place:
        assert place.stat().st_size < 1 << 20


@pytest.mark.parametrize("listed", [["/odd/a", "/odd/a/b"], ["/elsewhere/x"]])
def test_a_listing_that_no_folder_can_have(listed: list[str], memory: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    memory.pipe("/odd/a", b"-")
    monkeypatch.setattr(type(memory), "find", lambda *a, **k: {name: {"size": 1} for name in listed})
    with pytest.raises(SourceError, match=r"^memory://odd: cannot be fetched"), nearby(Path("memory://odd")):
        pass


def test_a_redirect_leads_to_no_file(serving: Any) -> None:
    place = serving(_Redirecting)
    with pytest.raises(SourceError, match=r"cannot be fetched|no such file"), nearby(Path(f"{place}/policy.bytes")):
        pass
