"""Where what can be made again is kept: npm packages, old TensorFlow libraries. And how it gets there whole."""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

_STALE_SECONDS = 24 * 3600.0


def cache_folder() -> Path:
    """This program's folder in the user's cache, as each system has it; it need not exist."""
    return _root() / "export-model"


def _root() -> Path:
    platform: str = sys.platform  # as a plain string: type checkers drop the branches of other systems otherwise
    if platform == "win32":
        local = os.environ.get("LOCALAPPDATA")
        return Path(local) if local else Path.home() / "AppData" / "Local"
    if platform == "darwin":
        return Path.home() / "Library" / "Caches"
    xdg = Path(os.environ.get("XDG_CACHE_HOME", ""))
    # The XDG rules: a relative path there is invalid and is to be ignored.
    return xdg if xdg.is_absolute() else Path.home() / ".cache"


@contextlib.contextmanager
def built_beside(target: Path, prefix: str, is_whole: Callable[[Path], bool]) -> Iterator[Path]:
    """An empty folder to fill; at the end of the block it is renamed to ``target``.

    So ``target`` is whole whenever it exists: a run that is killed leaves nothing that a later run would take for an
    installation, only a neighbour whose name starts with ``prefix``, which is removed a day later. A damaged
    ``target`` is replaced; a whole one that another process put there meanwhile is kept. Raises OSError.
    """
    parent = target.parent
    parent.mkdir(parents=True, exist_ok=True)
    sweep(parent, prefix)
    # The neighbour is in the same folder because a rename is atomic within one file system only.
    building = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
    try:
        yield building
        _put_in_place(building, target, prefix, is_whole)
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _put_in_place(building: Path, target: Path, prefix: str, is_whole: Callable[[Path], bool]) -> None:
    """Renames ``building`` to ``target``, over a damaged one, and yields to a whole one that came in between."""
    if target.exists() and not is_whole(target):
        # A folder with contents cannot be renamed over, and deleting it takes time; a rename out of the way does not.
        damaged = Path(tempfile.mkdtemp(prefix=prefix, dir=target.parent))
        target.rename(damaged / "old")
        shutil.rmtree(damaged, ignore_errors=True)
    try:
        building.rename(target)
    except OSError:
        # Another process was faster: its folder holds the same.
        if not is_whole(target):
            raise


def sweep(parent: Path, prefix: str) -> None:
    """Removes what killed runs left, a day later: before that, it may be a run that is still going."""
    for left in parent.glob(f"{prefix}*"):
        with contextlib.suppress(FileNotFoundError):  # its own process may just have removed or renamed it
            if time.time() - left.stat().st_mtime > _STALE_SECONDS:
                shutil.rmtree(left, ignore_errors=True)
