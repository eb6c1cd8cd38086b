"""Runtimes that are Python packages, in a child process of this interpreter: is one here, how is its child started."""

from __future__ import annotations

import errno
import importlib.util
import os
import re
import shutil
import sys
import threading
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import converters
from converters.runtimes.base import Runtime, RuntimeInfo


def package_runtime(
    name: str, how: str, distributions: tuple[str, ...], *, independent: bool = True, originals: bool = False
) -> Runtime:
    """The runtime of the package ``name``, whose child is the module ``child`` of the folder of that name here.

    Several of the ``distributions`` may provide the package: the first that is installed tells the version.
    """
    command = partial(child_command, f"converters.runtimes.{name}.child")
    find = partial(_find, name, how, distributions)
    return Runtime(name, find, command, independent=independent, originals=originals)


#: Modules come from this very copy of the packages, installed or not, and none (-P) from the folder that the user
#: stands in, where ``-c`` looks first: it may be a stranger's.
_PYTHON = (sys.executable, "-P", "-c")
_PATH = f"import sys; sys.path.insert(0, {str(Path(converters.__file__).resolve().parent.parent)!r}); "


def child_command(module: str, *arguments: str) -> list[str]:
    """The command that runs ``module``."""
    return [*_PYTHON, f"{_PATH}import runpy; runpy.run_module({module!r}, run_name='__main__')", *arguments]


def confined(command: Sequence[str], scratch: str) -> list[str]:
    """A command whose process may write below ``scratch`` only, and reach no network, as far as the system offers it.

    Raises FileNotFoundError where there is no such program.
    """
    if os.name != "posix":
        return list(command)
    # The kernel takes the thread that starts a process for its parent: only the main one lives as long as all.
    parent = os.getpid() if threading.current_thread() is threading.main_thread() else 0
    if tuple(command[:3]) == _PYTHON and command[3].startswith(_PATH):
        # A child of ours gives up by itself, before it does anything else: a program for it costs another 30 ms.
        first = f"from converters.files.children import confinement; confinement.begin({scratch!r}, {parent}); "
        return [*_PYTHON, _PATH + first + command[3].removeprefix(_PATH), *command[4:]]
    if shutil.which(command[0]) is None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), command[0])
    program = str(Path(converters.__file__).resolve().parent / "files" / "children" / "confinement.py")
    return [sys.executable, "-I", "-S", program, scratch, str(parent), *command]


def module_origin(name: str) -> str | None:
    """The file of a top-level module, or None. A folder that merely has the name (a namespace) does not count."""
    try:
        spec = importlib.util.find_spec(name)
    except ValueError:  # a module that something put into sys.modules without a spec
        return None
    return None if spec is None else spec.origin


def _find(name: str, how: str, distributions: tuple[str, ...]) -> RuntimeInfo:
    origin = module_origin(name)
    return RuntimeInfo(name, origin is not None, None if origin is None else _version(origin, distributions), how)


def _version(origin: str, distributions: tuple[str, ...]) -> str | None:
    """By the folders beside a package; importlib.metadata (25 ms to import) is asked where they are silent."""
    beside = [place.stem.rpartition("-") for place in Path(origin).parent.parent.glob("*-*.dist-info")]
    versions = {re.sub(r"[-_.]+", "-", name).lower(): version for name, _, version in beside}
    for name in distributions:
        if name in versions:
            return versions[name]
    import importlib.metadata

    for name in distributions:
        try:
            return importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return None
