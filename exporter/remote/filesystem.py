"""The file system behind an address. fsspec is imported when there is one, and not before.

Only what is named in ``FETCHED`` is asked for: fsspec also knows protocols that read this machine's files (``file``,
``local``, ``dir``), run what they are told (``reference``, ``dask``), or stand in front of others
(``simplecache::``, ``zip::``), and a list of addresses may be a stranger's.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from converters.fetch import FETCHED, address_of, fetches, shown
from signatures.errors import BundleError, ExportModelError, SourceError, UsageError

_MAGIC = "*["
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
        system, path = fsspec.core.url_to_fs(address)
    except ImportError as error:
        raise UsageError(
            f"{address.partition('://')[0]}:// needs another package",
            where=shown(address),
            why=str(error),
            fix="install it beside export-model",
        ) from error
    return system, str(path)


@contextlib.contextmanager
def asking(address: str, *, writes: bool = False) -> Iterator[None]:
    """Whatever a service or the library that speaks to it says inside is an error about the address."""
    kind = BundleError if writes else SourceError
    try:
        yield
    except ExportModelError:
        raise
    except FileNotFoundError as error:
        raise kind("there is no such file", where=shown(address), fix="check the address") from error
    except Exception as error:  # each library has its own
        raise kind(
            "cannot be written" if writes else "cannot be fetched",
            where=shown(address),
            why=f"{type(error).__name__}: {_ADDRESS.sub(lambda found: shown(found[0]), str(error))}",
            fix="check the address, your rights there, and the connection",
        ) from error


def is_pattern(address: str) -> bool:
    """Whether it stands for several; a ? begins a query."""
    return any(sign in address for sign in _MAGIC)


def matching(address: str) -> list[Path]:
    """The files that a pattern finds, by name. Raises SourceError."""
    system, pattern = filesystem(address)
    with asking(address):
        found = [p for p, info in system.glob(pattern, detail=True).items() if info.get("type") == "file"]
    scheme = address.partition("://")[0]
    found = [p if "://" in p else f"{scheme}://{p.lstrip('/')}" for p in found]
    fixed = address[: min(address.find(sign) for sign in _MAGIC if sign in address)].rpartition("/")[0]
    # A listing is what a server says: nothing of another one is fetched.
    return [Path(each) for each in sorted(found) if each.startswith(f"{fixed}/")]
