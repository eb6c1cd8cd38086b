"""TensorFlow 1.4 and 1.7, the C libraries of 2017 and 2018 that Unity's TensorFlowSharp drove.

Their wheels, which pip still serves, hold two shared objects with all of the C API; nothing else of the wheels is kept,
and no Python of that age is needed. They lie in the user's cache folder, fetched by ``export-model runtimes install``.
Linux on x86-64 with glibc only.
"""

from __future__ import annotations

import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path

from msgspec import Struct

from export_model.converters.runtimes.installed import cache_folder

API_LIBRARY = "_pywrap_tensorflow_internal.so"
#: The API library finds the other one beside itself (RUNPATH $ORIGIN).
LIBRARIES = ("libtensorflow_framework.so", API_LIBRARY)


class Release(Struct, frozen=True):
    """A version, and the sha256 of its wheel for CPython 3.6, manylinux1, x86-64."""

    runtime: str
    version: str
    sha256: str
    megabytes: int  # to download
    #: sha256 of the libraries as they lie in the cache folder (install.py changes one of them)
    libraries: Mapping[str, str]


RELEASES = (
    Release(
        "tf1.4",
        "1.4.0",
        "972724621a25d136799959cd03ef77b0cca6e1799cd3448f05514bc519b735ad",
        41,
        {
            LIBRARIES[0]: "8e022d7ca068923a6eeaab1b2cffcbfc45abcbd2972d78fb9e5e580de73fdf84",
            LIBRARIES[1]: "cfedf3c73d4f3c4048ff481b4a744bf9211021468ac93f23b203872b4631200d",
        },
    ),
    Release(
        "tf1.7",
        "1.7.1",
        "6f18752f79f0e037e0e4298d375dabb233394d5dcbf513b35cfb544e5d78b479",
        48,
        {
            LIBRARIES[0]: "7513aba1c20f9f7ad943bf8134bc1af3bb6533a905e916c416c33f3957668609",
            LIBRARIES[1]: "6a613925c23ad36cbb8706e725c07c29bfd5d5e578aa1d4a139402d3f97d69a4",
        },
    ),
)


def unsupported_reason() -> str | None:
    """Why these runtimes cannot run on this machine, or None."""
    if (sys.platform, platform.machine()) == ("linux", "x86_64") and _has_glibc():
        return None
    return "TensorFlow 1.4 and 1.7 are there for Linux on x86-64 with glibc only"


def _has_glibc() -> bool:
    try:
        return (os.confstr("CS_GNU_LIBC_VERSION") or "").startswith("glibc")
    except (ValueError, OSError):  # musl knows no such name
        return False


def library_folder(release: Release) -> Path:
    """Where the libraries of a version lie; it need not exist."""
    return cache_folder() / f"tf-{release.version}"


def is_whole(folder: Path) -> bool:
    """Whether the libraries are there; in a cache that may not be read they are not."""
    try:
        return all((folder / name).is_file() for name in LIBRARIES)
    except PermissionError:
        return False


def how(release: Release) -> str:
    """The command that installs a version."""
    return f"export-model runtimes install {release.runtime}"
