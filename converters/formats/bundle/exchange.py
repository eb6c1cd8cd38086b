"""Folders that are written beside their place and exchanged with what was there, so that a killed run leaves no half.

What is written lies in a folder of its own (converters/files/folders.py), ``.export-model-<name>-<random>`` beside the
place: no other is ever swept or put back. Within it, ``new`` is what is being written; on a system
without an exchange, ``old`` is what has been moved out of its place.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from export_model.converters.files.folders import LeftoverWarning, OwnFolder, left_in, sweep, try_lock

_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_PREFIX = ".export-model-"
#: To look through a folder of very many bundles takes long: where it took more than this of the processor (seconds), it
#: is done again no sooner than so many times as long later.
_QUICK, _REST = 2e-4, 100
#: Files that the disk is waited for at a time.
_AT_ONCE = 2
_next_look: dict[tuple[str, Path], float] = {}


@contextlib.contextmanager
def stage(place: Path) -> Iterator[Path]:
    """A new folder to fill, beside ``place``; what is left of it afterwards is removed. Raises OSError."""
    place.parent.mkdir(parents=True, exist_ok=True)
    with _looking("sweep", place.parent) as due:
        if due:
            sweep(place.parent, _PREFIX)
    with OwnFolder(place.parent, f"{_PREFIX}{place.name}-") as outer:
        new = outer / "new"
        new.mkdir()
        new.chmod(0o755)
        yield new


def exchange(new: Path, place: Path) -> None:
    """Put ``new``, the folder of a ``stage``, in its place; what was there goes with the stage. Raises OSError.

    Its content is on the disk (``sync_contents``).
    """
    if not place.exists():
        new.rename(place)
    elif not _exchange(new, place):
        _two_renames(new, place)


def sync_contents(folders: Sequence[Path]) -> None:
    """Wait until all of the folders is on the disk: after a power cut, what has a name has its content.

    Of several, all that lies on their file systems is waited for, in one call each: a call for every file of every
    folder is a wait each. Raises OSError.
    """
    systems = {folder.stat().st_dev: folder for folder in folders}
    if len(folders) < 2 or not all(_sync_file_system(folder) for folder in systems.values()):
        for folder in folders:
            _sync_folder(folder)


def sync_names(places: Sequence[Path]) -> None:
    """Wait until the names of what was exchanged are on the disk; where they are not, that is said by a warning."""
    for parent in dict.fromkeys(place.parent for place in places):
        try:
            _sync(parent)
        except OSError as error:  # all is in its place: that is no failure any more
            lost = ", ".join(str(place) for place in places if place.parent == parent)
            warnings.warn(f"{lost} may be lost in a power cut: {error}", LeftoverWarning, stacklevel=3)


def take_away(place: Path) -> None:
    """Remove a folder: whole, or not at all where the process is killed. Raises OSError."""
    with OwnFolder(place.parent, f"{_PREFIX}{place.name}-") as outer:
        place.rename(outer / "old")


def recover(place: Path) -> None:
    """Put back what a run that was killed between two renames had moved out of ``place``. Raises OSError."""
    if not place.parent.is_dir() or place.exists():
        return
    with _looking("recover", place.parent) as due:
        for left in left_in(place.parent, _PREFIX) if due else ():
            with contextlib.suppress(FileNotFoundError), try_lock(left) as ours:  # another process is done with its own
                if ours is not False and (left / "old" / place.name).is_dir() and not place.exists():
                    (left / "old" / place.name).rename(place)
                    shutil.rmtree(left, ignore_errors=True)


@contextlib.contextmanager
def _looking(purpose: str, folder: Path) -> Iterator[bool]:
    """Whether a folder is to be looked through, which is what happens inside."""
    now, begun = time.monotonic(), time.thread_time()
    due = now >= _next_look.get((purpose, folder), 0.0)
    yield due
    took = time.thread_time() - begun
    if due and took > _QUICK:
        _next_look[purpose, folder] = now + _REST * took


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


def _exchange(a: Path, b: Path) -> bool:
    """renameat2(RENAME_EXCHANGE): both paths change places in one step. Linux only; False where it is not to be had."""
    function = _linux_call("renameat2")
    if function is None:
        return False
    result: int = function(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE)
    return result == 0


def _sync_file_system(folder: Path) -> bool:
    """syncfs: all of a folder's file system is on the disk. Linux only; False where it is not to be had.

    Raises OSError; that a file could not be written is said by Linux 5.8 and later.
    """
    function = _linux_call("syncfs")
    if function is None:
        return False
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        if function(descriptor) != 0:
            number = ctypes.get_errno()
            raise OSError(number, os.strerror(number), str(folder))
    finally:
        os.close(descriptor)
    return True


def _linux_call(name: str) -> Callable[..., int] | None:
    platform: str = sys.platform
    return getattr(ctypes.CDLL(None, use_errno=True), name, None) if platform == "linux" else None


def _sync_folder(folder: Path) -> None:
    inside = [path for place, _, files in os.walk(folder) for path in (Path(place), *(Path(place, f) for f in files))]
    # A few at a time: the disk then waits for several of them at once; to start a thread for each takes longer.
    failed: list[OSError] = []
    threads = [
        threading.Thread(target=_sync_or_note, args=(inside[i::_AT_ONCE], failed), daemon=True)
        for i in range(1, _AT_ONCE)
    ]
    for thread in threads:
        thread.start()
    _sync_or_note(inside[::_AT_ONCE], failed)
    for thread in threads:
        thread.join()
    if failed:
        raise failed[0]


def _sync_or_note(paths: Sequence[Path], failed: list[OSError]) -> None:
    try:
        for path in paths:
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
