"""Serves a site from memory: only the names it holds, so there is nothing to traverse to."""

from __future__ import annotations

import signal
import socketserver
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import PurePosixPath
from urllib.parse import unquote, urlsplit

from signatures.errors import UsageError

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
}


class SiteServer(ThreadingHTTPServer):
    """Listens from the moment it is made; ``url`` is where the page is."""

    def __init__(self, site: Mapping[str, bytes], host: str, port: int) -> None:
        self.site = site
        super().__init__((host, port), _Handler)

    def server_bind(self) -> None:
        """Without HTTPServer's look-up of the machine's name, which takes seconds where no network answers."""
        socketserver.TCPServer.server_bind(self)

    @property
    def url(self) -> str:
        """The page's address, with the port that was taken."""
        host, port = self.server_address[:2]
        return f"http://{host if isinstance(host, str) else host.decode()}:{port}/"


@contextmanager
def until_interrupted() -> Iterator[None]:
    """Ctrl-C and SIGTERM end the block, and are no errors, whatever was inherited: a job in the background ignores
    SIGINT unless it says otherwise.
    """
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    except KeyboardInterrupt:
        pass
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
            f"{host}:{port} cannot be listened on", why=str(error), fix="give another --port; 0 takes a free one"
        ) from error
    with server:
        yield server


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: SiteServer

    def do_GET(self) -> None:
        """A file of the site."""
        self._answer(with_body=True)

    def do_HEAD(self) -> None:
        """Its headers."""
        self._answer(with_body=False)

    def _answer(self, *, with_body: bool) -> None:
        name = unquote(urlsplit(self.path).path).removeprefix("/") or INDEX
        body = self.server.site.get(name)
        if body is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", TYPES[PurePosixPath(name).suffix])
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-cache")  # the next policy may be served from the same address
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        if with_body:
            self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Nothing: the terminal shows the address, and stays as it is."""
