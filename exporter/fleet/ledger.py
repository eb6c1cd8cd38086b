"""What was exported to a folder: the next run leaves out what is unchanged, and goes on where one was stopped."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from export_model.converters.files.fetch import address_of, path_text, read_bytes
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.exporter import __version__
from export_model.exporter.export.labels import read_labels
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.fleet.marks import is_marked, mark, read_key
from export_model.exporter.remote.fetching import version
from export_model.exporter.remote.filesystem import remote
from export_model.signatures.contract import POLICY, safe_name
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import BundleError, ExportModelError, SourceError

_NAME = ".exported.jsonl"
#: size, time of the last change in ns, sha256
Stamp = list[Any]
#: of an address what its service says, of a folder its listing, of a file its size and time
State = str | list[int] | None


class Ledger:
    """A line per source in a file of the output folder, appended when its bundles are in their places.

    It is no proof, only a reason not to do work again: a line that is not understood, or that this user did not write
    (``marks``), says nothing.
    """

    def __init__(self, options: ExportOptions, runtimes: Sequence[str]) -> None:
        self._path = options.out / _NAME
        self._out = options.out
        self._key = _key(options, runtimes)
        self._lines: dict[str, Mapping[str, Any]] = {}
        #: what is at an address is not looked at: all is exported
        self._mark = read_key() if address_of(options.out) is None else None
        if os.path.lexists(self._path) and (self._path.is_symlink() or not self._path.is_file()):
            raise BundleError(
                "already exists and is not a file of ours",
                where=str(self._path),
                why="lines are appended to it: behind a link they would change another file",
                fix="remove it, or choose another folder with -o",
            )
        try:
            text = read_bytes(self._path, empty=True).decode() if self._mark and self._path.exists() else ""
        except (SourceError, ValueError):
            text = ""
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                self._lines[entry["source"]] = entry
            except (ValueError, TypeError, KeyError, RecursionError):  # the last line of a run that was killed
                continue

    def unchanged_policies(self, source: Path) -> list[str] | None:
        """The names of a source's policies, where they were exported and all is as it was; else None."""
        entry = self._lines.get(_ledger_name(source), {})
        try:
            same = (
                self._mark is not None
                and is_marked(self._mark, entry)
                and entry.get("options") == self._key
                and _is_as_it_was(source, entry["seen"], entry["files"])
                and all(self._is_whole(name, written) for name, written in entry["policies"].items())
            )
            return [str(name) for name in entry["policies"]] if same else None
        except (OSError, LookupError, TypeError, ValueError, AttributeError, ExportModelError):
            return None

    def _is_whole(self, name: str, written: str) -> bool:
        """Whether a bundle is the one that was written, in each of its files. Raises BundleError, SourceError."""
        if name != safe_name(name) or sha256_hex(read_bytes(self._out / name / POLICY)) != written:
            return False
        Bundle.open(self._out / name).verify_hashes()
        return True

    def record(self, source: Path, seen: State, files: Mapping[str, Stamp], policies: Iterable[str]) -> None:
        """Note that a source was exported, as it was before it was read. Raises BundleError."""
        if self._mark is None:
            return
        try:
            hashes = {n: sha256_hex((self._out / n / POLICY).read_bytes()) for n in policies}
            entry = {
                "source": _ledger_name(source),
                "options": self._key,
                "seen": seen,
                "files": files,
                "policies": hashes,
            }
            entry["mark"] = mark(self._mark, entry)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
        except OSError as error:
            raise BundleError(
                "cannot be written", where=str(self._path), why=error.strerror, fix="free some space"
            ) from error


def state(source: Path) -> State:
    """The state of a source, which is another as soon as the source is; None where nothing tells.

    A run may write a newer checkpoint while this one is exported. Raises SourceError.
    """
    if remote(source) is not None:
        return version(source)
    try:
        return _listing(source) if source.is_dir() else _times(source)
    except (OSError, ValueError):  # its reader says why
        return None


def stamps(source: Path, files: Iterable[Path]) -> dict[str, Stamp]:
    """The stamps that tell whether the files of a source here are as they are now.

    Of a source at an address its state tells that. Raises OSError.
    """
    if address_of(source) is not None:
        return {}
    return {str(f): [*_times(f), sha256_hex(f.read_bytes())] for f in sorted(set(files))}


def _ledger_name(source: Path) -> str:
    """A source in its line; of an address that has a password or a signature its hash."""
    address = address_of(source)
    return path_text(source) if address in (None, path_text(source)) else sha256_hex(str(address).encode())


def _is_as_it_was(source: Path, seen: State, files: Mapping[str, Stamp]) -> bool:
    if address_of(source) is not None:
        return seen is not None and seen == state(source)
    if source.is_dir() and seen != state(source):
        return False
    return bool(files) and all(_is_same(Path(path), stamp) for path, stamp in files.items())


def _is_same(path: Path, stamp: Stamp) -> bool:
    """By size and time, as git does it; a file that was only touched is read."""
    size, time, digest = stamp
    now = _times(path)
    return now == [size, time] or (now[0] == size and sha256_hex(read_bytes(path)) == digest)


def _times(path: Path) -> list[int]:
    found = path.stat()
    return [found.st_size, found.st_mtime_ns]


def _listing(source: Path) -> str:
    inside = sorted(p for p in source.rglob("*") if p.is_file())
    return sha256_hex(repr([(str(p.relative_to(source)), *_times(p)) for p in inside]).encode())


def _key(options: ExportOptions, runtimes: Sequence[str]) -> str:
    """What an export depends on beside its source: options, contents of the files that they name, the version."""
    golden = options.parity.golden
    said = replace(options, out=Path(), verify=tuple(runtimes), labels=None)
    content = None if golden is None else sha256_hex(Path(golden).read_bytes())
    return sha256_hex(repr((__version__, said, read_labels(options.labels), content)).encode())
