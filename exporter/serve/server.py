"""Serves a site from memory: only the names it holds, so there is nothing to traverse to.

Any page that a browser shows can ask this server, and by a name of its own that it lets point here (DNS rebinding) even
read the answers. So it answers only those who call it by an address or a name that is this machine's, and every answer,
errors too, carries the policy that says what a page may do.
"""

from __future__ import annotations

import ipaddress
import signal
import socket
import socketserver
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from export_model.signatures.errors import UsageError

INDEX = "index.html"
#: Not mimetypes: it asks the system, and Windows' registry may call .js text/plain.
TYPES: Mapping[str, str] = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".mts": "text/plain; charset=utf-8",
    ".json": "application/json",
    ".wasm": "application/wasm",
    ".bin": "application/octet-stream",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}
#: Of these, what is data and nothing else: a bundle's files are served under no other name.
DATA = (".json", ".bin")
#: What every answer says. The page itself says the first as well (index.html), for static hosting; of a frame around
#: it only a header can speak.
CONTENT_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; worker-src blob:; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'"
)
HEADERS: Mapping[str, str] = {
    "Content-Security-Policy": f"{CONTENT_POLICY}; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",  # the next policy may be served from the same address
}
#: Connections at a time (a browser makes six), seconds of silence in one, seconds that a request may take to be said.
MOST_CONNECTIONS, SILENCE, PATIENCE = 32, 10.0, 30.0


class SiteServer(ThreadingHTTPServer):
    """Listens from the moment it is made; ``url`` is where the page is."""

    timeout = 0.5  # seconds that it waits for somebody to ask

    def __init__(self, site: Mapping[str, bytes], host: str, port: int) -> None:
        self.site = site
        self.host = host
        self._free = threading.BoundedSemaphore(MOST_CONNECTIONS)
        #: connection → when its request began to be said
        self.asking: dict[socket.socket, float] = {}
        if ":" in host:
            self.address_family = socket.AF_INET6
        super().__init__((host, port), _Handler)

    def answers_to(self, asked: str) -> bool:
        """Whether a Host header is this server's: any address (no name can be bent to be one), or a name of ours."""
        name, port = _host_and_port(asked)
        if port not in (str(self.server_address[1]), "" if self.server_address[1] == 80 else None):
            return False
        try:
            ipaddress.ip_address(name)
        except ValueError:
            return name.casefold().rstrip(".") in ("localhost", self.host.casefold(), socket.gethostname().casefold())
        return True

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own, if one is free; else the connection is closed."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """As the base; the thread is free afterwards."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.asking.pop(request, None)
            self._free.release()

    def answer_until(self, told: Sequence[int]) -> None:
        """Answer until something is told, which is looked at twice a second."""
        while not told:
            self.handle_request()
            self.service_actions()

    def service_actions(self) -> None:
        """Twice a second: end the connections whose request is never said to its end."""
        for connection, since in list(self.asking.items()):
            if time.monotonic() - since > PATIENCE:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: who hangs up, or is hung up on, is no error of ours."""

    def server_bind(self) -> None:
        """Without HTTPServer's look-up of the machine's name, which takes seconds where no network answers."""
        socketserver.TCPServer.server_bind(self)

    @property
    def url(self) -> str:
        """The page's address, with the port that was taken."""
        host, port = self.server_address[:2]
        name = host if isinstance(host, str) else host.decode()
        return f"http://{f'[{name}]' if ':' in name else name}:{port}/"


@contextmanager
def interrupts() -> Iterator[list[int]]:
    """What Ctrl-C and SIGTERM have told so far, which then are no errors.

    So it is whatever was inherited: a job in the background ignores SIGINT unless it says otherwise. The result is a
    list, not an exception: Python loses one that is raised in a destructor, and the server would go on for ever.
    """
    told: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, frame: told.append(number)) for number in numbers}
    try:
        yield told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def listening(site: Mapping[str, bytes], host: str, port: int) -> Iterator[SiteServer]:
    """A server that is closed at the end. Raises UsageError where the address cannot be listened on."""
    try:
        server = SiteServer(site, host, port)
    except (OSError, UnicodeError) as error:
        raise UsageError(
            f"{host}:{port} cannot be listened on",
            why=str(error),
            fix="give another --port (0 takes a free one), or another --host",
        ) from error
    with server:
        yield server


def _host_and_port(asked: str) -> tuple[str, str]:
    """``[::1]:8000`` as ``::1`` and ``8000``; the port is empty where none is said."""
    name, colon, port = asked.strip().rpartition(":")
    if not colon or "]" in port:
        name, port = asked.strip(), ""
    return name.removeprefix("[").removesuffix("]"), port


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "export-model", ""
    timeout = SILENCE
    disable_nagle_algorithm = True  # or a body waits until its headers are acknowledged
    server: SiteServer

    def handle_one_request(self) -> None:
        """As the base; the server looks how long it takes to be said."""
        self.server.asking[self.connection] = time.monotonic()
        super().handle_one_request()

    def parse_request(self) -> bool:
        """As the base; an answer goes to those only who ask this server, by a version that has headers."""
        if not super().parse_request():
            return False
        self.server.asking.pop(self.connection, None)
        hosts = self.headers.get_all("Host", []) if self.request_version != "HTTP/0.9" else []
        if len(hosts) == 1 and self.server.answers_to(hosts[0]):
            return True
        self.request_version = self.protocol_version
        self.send_error(HTTPStatus.MISDIRECTED_REQUEST, f"this is {self.server.url}")
        return False

    def end_headers(self) -> None:
        """As the base, with what every answer says."""
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """An error as plain text; the connection ends."""
        body = f"{int(code)} {HTTPStatus(code).phrase}{f': {message}' if message else ''}\n".encode("ascii", "replace")
        self.request_version = self.protocol_version  # a request that cannot be read has none
        self.close_connection = True
        self.send_response(code)
        self.send_header("Connection", "close")
        self.send_header("Content-Type", "text/plain; charset=utf-8")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def do_GET(self) -> None:
        """A file of the site; of HEAD its headers alone."""
        name = unquote(urlsplit(self.path).path).removeprefix("/")
        name += INDEX if name == "" or name.endswith("/") else ""
        body = self.server.site.get(name)
        if body is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", TYPES[PurePosixPath(name).suffix])
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    do_HEAD = do_GET  # noqa: N815  http.server asks for it by this name

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: the terminal shows the address, and stays as it is."""
