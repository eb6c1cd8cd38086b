"""A source by its address: fetched to a scratch folder, within bounds, for as long as it is worked on."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

from export_model.converters.files.fetch import path_text
from export_model.converters.files.folders import scratch_folder
from export_model.exporter.remote.filesystem import MAX_FILES, Pace, asking, filesystem, is_http, remote
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import ExportModelError, SourceError

#: Bytes of one source: the largest that is read is one of 2 GiB with its weights beside it.
MAX_REMOTE_BYTES = 8 << 30
_CHUNK = 1 << 20
_LONGEST_NAME = 200
#: What tells one version of a file from the next, as file systems call it.
_VERSIONS = (
    *("ETag", "etag", "md5Hash", "md5", "sha256", "blob_id", "LastModified", "last_modified", "mtime", "created"),
    *("Last-Modified", "Content-MD5", "Digest"),
)


@contextlib.contextmanager
def nearby(path: Path) -> Iterator[Path]:
    """The path itself, or where what is at its address lies until the context ends; errors name the address.

    Raises SourceError where it cannot be fetched.
    """
    address = remote(path)
    if address is None:
        yield path
        return
    with scratch_folder() as folder:
        local = _fetch(address, Path(folder))
        try:
            yield local
        except ExportModelError as error:
            name_address(error, local, address)
            raise


def name_address(error: ExportModelError, local: Path, address: str) -> None:
    """Have an error about a copy name the address that it came from."""
    for part in ("what", "where", "why", "fix"):
        if (text := getattr(error, part)) is not None:
            setattr(error, part, text.replace(str(local), path_text(address)))
    error.args = (error.message,)


def version(path: Path) -> str | None:
    """What tells whether a source is as it is now; None where its service does not say. Raises SourceError."""
    address = remote(path)
    assert address is not None
    system, place = filesystem(address)
    with asking(address):
        found = _files(system, place)
    told = [
        (name, info.get("size"), [str(info[key]) for key in _VERSIONS if key in info]) for name, info in found.items()
    ]
    return sha256_hex(repr(told).encode()) if all(known for _, _, known in told) else None


def _fetch(address: str, folder: Path) -> Path:
    system, place = filesystem(address)
    with asking(address):
        found = _files(system, place)
    if not found:
        raise SourceError("there is nothing there", where=path_text(address), fix="check the address")
    if len(found) > MAX_FILES:
        raise SourceError(
            f"has {len(found)} files, and of one source {MAX_FILES} are fetched",
            where=path_text(address),
            fix="give the folder of one run, or a pattern that matches files: **/*.onnx",
        )
    left = MAX_REMOTE_BYTES - sum(info.get("size") or 0 for info in found.values())
    _within(left, address)
    left, top = (
        MAX_REMOTE_BYTES,
        folder / _name(unquote(urlsplit(address).path) if is_http(address) else path_text(address), address),
    )
    with asking(address):  # which may say that a file has files in it, or lies elsewhere
        for name in found:
            inside = PurePosixPath(name).relative_to(place).parts if name != place else ()
            target = top.joinpath(*(_name(part, address) for part in inside))
            target.parent.mkdir(parents=True, exist_ok=True)
            left = _download(system, name, target, left, address)
    return top


def _files(system: Any, place: str) -> Mapping[str, Mapping[str, Any]]:
    """Name → what is known of it: the file itself, or all that lie in the folder, in the order of their names."""
    if is_http(place):  # which has no folders
        return {place: system.info(place)}
    info = system.info(place)
    if info["type"] != "directory":
        return {place: info}
    return dict(sorted(system.find(place, detail=True).items()))


def _download(system: Any, name: str, target: Path, left: int, address: str) -> int:
    """Copy a file; returns what is left of the bytes that one source may have, whatever was said of its size."""
    how = {"block_size": 0} if is_http(name) else {}
    pace = Pace(address)
    with system.open(name, "rb", **how) as source, target.open("xb") as file:
        while chunk := source.read(_CHUNK):
            pace.count(chunk)
            left -= len(chunk)
            _within(left, address)
            file.write(chunk)
    return left


def _within(left: int, address: str) -> None:
    if left < 0:
        raise SourceError(
            f"has more than {MAX_REMOTE_BYTES >> 30} GiB",
            where=path_text(address),
            fix="give the model alone, or download it first",
        )


def _name(path: str, address: str) -> str:
    """The last part of a path, which is going to be a file's name here. Raises SourceError where it cannot be one."""
    name = path.rstrip("/").rpartition("/")[2]
    wrong = not name or name in (".", "..") or len(name) > _LONGEST_NAME or any(c in name for c in "\\\0")
    if wrong or (os.name == "nt" and any(c in name for c in ':*?"<>|')):
        raise SourceError(
            "a file there has a name that it cannot have here", where=path_text(address), why=repr(name[:80])
        )
    return name
