"""Sources from a web server on this machine: what is fetched, how long for, and where a server may send on to."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from functools import partial
from http.server import BaseHTTPRequestHandler, SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from export_model.converters.files import fetch
from export_model.converters.files.fetch import address_of
from export_model.exporter.remote import filesystem, redirects
from export_model.exporter.remote.fetching import nearby
from export_model.exporter.remote.filesystem import Pace, asking, matching
from export_model.signatures.errors import SourceError, UsageError
from fixtures import path as fixture
from tests.commands import export_model as command
from tests.exporting import export_model
from tests.remote.test_addresses import files, run

fsspec = pytest.importorskip("fsspec")
yarl = pytest.importorskip("yarl")


class _Redirecting(BaseHTTPRequestHandler):
    to = f"file://{fixture('discrete')}"

    def do_GET(self) -> None:
        self.send_response(302)
        self.send_header("Location", self.to)
        self.end_headers()

    do_HEAD = do_GET  # noqa: N815

    def log_message(self, *args: Any) -> None:
        pass


def test_no_redirect_leads_from_the_internet_to_this_machine(
    serving: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copy(fixture("discrete"), tmp_path / "discrete.bytes")
    own = serving(partial(_Quiet, directory=str(tmp_path)))

    class Sending(_Redirecting):
        to = f"{own}/discrete.bytes"

    address = f"{serving(Sending)}/discrete.bytes"
    assert run([address], tmp_path / "own")[0].error is None  # in one network it is followed

    async def is_near(url: Any) -> bool:
        return url.port == int(own.rpartition(":")[2])

    monkeypatch.setattr(redirects, "_is_near", is_near)
    with pytest.raises(SourceError, match=r"sends on to http://127.0.0.1(.|\n)*this machine's own network") as told:
        export_model(address, tmp_path / "out", verify="none")
    assert address in str(told.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("host", "near"),
    [("127.0.0.1", True), ("169.254.169.254", True), ("10.1.2.3", True), ("::1", True), ("fe80::1%1", True),
     ("8.8.8.8", False), ("2001:4860:4860::8888", False), ("no-such-host.invalid", False)],
)  # fmt: skip
def test_addresses_of_this_machine_and_its_networks_are_near(host: str, near: bool) -> None:
    assert asyncio.run(redirects._is_near(SimpleNamespace(host=host, port=80))) is near


def test_no_redirect_leads_from_https_to_http() -> None:
    response = SimpleNamespace(url=yarl.URL("https://a.example/x"), headers={"Location": "http://a.example/x"})
    context = SimpleNamespace(first=response.url, near=True)
    with pytest.raises(SourceError, match="asked for by https"):
        asyncio.run(redirects._sent_on(None, context, SimpleNamespace(response=response)))
    response.headers["Location"] = "/y"
    asyncio.run(redirects._sent_on(None, context, SimpleNamespace(response=response)))


def test_a_server_that_drips_is_not_waited_for(serving: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Dripping(_Redirecting):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            with contextlib.suppress(OSError):
                while True:
                    self.wfile.write(b"x")
                    time.sleep(0.05)

    monkeypatch.setattr(Pace, "FREE", 0.5)
    place = serving(Dripping)

    with pytest.raises(SourceError, match=r"comes too slowly(.|\n)*bytes came in"):
        export_model(f"{place}/model.onnx", tmp_path / "out", verify="none")
    with pytest.raises(SourceError, match=r"comes too slowly"):
        matching(f"{place}/*.onnx")


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
    assert fetch.path_text(Path(address)) == told
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


def test_a_redirect_leads_to_no_file(serving: Any) -> None:
    place = serving(_Redirecting)
    with pytest.raises(SourceError, match=r"cannot be fetched|no such file"), nearby(Path(f"{place}/policy.bytes")):
        pass
