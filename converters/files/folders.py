"""Folders of our own, beside a bundle or for scratch: gone with the block that they are for, or swept by the next run.

A folder says in a file whose it is, and is held by a lock as long as its process lives: what lies there unheld was left
by one that was killed. Nothing else is ever swept: not a folder that is called alike, nor one of another user's.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import stat
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

#: The file that says whose a folder is, and what it says.
MARKER, OURS = "stage.txt", b"export-model writes here, and removes this folder when it is done\n"
#: Where a lock cannot be asked for (Windows, some file systems), what is older may be swept.
_STALE_SECONDS = 24 * 3600.0
_SCRATCH = "export-model-"
_RANDOM = 8
#: Folders that this process has not removed yet → the descriptor that holds each.
_LIVE: dict[Path, int | None] = {}
_swept: set[Path] = set()


class LeftoverWarning(UserWarning):
    """The job is done, but something of its own could not be removed or made certain."""


class OwnFolder:
    """A new folder in ``parent``, called by ``prefix``; gone when it is closed. Raises OSError."""

    def __init__(self, parent: Path, prefix: str) -> None:
        for _ in range(100):
            self.path = parent / f"{prefix}{os.urandom(_RANDOM).hex()}"
            _LIVE[self.path] = None  # before it is there: whenever this process is told to stop, it is known
            try:
                self.path.mkdir(0o700)
                _LIVE[self.path] = _lock_folder(self.path)
                (self.path / MARKER).write_bytes(OURS)
            except (FileExistsError, FileNotFoundError):  # the name is taken; or another run swept it, yet unmarked
                _forget(self.path)
                if not parent.is_dir():
                    raise
                continue
            except OSError:
                _remove(self.path)
                raise
            return
        raise FileExistsError(17, "no name is free", str(parent))

    def close(self) -> None:
        """Remove it; what cannot be removed is said by a warning, since it is no fault of what was done in it."""
        if self.path in _LIVE:
            _remove(self.path)

    def __enter__(self) -> Path:
        return self.path

    def __exit__(self, *error: object) -> None:
        self.close()


def scratch_folder() -> OwnFolder:
    """A folder for temporary files. Raises OSError."""
    sweep_scratch()
    return OwnFolder(Path(tempfile.gettempdir()), _SCRATCH)


def sweep_scratch() -> None:
    """Remove the folders for temporary files that killed runs have left; every run does so, once."""
    place = Path(tempfile.gettempdir())
    if place not in _swept:  # it may hold a great many files of others
        _swept.add(place)
        sweep(place, _SCRATCH)


def live_folders() -> tuple[Path, ...]:
    """The folders of this process's own that are there now."""
    return tuple(_LIVE)


def link_model(path: Path, folder: Path) -> Path:
    """Give a model a second place in a new ``folder``: hard links, or copies where there can be none. Raises OSError.

    ``path`` is a folder, with all in it, or a file, with those that are called after it (``<file>.data``,
    ``<name>.weights.bin``).
    """
    if path.is_dir():
        files = [Path(place, name) for place, _, names in os.walk(path) for name in names]
    else:
        names = (f"{path.name}.", f"{path.stem}.weights.")
        files = [path, *(p for p in path.parent.iterdir() if p.name.startswith(names) and p.is_file())]
    for file in files:
        place = folder / file.relative_to(path.parent)
        place.parent.mkdir(parents=True, exist_ok=True)
        _link_file(file.resolve(), place)
    return folder / path.name


def _link_file(file: Path, place: Path) -> None:
    try:
        if file.stat().st_uid == os.getuid():  # another's may be closed to a child of root, which is root no more
            place.hardlink_to(file)
            return
    except (OSError, AttributeError):  # another file system, or none with links; Windows
        place.unlink(missing_ok=True)
    shutil.copyfile(file, place)


def remove_all() -> None:
    """Remove what this process still has: it was told to stop, perhaps in the middle of removing it."""
    for path in list(_LIVE):
        if not _holds_something_old(path):
            _remove(path)


def sweep(parent: Path, prefix: str) -> None:
    """Remove what killed runs have left in ``parent``."""
    for left in left_in(parent, prefix):
        with contextlib.suppress(OSError), try_lock(left) as ours:  # another run may sweep, too
            if ours is None:
                ours = time.time() - left.stat().st_mtime >= _STALE_SECONDS
            if ours and not _holds_something_old(left):
                shutil.rmtree(left, ignore_errors=True)


@contextlib.contextmanager
def try_lock(path: Path) -> Iterator[bool | None]:
    """Whether nobody who lives holds a folder of ours; then nobody else can until the block ends.

    None where that cannot be known. Raises OSError.
    """
    try:
        descriptor = _lock_folder(path)
    except FileExistsError:
        yield False
        return
    try:
        yield None if descriptor is None else True
    finally:
        if descriptor is not None:
            os.close(descriptor)


def left_in(parent: Path, prefix: str) -> Iterator[Path]:
    """The folders of ours in ``parent``, whoever may hold them."""
    named = re.compile(rf"{re.escape(prefix)}.*[0-9a-f]{{{2 * _RANDOM}}}")
    with contextlib.suppress(OSError), os.scandir(parent) as entries:
        for entry in sorted((e for e in entries if named.fullmatch(e.name)), key=lambda e: e.name):
            with contextlib.suppress(OSError):
                if _is_ours(Path(entry.path)):
                    yield Path(entry.path)


def _is_ours(path: Path) -> bool:
    found = path.lstat()
    if not stat.S_ISDIR(found.st_mode) or (hasattr(os, "getuid") and found.st_uid != os.getuid()):
        return False
    inside = [entry.name for entry in path.iterdir()]
    if not inside:  # killed before it was marked
        return True
    said = (path / MARKER).read_bytes() if MARKER in inside and not (path / MARKER).is_symlink() else None
    return said == OURS or (said is not None and inside == [MARKER] and OURS.startswith(said))


def _holds_something_old(path: Path) -> bool:
    """Whether a bundle lies in it that was moved out of its place (bundle/exchange.py)."""
    return any((path / "old").glob("*"))


def _lock_folder(path: Path) -> int | None:
    """A descriptor that locks the folder until it is closed, or this process ends; None: there are no locks here.

    Raises FileExistsError where another holds it, OSError.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise FileExistsError(17, "it is held", str(path)) from None
    except OSError:  # a file system without locks
        os.close(descriptor)
        return None
    return descriptor


def _remove(path: Path) -> None:
    failed: list[BaseException] = []
    with contextlib.suppress(OSError):
        if [inside.name for inside in path.iterdir()] == [MARKER]:  # nearly always; an empty one is known for ours, too
            (path / MARKER).unlink()
            path.rmdir()
            _forget(path)
            return
    shutil.rmtree(path, onerror=lambda function, place, error: failed.append(error[1]))
    if path.exists():
        why = f": {failed[0]}" if failed else ""
        warnings.warn(f"{path} could not be removed, and may be deleted{why}", LeftoverWarning, stacklevel=3)
    _forget(path)


def _forget(path: Path) -> None:
    descriptor = _LIVE.pop(path, None)
    if descriptor is not None:
        os.close(descriptor)


def size_of(path: Path) -> int:
    """The bytes of a file, or of all in a folder; 0 where nothing is."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(f.stat().st_size for f in files if f.is_file())


def natural_order(path: Path) -> list[list[str | int]]:
    """Sort key of paths in the order that people expect: m2 before m10."""
    parts = (re.split("([0-9]+)", part) for part in path.parts)
    return [[int(word) if i % 2 else word for i, word in enumerate(words)] for words in parts]
