"""C: a header that a C compiler makes a library of, with all warnings as errors."""

from __future__ import annotations

import os
import shutil

from export_model.converters.files.children.python import child_command
from export_model.converters.runtimes.base import OWN_WORDS, Runtime, RuntimeInfo
from export_model.signatures.errors import RuntimeUnavailableError

#: In the order in which they are looked for.
COMPILERS = ("gcc", "clang")
_HOW = "sudo apt-get install gcc" if os.name == "posix" else "gcc or clang on Linux or macOS"


def compiler() -> str | None:
    """The path of the first compiler that is here."""
    return next((found for found in map(shutil.which, COMPILERS) if found), None)


def _find() -> RuntimeInfo:
    here = compiler() if os.name == "posix" else None
    return RuntimeInfo("c", here is not None, None, _HOW, supported=os.name == "posix")


def _command() -> list[str]:
    program = compiler()
    if program is None:
        raise RuntimeUnavailableError("no C compiler is installed", fix=_HOW)
    return child_command("export_model.converters.runtimes.c.child", program)


#: Its child confines itself: the compiler is a process that it starts.
RUNTIMES = (Runtime("c", _find, _command, confined=False, own_words=OWN_WORDS),)
