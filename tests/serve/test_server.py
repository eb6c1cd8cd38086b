"""The server: only the site's own names, with the right types, until Ctrl-C."""

from __future__ import annotations

import http.client
import signal
import socket
import subprocess
import sys

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exporter.serve.server import SiteServer, listening
from signatures.errors import UsageError
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
    command = [sys.executable, "-u", "-m", "exporter", "serve", str(bundle("continuous")), "--port", "0"]
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
        out, err = process.communicate(timeout=30)
        connection.close()
    assert (process.returncode, out, err) == (0, "ended\n", "")
