"""Folders that are written beside their place and exchanged with what was there, so that a killed run leaves no half.

What is written lies in a folder of its own, ``.export-model-<name>-<random>`` beside the place, with a file in it that
says whose it is: nothing else is ever swept or put back. Within it, ``new`` is what is being written; on a system
without an exchange, ``old`` is what has been moved out of its place.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

_STALE_SECONDS = 24 * 3600.0
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_PREFIX = ".export-model-"
#: The file that says whose a folder is, and what it says.
_MARKER, _OURS = "stage.txt", b"export-model writes here, and removes this folder when it is done\n"


@contextlib.contextmanager
def stage(place: Path) -> Iterator[Path]:
    """A new folder to fill, beside ``place``; what is left of it afterwards is removed. Raises OSError."""
    place.parent.mkdir(parents=True, exist_ok=True)
    sweep(place.parent)
    outer = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{place.name}-", dir=place.parent))
    try:
        (outer / _MARKER).write_bytes(_OURS)
        new = outer / "new"
        new.mkdir()
        new.chmod(0o755)
        yield new
    finally:
        shutil.rmtree(outer, ignore_errors=True)


def exchange(new: Path, place: Path) -> None:
    """Put ``new``, the folder of a ``stage``, in its place; what was there goes with the stage. Raises OSError."""
    _synced(new)
    if not place.exists():
        new.rename(place)
    elif not _exchanged(new, place):
        _two_renames(new, place)
    _sync(place.parent)


def recover(place: Path) -> None:
    """Put back what a run that was killed between two renames had moved out of ``place``. Raises OSError."""
    if place.parent.is_dir() and not place.exists():
        for left in _stages(place.parent):
            if (left / "old" / place.name).is_dir() and not place.exists():
                (left / "old" / place.name).rename(place)
                shutil.rmtree(left, ignore_errors=True)


def sweep(parent: Path) -> None:
    """Remove what killed runs left in ``parent``, a day later: before that, it may be a run that is still going."""
    for left in _stages(parent):
        with contextlib.suppress(OSError):  # its own process may just have renamed or removed it
            if time.time() - left.stat().st_mtime > _STALE_SECONDS and not any((left / "old").glob("*")):
                shutil.rmtree(left)


def _stages(parent: Path) -> Iterator[Path]:
    """The folders of ours that runs have left in ``parent``, or still write to."""
    for found in sorted(parent.glob(f"{_PREFIX}*")):
        with contextlib.suppress(OSError):
            if not found.is_symlink() and (found / _MARKER).read_bytes() == _OURS:
                yield found


def _two_renames(new: Path, place: Path) -> None:
    """For systems without an exchange. If the process dies in between, the next run puts the old one back (recover)."""
    old = new.parent / "old" / place.name
    old.parent.mkdir()
    place.rename(old)
    try:
        new.rename(place)
    except OSError:
        old.rename(place)
        raise


def _exchanged(a: Path, b: Path) -> bool:
    """renameat2(RENAME_EXCHANGE): both paths change places in one step. Linux only; False where it is not to be had."""
    platform: str = sys.platform
    if platform != "linux":
        return False
    function = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if function is None:
        return False
    result: int = function(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE)
    return result == 0


def _synced(folder: Path) -> None:
    """Wait until all of a folder is on the disk: after a power cut, what has a name has its content."""
    inside = [folder, *folder.rglob("*")]
    # Side by side: the disk then waits once for all of them, not once for each.
    failed: list[OSError] = []
    threads = [threading.Thread(target=_sync_or_note, args=(path, failed)) for path in inside]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failed:
        raise failed[0]


def _sync_or_note(path: Path, failed: list[OSError]) -> None:
    try:
        _sync(path)
    except OSError as error:
        failed.append(error)


def _sync(path: Path) -> None:
    if os.name == "nt" and path.is_dir():  # Windows opens no folders
        return
    if path.is_symlink():
        return
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
