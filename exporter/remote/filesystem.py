"""The file system behind an address. fsspec is imported when there is one, and not before.

Only what is named in ``FETCHED`` is asked for: fsspec also knows protocols that read this machine's files (``file``,
``local``, ``dir``), run what they are told (``reference``, ``dask``), or stand in front of others
(``simplecache::``, ``zip::``), and a list of addresses may be untrusted.
"""

from __future__ import annotations

import contextlib
import fnmatch
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

from export_model.converters.files.fetch import FETCHED, address_of, fetches, path_text
from export_model.signatures.errors import BundleError, ExportModelError, SourceError, UsageError

#: Files of one source, or links of one level of a web server's pages; bytes of these pages.
MAX_FILES = 4096
MAX_LISTING = 16 << 20
_CHUNK = 1 << 20
_MAGIC = "*["
_LINK = re.compile(r"""\bhref\s*=\s*["']?([^"'\s>]+)""", re.IGNORECASE)
#: In the text of an error.
_ADDRESS = re.compile(r"\b[a-z0-9]+://[^\s'\"<>]+")


def remote(path: Path) -> str | None:
    """The address that a path is, where addresses like it are fetched; else None: a reader says what is wrong then."""
    address = address_of(path)
    if address is None or "::" in address or address.partition("://")[0] not in FETCHED or not fetches():
        return None
    return address


def filesystem(address: str) -> tuple[Any, str]:
    """The file system of fsspec, and its spelling of the address. Raises UsageError where what it needs is missing."""
    import fsspec

    try:
        system, path = fsspec.core.url_to_fs(address, **(_manner() if is_http(address) else {}))
    except ImportError as error:
        raise UsageError(
            f"{address.partition('://')[0]}:// needs another package",
            where=path_text(address),
            why=str(error),
            fix="install it beside export-model",
        ) from error
    return system, str(path)


def is_http(address: str) -> bool:
    """Whether a web server has it."""
    return address.startswith(("http://", "https://"))


def _manner() -> dict[str, Any]:
    """How long a web server may be silent; aiohttp's own five minutes are for all of a file, however large.

    Files come as they are: packed on the way, a small answer would fill the disk. Where a server sends on to, is looked
    at (``redirects``).
    """
    import aiohttp

    from export_model.exporter.remote.redirects import guarded_client

    timeout = aiohttp.ClientTimeout(total=6 * 3600, sock_connect=30, sock_read=60)
    headers = {"Accept-Encoding": "identity"}
    return {
        "get_client": guarded_client,
        "client_kwargs": {"timeout": timeout, "headers": headers, "auto_decompress": False},
    }


class Pace:
    """How fast a server sends. One that sends a byte now and then would be waited for, for hours."""

    #: Seconds that are not looked at; bytes a second, on average, from then on.
    FREE, LEAST = 60.0, 4096

    def __init__(self, address: str) -> None:
        self._address = address
        self._start = time.monotonic()
        self._bytes = 0

    def count(self, chunk: bytes) -> None:
        """Note what came. Raises SourceError where it is too little for the time."""
        self._bytes += len(chunk)
        seconds = time.monotonic() - self._start
        if seconds > self.FREE and self._bytes < self.LEAST * (seconds - self.FREE):
            raise SourceError(
                "comes too slowly",
                where=path_text(self._address),
                why=f"{self._bytes} bytes came in {seconds:.0f} s, and {self.LEAST} a second are waited for",
                fix="download it first, and give the file",
            )


@contextlib.contextmanager
def asking(address: str, *, writes: bool = False) -> Iterator[None]:
    """Whatever a service or the library that speaks to it says inside is an error about the address."""
    kind = BundleError if writes else SourceError
    try:
        yield
    except ExportModelError:
        raise
    except Exception as error:  # each library has its own
        # fsspec calls whatever a web server or the way there says a missing file; what it was stands behind it
        said = error.__cause__ if isinstance(error, FileNotFoundError) and is_http(address) else None
        said = error if said is None else said
        if isinstance(said, FileNotFoundError):
            raise kind("no such file", where=path_text(address), fix="check the address") from error
        raise kind(
            "cannot be written" if writes else "cannot be fetched",
            where=path_text(address),
            why=f"{type(said).__name__}: {_ADDRESS.sub(lambda found: path_text(found[0]), str(said))}",
            fix="check the address, your rights there, and the connection",
        ) from error


def is_pattern(address: str) -> bool:
    """Whether it stands for several; a ? begins a query, and a host may have brackets (IPv6)."""
    inside = address.partition("://")[2].partition("/")[2] if is_http(address) else address
    return any(sign in inside for sign in _MAGIC)


def matching(address: str) -> list[Path]:
    """The files that a pattern finds, by name. Raises SourceError, UsageError."""
    if is_http(address):
        return _linked_files(address)
    system, pattern = filesystem(address)
    with asking(address):
        found = [p for p, info in system.glob(pattern, detail=True).items() if info.get("type") == "file"]
    scheme = address.partition("://")[0]
    found = [p if "://" in p else f"{scheme}://{p.lstrip('/')}" for p in found]
    fixed = address[: min(address.find(sign) for sign in _MAGIC if sign in address)].rpartition("/")[0]
    # A listing is what a server says: nothing of another one is fetched.
    return [Path(each) for each in sorted(found) if each.startswith(f"{fixed}/")]


def _linked_files(address: str) -> list[Path]:
    """The files of a web server that a pattern finds, by the links of its pages, level by level."""
    if "**" in address:
        raise UsageError(
            "** is not for a web server",
            where=path_text(address),
            why="its pages may link without end",
            fix="give a pattern for each level (*/*.onnx), or a list of addresses in a .txt",
        )
    system, _ = filesystem(address)
    scheme, _, rest = address.partition("://")
    import html  # 2 ms of every start

    place, *parts = rest.split("/")
    tops, size = [f"{scheme}://{place}"], 0
    first = next(number for number, part in enumerate(parts) if is_pattern(part))
    for number, part in enumerate(parts):
        if number < first:
            tops = [f"{top}/{part}" for top in tops]
            continue
        pattern = re.compile(fnmatch.translate(part.replace("?", "[?]")))  # which begins a query
        end = "/" if number < len(parts) - 1 else ""  # as a folder's link has it
        found = set[str]()
        pace = Pace(address)
        for top in tops:
            text = bytearray()
            with asking(address), system.open(f"{top}/", "rb", block_size=0) as page:
                while size <= MAX_LISTING and (chunk := page.read(_CHUNK)):
                    pace.count(chunk)
                    text += chunk
                    size += len(chunk)
            for link in _LINK.findall(text.decode(errors="replace")):
                # What a page says: nothing of another place is fetched.
                each = urljoin(f"{top}/", html.unescape(link))
                above, _, name = each.removesuffix(end).rpartition("/")
                if each.endswith(end) and above == top and name[:1] not in ("", "?", "#") and pattern.match(name):
                    found.add(f"{top}/{name}")
            if size > MAX_LISTING or len(found) > MAX_FILES:
                raise SourceError(
                    "lists more than is read",
                    where=path_text(address),
                    why=f"of all levels {MAX_LISTING >> 20} MiB and of each {MAX_FILES} links are read",
                    fix="give a narrower pattern, or a list of addresses in a .txt",
                )
        tops = sorted(found)
    return [Path(top) for top in tops]
