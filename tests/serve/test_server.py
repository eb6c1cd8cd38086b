"""The server: only the site's own names, with the right types, until Ctrl-C."""

from __future__ import annotations

import http.client
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import export_model.exporter.serve.server as server_module
from export_model.exporter.serve.server import CONTENT_POLICY, HEADERS, SiteServer, interrupts, listening
from export_model.exporter.serve.site import PAGE
from export_model.signatures.errors import UsageError
from tests.commands import ROOT, export_model, is_refused
from tests.serve.browsing import served
from tests.serve.conftest import Bundle

SITE = {
    "index.html": b"<!doctype html>",
    "page.css": b"p {}",
    "views/a.mjs": b"export {}",
    "vendor/tf.js": b"0",
    "vendor/b.wasm": b"\0asm",
    "golden.bin": b"\0\1",
    "site.json": b"{}",
    "icon.svg": b"<svg/>",
    "model/policy.d.mts": b"export {}",
}
TYPES = {
    "index.html": "text/html; charset=utf-8",
    "page.css": "text/css; charset=utf-8",
    "views/a.mjs": "text/javascript; charset=utf-8",
    "vendor/tf.js": "text/javascript; charset=utf-8",
    "vendor/b.wasm": "application/wasm",
    "golden.bin": "application/octet-stream",
    "site.json": "application/json",
    "icon.svg": "image/svg+xml",
    "model/policy.d.mts": "text/plain; charset=utf-8",
}


def ask(server: SiteServer, target: str, method: str = "GET") -> tuple[int, str | None, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1])
    try:
        # Not request(): it refuses what a crooked client would send.
        connection.putrequest(method, target, skip_accept_encoding=True)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.getheader("Content-Type"), answer.read()
    finally:
        connection.close()


def test_files_come_with_their_types() -> None:
    assert TYPES.keys() == SITE.keys()
    with served(SITE) as server:
        for name, data in SITE.items():
            assert ask(server, f"/{name}?x=1") == (200, TYPES[name], data)
            assert ask(server, f"/{name}", "HEAD") == (200, TYPES[name], b"")
        assert ask(server, "/")[2] == SITE["index.html"]
        assert ask(server, "/", "POST")[0] == 501


CROOKED = (
    *("/../pyproject.toml", "/%2e%2e/pyproject.toml", "/..%2fpyproject.toml"),
    *("//etc/passwd", "/views/../../x", "/views", "/views/"),
)
SEGMENTS = ("..", "%2e%2e", ".", "views", "etc", "passwd", "pyproject.toml", "%00", "%5c..", "a.mjs")


def test_nothing_else_is_served() -> None:
    segments = st.sampled_from(SEGMENTS)

    @settings(deadline=None)
    @given(st.lists(segments, min_size=1, max_size=5))
    def check(parts: list[str]) -> None:
        target = "/" + "/".join(parts)
        assert (ask(server, target)[0] == 200) == (target == "/views/a.mjs")

    with served(SITE) as server:
        for target in CROOKED:
            assert ask(server, target)[0] == 404, target
        check()


def raw(server: SiteServer, request: bytes, patience: float = 20) -> bytes:
    """All that comes back until the server closes the connection."""
    with socket.create_connection(server.server_address[:2], timeout=patience) as connection:
        connection.sendall(request)
        parts = []
        while part := connection.recv(65536):
            parts.append(part)
        return b"".join(parts)


REQUESTS: dict[str, tuple[bytes, int]] = {
    "a file": (b"GET / HTTP/1.1\r\nHost: localhost:PORT\r\nConnection: close\r\n\r\n", 200),
    "by its address": (b"GET / HTTP/1.0\r\nHost: 127.0.0.1:PORT\r\n\r\n", 200),
    "by a new address": (b"GET / HTTP/1.0\r\nHost: [::1]:PORT\r\n\r\n", 200),
    "what is not there": (b"GET /<b>x HTTP/1.0\r\nHost: localhost:PORT\r\n\r\n", 404),
    "a name that was bent to this address": (b"GET / HTTP/1.1\r\nHost: evil.example:PORT\r\n\r\n", 421),
    "a name that begins right": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1.evil.example:PORT\r\n\r\n", 421),
    "another port": (b"GET / HTTP/1.1\r\nHost: localhost:1\r\n\r\n", 421),
    "no name": (b"GET / HTTP/1.1\r\n\r\n", 421),
    "two names": (b"GET / HTTP/1.1\r\nHost: localhost:PORT\r\nHost: x\r\n\r\n", 421),
    "a method that is none": (b"POST / HTTP/1.1\r\nHost: localhost:PORT\r\n\r\n", 501),
    "no version": (b"GET /\r\n\r\n", 421),
    "a version to come": (b"GET / HTTP/9.9\r\n\r\n", 505),
    "nonsense": (b"\x16\x03\x01\r\n\r\n", 400),
    "a path without end": (b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", 414),
    "too many headers": (b"GET / HTTP/1.1\r\n" + b"a: b\r\n" * 200 + b"\r\n", 431),
}


@pytest.mark.parametrize("what", REQUESTS)
def test_every_answer_says_what_a_page_may_do(what: str) -> None:
    request, status = REQUESTS[what]
    with served(SITE) as server:
        answer = raw(server, request.replace(b"PORT", str(server.server_address[1]).encode()))
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 %d " % status), answer
    for name, value in HEADERS.items():
        assert head.count(f"\r\n{name}: {value}\r\n".encode()) + head.endswith(f"{name}: {value}".encode()) == 1, name
    assert b"Python" not in head
    if status != 200:
        assert b"\r\nContent-Type: text/plain; charset=utf-8\r\n" in head
        assert b"<" not in body
        assert body.count(b"\n") == 1


def test_the_page_says_the_same_policy() -> None:
    assert f'http-equiv="Content-Security-Policy" content="{CONTENT_POLICY}"' in (PAGE / "index.html").read_text()


def test_who_says_nothing_or_no_end_holds_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Connections that wait, and ones that say a header every moment: closed; the others are answered meanwhile."""
    monkeypatch.setattr(server_module, "MOST_CONNECTIONS", 4)
    with served(SITE) as server:  # as patient as it is: a machine may take its time between two lines
        waiting = [socket.create_connection(server.server_address[:2], timeout=300) for _ in range(3)]
        assert ask(server, "/")[0] == 200
        for connection in waiting:
            connection.close()
    monkeypatch.setattr(server_module, "PATIENCE", 1.0)
    monkeypatch.setattr(server_module._Handler, "timeout", 1.0)
    with served(SITE) as server:
        waiting = [socket.create_connection(server.server_address[:2], timeout=300) for _ in range(6)]
        talking, end = waiting[0], time.monotonic() + 300
        with suppress(OSError):
            talking.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n")
            while time.monotonic() < end:
                talking.sendall(b"a: b\r\n")
                time.sleep(0.2)
        assert time.monotonic() < end, "it may talk without end"
        for connection in waiting[1:]:
            with suppress(OSError):
                assert connection.recv(1) == b""
            connection.close()
        talking.close()
        for _ in range(1000):
            with suppress(OSError, http.client.HTTPException):
                assert ask(server, "/")[0] == 200
                return
            time.sleep(0.1)
        pytest.fail("no thread came free")


def test_a_port_that_is_taken_is_refused(bundle: Bundle) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match="another --port"), listening(SITE, "127.0.0.1", port):
            pass
        is_refused(export_model("serve", bundle("continuous"), "--port", port), f"127.0.0.1:{port}")


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGINT to send")
@pytest.mark.parametrize("ignored", [False, True], ids=["in front", "in the background"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(bundle: Bundle, number: signal.Signals, ignored: bool) -> None:
    """A shell without job control starts jobs in the background with SIGINT ignored, and children inherit that."""
    command = [sys.executable, "-u", "-m", "export_model", "serve", str(bundle("continuous")), "--port", "0"]
    if ignored:
        command = ["sh", "-c", "trap '' INT TERM; exec \"$@\"", "sh", *command]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.startswith("http://127.0.0.1:")
        port = int(line.split()[0].rstrip("/").rpartition(":")[2])
        connection = http.client.HTTPConnection("127.0.0.1", port)
        connection.request("GET", "/site.json")
        assert connection.getresponse().status == 200
        process.send_signal(number)
        out, err = process.communicate(timeout=300)
        connection.close()
    assert (process.returncode, out, err) == (0, "ended\n", "")


def test_an_address_of_version_6_is_listened_on() -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    with listening({"index.html": b"here"}, "::1", 0) as server:
        assert server.url.startswith("http://[::1]:")
        assert server.answers_to(server.url.removeprefix("http://").removesuffix("/"))


def test_an_interrupt_in_a_destructor_is_not_lost() -> None:
    """Python prints and drops what is raised there: a server that was ended by an exception went on for ever."""

    class Collected:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    with interrupts() as told:
        Collected()
    assert told == [signal.SIGINT]
