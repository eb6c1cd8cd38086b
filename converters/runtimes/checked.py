"""Installed parts are what was known when this version was made, each time that they are used.

What is looked at is the sha256 of every file that is loaded. It is not computed again for a file that has not changed
since it was found right: its size, its inode, and the times of its last change, of which ``ctime`` is the system's own.
A folder that a cache brought back, or somebody wrote to, is read again. It is no help against who can write as the
user: that one needs no part of ours.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path

from signatures.digest import sha256_hex
from signatures.errors import RuntimeUnavailableError

#: The file, in the folder, of what was found right: name → the hash and what told then that nothing has changed.
STAMP = ".export-model-checked.json"


def check(folder: Path, known: Mapping[str, str], fix: str) -> None:
    """Hold the files of ``folder`` against ``known``, their sha256 by their names; what is not there is not loaded.

    Raises RuntimeUnavailableError that names the first which is another.
    """
    seen = _read(folder / STAMP)
    found: dict[str, list[object]] = {}
    for name, digest in known.items():
        path = folder / name
        try:
            state = path.stat()
            told: list[object] = [digest, state.st_size, state.st_ino, state.st_mtime_ns, state.st_ctime_ns]
            right = seen.get(name) == told or sha256_hex(path.read_bytes()) == digest
        except FileNotFoundError:
            continue
        except OSError as error:
            raise RuntimeUnavailableError("cannot be read", where=str(path), why=error.strerror, fix=fix) from error
        if not right:
            raise RuntimeUnavailableError(
                "is not the file that was installed",
                where=str(path),
                why="its sha256 is not the one that this version of export-model knows: it was changed, or cut off",
                fix=f"remove {folder}, then: {fix}",
            )
        found[name] = told
    if found != seen:
        _write(folder / STAMP, found)


def _read(path: Path) -> dict[str, list[object]]:
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _write(path: Path, content: Mapping[str, list[object]]) -> None:
    """Whole or not at all; a folder that cannot be written is read again each time."""
    beside = path.with_name(f"{path.name}.{os.getpid()}")
    with contextlib.suppress(OSError):
        beside.write_text(json.dumps(content), encoding="utf-8")
        beside.replace(path)
