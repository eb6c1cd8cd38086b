"""What a child process starts with: a short list of variables, and the places that it may read.

The caller's variables hold tokens and passwords, and its folders keys; a model needs neither. The places are the
system's programs and libraries, the interpreter's own, its packages, and what the command names; all else that a child
reads is handed to it (process.py).
"""

from __future__ import annotations

import os
import shutil
import site
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path

from export_model.converters.files.children.confinement import READABLE
from export_model.converters.files.children.python import PACKAGE

#: Variables that a child is given where they are set, and what reads them.
_KEPT = frozenset((
    *("PATH", "LANG", "LANGUAGE", "TZ"),  # all
    *("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "NIX_LD", "NIX_LD_LIBRARY_PATH"),  # the loader of programs
    *("PYTHONPATH", "PYTHONHOME", "PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX", "PYTHONNOUSERSITE"),  # Python
    *("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_CORETYPE", "KMP_DUPLICATE_LIB_OK"),  # products of matrices
    *("TF_CPP_MIN_LOG_LEVEL", "TF_ENABLE_ONEDNN_OPTS", "TF_USE_LEGACY_KERAS", "KERAS_BACKEND"),  # TensorFlow
    *("TF_NUM_INTRAOP_THREADS", "TF_NUM_INTEROP_THREADS", "CUDA_VISIBLE_DEVICES"),
    *("CPATH", "C_INCLUDE_PATH", "LIBRARY_PATH", "COMPILER_PATH", "GCC_EXEC_PREFIX"),  # gcc, clang
    *("SDKROOT", "DEVELOPER_DIR", "MONO_PATH", "MONO_CFG_DIR"),  # clang of macOS; Mono
    *("SYSTEMROOT", "SYSTEMDRIVE", "WINDIR", "COMSPEC", "PATHEXT", "NUMBER_OF_PROCESSORS"),  # Windows
    *("PROGRAMFILES", "PROGRAMFILES(X86)", "PROGRAMDATA", "LOCALAPPDATA", "APPDATA", "USERPROFILE"),
))  # fmt: skip
#: Those of a browser, whose profile lies where the user's temporary files do (a snap has it below HOME).
_BROWSERS = frozenset(("HOME", "TMPDIR", "TMP", "TEMP", "XDG_RUNTIME_DIR", "FONTCONFIG_PATH", "FONTCONFIG_FILE"))
#: Of numpy's matrix products: what they give does not depend on the machine's processors, and many sources are
#: exported by a process for each of these.
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}

#: Of the system: programs, libraries and their settings, what tells of the machine. None of it is a secret.
_SYSTEM = (
    *("/usr", "/bin", "/sbin", "/lib", "/lib32", "/lib64", "/libx32", "/nix/store", "/gnu/store"),
    "/home/linuxbrew/.linuxbrew",
    *("/etc/ld.so.cache", "/etc/ld.so.conf", "/etc/ld.so.conf.d", "/etc/ld.so.preload", "/etc/localtime"),
    *("/etc/alternatives", "/etc/nsswitch.conf", "/etc/passwd", "/etc/group", "/etc/os-release", "/etc/mono"),
    *("/etc/ssl/openssl.cnf", "/etc/pki/tls/openssl.cnf", "/etc/crypto-policies"),
    *("/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/sys/devices/system", "/sys/fs/cgroup"),
    *("/sys/kernel/mm/transparent_hugepage", "/sys/kernel/mm/hugepages"),
    *("/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/proc/loadavg", "/proc/version", "/proc/filesystems"),
    *("/proc/sys/vm", "/proc/sys/kernel/osrelease", "/proc/sys/kernel/ostype", "/proc/sys/kernel/threads-max"),
)
#: Where programs are kept apart from the system's (an environment of Python, conda, nvm), in these folders of a prefix.
_PREFIX = ("bin", "lib", "lib32", "lib64", "libexec", "include", "pyvenv.cfg")
_PACKAGES = ("site-packages", "dist-packages")


def child_environment(scratch: Path | None, readable: Sequence[str] = ()) -> dict[str, str]:
    """The variables of a child that has a folder of its own, and reads ``readable``; of a browser without one."""
    kept = _KEPT if scratch is not None else _KEPT | _BROWSERS
    variables = {n: v for n, v in os.environ.items() if n.upper() in kept or n.startswith("LC_")} | _ONE_THREAD
    if scratch is not None:
        variables |= dict.fromkeys(("HOME", "TMPDIR", "TMP", "TEMP"), str(scratch))
        variables["PYTHONUSERBASE"] = site.getuserbase()  # which lies in HOME
        variables[READABLE] = "\n".join(place for place in readable if "\n" not in place)
    return variables


def readable_places(command: Sequence[str]) -> tuple[str, ...]:
    """The places that a command's process reads before it is handed anything. Linux only: elsewhere none."""
    if sys.platform != "linux":
        return ()
    return (*_SYSTEM, *_places_of_python(tuple(sys.path)), *_places_of_command(tuple(command)))


@cache
def _places_of_python(path: tuple[str, ...]) -> tuple[str, ...]:
    prefixes = [place for prefix in (sys.prefix, sys.base_prefix) for place in _of_prefix(Path(prefix))]
    found = [*prefixes, *os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)]
    found += [f"{PACKAGE.parent}/", f"{PACKAGE}/", str(PACKAGE / "__init__.py")]
    # In a checkout these two are links, and the kernel asks where they lead.
    found += [str((PACKAGE / name).resolve()) for name in ("converters", "signatures")]
    for entry in map(Path, path):
        found += [] if any(entry.is_relative_to(prefix) for prefix in prefixes) else _of_modules(entry)
    return _apart_from_home(found)


@cache
def _places_of_command(command: tuple[str, ...]) -> tuple[str, ...]:
    named = [shutil.which(command[0]) or command[0], *(a for a in command[1:] if a.startswith("/"))]
    return _apart_from_home(place for name in named for place in _of_named(Path(name)))


def _apart_from_home(places: Iterable[str]) -> tuple[str, ...]:
    """Those that do not hold the user's own folder: that is never read as a whole, whatever variable names it."""
    home = f"{os.path.realpath(os.path.expanduser('~'))}/"  # noqa: PTH111  a user in a container may have none
    absolute = (place for place in dict.fromkeys(places) if place.startswith("/"))
    return tuple(place for place in absolute if not home.startswith(f"{os.path.realpath(place)}/".replace("//", "/")))


def _of_prefix(prefix: Path) -> Iterator[str]:
    """A compiler of conda has its system's headers in a folder that is called after the machine."""
    yield from (str(prefix / name) for name in _PREFIX)
    yield from map(str, prefix.glob("*-linux-gnu*"))


def _of_modules(entry: Path) -> Iterator[str]:
    """Where modules come from: a folder of packages, or of a checkout the packages and modules alone."""
    if not entry.is_absolute():
        return
    if entry.name in _PACKAGES or not entry.is_dir():
        yield str(entry)
        return
    yield f"{entry}/"
    for inside in entry.iterdir():
        if inside.suffix in (".py", ".so") or (inside / "__init__.py").is_file():
            yield str(inside)


def _of_named(named: Path) -> Iterator[str]:
    """What a command names: a program with its prefix, a file with what lies beside it, or a folder.

    Of a folder with npm packages these alone: it may be a project of the user's.
    """
    if not named.exists():
        return
    real = named.resolve()
    if real.parent.name in ("bin", "sbin"):
        for program in (named.absolute(), real):
            yield from _of_prefix(program.parent.parent)
    elif (real / "node_modules").is_dir():
        yield from (str(real / name) for name in ("node_modules", "package.json"))
    else:
        yield str(real if real.is_dir() else real.parent)
