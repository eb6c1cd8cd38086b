"""C#: a class that Mono's compiler makes a program of, with all warnings as errors."""

from __future__ import annotations

import os
import shutil

from export_model.converters.files.children.python import child_command
from export_model.converters.runtimes.base import OWN_WORDS, Runtime, RuntimeInfo
from export_model.signatures.errors import RuntimeUnavailableError

_HOW = "sudo apt-get install mono-mcs mono-runtime" if os.name == "posix" else "mono on Linux or macOS"


def tools() -> tuple[str, str] | None:
    """The paths of Mono's compiler and of Mono."""
    compiler, mono = shutil.which("mcs"), shutil.which("mono")
    return None if compiler is None or mono is None else (compiler, mono)


def _find() -> RuntimeInfo:
    here = tools() is not None and os.name == "posix"
    return RuntimeInfo("csharp", here, None, _HOW, supported=os.name == "posix")


def _command() -> list[str]:
    here = tools()
    if here is None:
        raise RuntimeUnavailableError("Mono is not installed", fix=_HOW)
    return child_command("export_model.converters.runtimes.csharp.child", *here)


#: Its child confines itself: it starts the compiler and Mono.
RUNTIMES = (Runtime("csharp", _find, _command, products_per_second=2e8, confined=False, own_words=OWN_WORDS),)
