"""Where what can be made again is kept: npm packages, old TensorFlow libraries. And how it gets there whole."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from converters.bundle.exchange import exchange, stage


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
def built_beside(target: Path, is_whole: Callable[[Path], bool]) -> Iterator[Path]:
    """An empty folder to fill; at the end of the block it is put in the place of ``target``.

    So ``target`` is whole whenever it exists: a run that is killed leaves nothing that a later run would take for an
    installation. A damaged ``target`` is replaced; a whole one that another process put there meanwhile is kept.
    Raises OSError.
    """
    with stage(target) as building:
        yield building
        if not is_whole(target):
            exchange(building, target)
