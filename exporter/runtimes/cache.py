"""Where what can be made again is kept: npm packages, old TensorFlow libraries."""

from __future__ import annotations

import os
import sys
from pathlib import Path


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
