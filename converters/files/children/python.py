"""Commands of child processes of this interpreter, and what they start with."""

from __future__ import annotations

import errno
import importlib.util
import os
import shutil
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

#: The package that this module is in. Links are not followed: in a checkout the folders below it are links.
PACKAGE = Path(__file__).absolute().parents[3]
#: Modules come from this very copy of the package, installed or not, and none (-P) from the folder that the user
#: stands in, where ``-c`` looks first: it may be untrusted.
_PYTHON = (sys.executable, "-P", "-c")
_PATH = f"import sys; sys.path.insert(0, {str(PACKAGE.parent)!r}); "


def child_command(module: str, *arguments: str) -> list[str]:
    """The command that runs ``module``."""
    return [*_PYTHON, f"{_PATH}import runpy; runpy.run_module({module!r}, run_name='__main__')", *arguments]


def confined_command(command: Sequence[str], scratch: str) -> list[str]:
    """A command whose process may write below ``scratch`` only, and reach no network, as far as the system offers it.

    Raises FileNotFoundError where there is no such program.
    """
    if os.name != "posix":
        return list(command)
    # The kernel takes the thread that starts a process for its parent: only the main one lives as long as all.
    parent = os.getpid() if threading.current_thread() is threading.main_thread() else 0
    if tuple(command[:3]) == _PYTHON and command[3].startswith(_PATH):
        # A child of ours gives up by itself, before it does anything else: a program for it costs another 30 ms.
        first = "from export_model.converters.files.children import confinement; "
        first += f"confinement.begin({scratch!r}, {parent}); "
        return [*_PYTHON, _PATH + first + command[3].removeprefix(_PATH), *command[4:]]
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), command[0])
    program = str(Path(__file__).resolve().with_name("confinement.py"))
    return [sys.executable, "-I", "-S", program, scratch, str(parent), *command]


def module_origin(name: str) -> str | None:
    """The file of a top-level module, or None. A folder that merely has the name (a namespace) does not count."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a module that something put into sys.modules without a spec
        return None
    return None if spec is None else spec.origin
