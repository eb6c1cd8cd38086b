"""How a module of this project is run as a program."""

from __future__ import annotations

import sys
from pathlib import Path

import converters


def child_command(module: str, *arguments: str) -> list[str]:
    """The command that runs ``module`` from this very copy of the packages, installed or not."""
    root = str(Path(converters.__file__).resolve().parent.parent)
    start = f"import sys, runpy; sys.path.insert(0, {root!r}); "
    return [sys.executable, "-c", f"{start}runpy.run_module({module!r}, run_name='__main__')", *arguments]
