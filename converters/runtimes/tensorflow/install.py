"""Fetching the C libraries of TensorFlow 1.4 and 1.7 from their wheels (release.py says what for)."""

from __future__ import annotations

import mmap
import shutil
import struct
import sys
import tempfile
import zipfile
from pathlib import Path

from export_model.converters.runtimes.base import Progress
from export_model.converters.runtimes.installed import built_beside, carried_out
from export_model.converters.runtimes.tensorflow.release import (
    API_LIBRARY,
    LIBRARIES,
    Release,
    how,
    is_whole,
    library_folder,
    unsupported_reason,
)
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import RuntimeUnavailableError

_ERROR_LINES = 3


def install(release: Release, progress: Progress) -> Path:
    """Fetches a version's libraries into the user's cache folder, and returns theirs.

    Raises RuntimeUnavailableError: it does not run on this machine, pip does not get it, or not the one that is known.
    """
    target = library_folder(release)
    if is_whole(target):
        progress(f"TensorFlow {release.version} is already in {target}")
        return target
    reason = unsupported_reason()
    if reason is not None:
        raise RuntimeUnavailableError(f"TensorFlow {release.version} does not run here", why=reason)
    progress(f"fetching TensorFlow {release.version} with pip ({release.megabytes} MB)")
    fix = "free some space, or allow writing there"
    with built_beside(target, is_whole, f"TensorFlow {release.version}", fix) as folder:
        _fill(folder, release)
    progress(f"TensorFlow {release.version} is in {target}")
    return target


def _fill(folder: Path, release: Release) -> None:
    """The two libraries of the wheel, the second one changed so that it loads in any CPython."""
    with (
        tempfile.TemporaryDirectory(prefix=".wheel-", dir=folder) as scratch,
        zipfile.ZipFile(_download(release, Path(scratch))) as archive,
    ):
        for member in archive.namelist():
            name = member.rpartition("/")[2]
            if name in LIBRARIES:
                with archive.open(member) as source, (folder / name).open("wb") as copy:
                    shutil.copyfileobj(source, copy)
    weaken_python_symbols(folder / API_LIBRARY)


def _download(release: Release, folder: Path) -> Path:
    """The wheel, from the index that pip is set to; its hash is checked here, whatever pip does."""
    command = [sys.executable, "-P", "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
    command += ["--disable-pip-version-check", "--python-version", "3.6", "--platform", "manylinux1_x86_64"]
    command += ["--dest", str(folder), f"tensorflow=={release.version}"]
    status, said = carried_out(command)
    wheels = list(folder.glob("*.whl"))
    if status or len(wheels) != 1:
        raise RuntimeUnavailableError(
            f"TensorFlow {release.version} could not be fetched",
            why="\n".join(said[-_ERROR_LINES:]) or "pip said nothing on stderr",
            fix=f"check that pip is here and reaches its index, then: {how(release)}",
        )
    digest = sha256_hex(wheels[0].read_bytes())
    if digest != release.sha256:
        raise RuntimeUnavailableError(
            f"the wheel of TensorFlow {release.version} is not the one that is known",
            why=f"its sha256 is {digest}, and {release.sha256} was expected",
            fix="check what pip's index serves",
        )
    return wheels[0]


def weaken_python_symbols(path: Path) -> None:
    """Let the library load where CPython no longer has a symbol that its SWIG code asks for.

    That code never runs here, but every symbol is bound at load time, and CPython 3.10 dropped two that 1.7 names. In
    this private copy the undefined symbols of Python are made weak: the loader binds those it finds and leaves the rest
    null. (ELF64: section headers, then the entries of .dynsym.) Raises RuntimeUnavailableError on another kind of file.
    """
    with path.open("r+b") as file, mmap.mmap(file.fileno(), 0) as image:
        if image[:6] != b"\x7fELF\x02\x01":
            raise RuntimeUnavailableError(f"{path.name} is not a little-endian ELF64 file", where=str(path))
        (sections,) = struct.unpack_from("<Q", image, 0x28)
        size, count = struct.unpack_from("<HH", image, 0x3A)
        headers = [struct.unpack_from("<IIQQQQIIQQ", image, sections + i * size) for i in range(count)]
        for _, kind, _, _, start, length, link, _, _, entry in headers:
            if kind != 11:  # SHT_DYNSYM
                continue
            names = headers[link][4]
            for at in range(start, start + length, entry):
                name, info, _, section = struct.unpack_from("<IBBH", image, at)
                undefined_global = section == 0 and info >> 4 == 1
                if undefined_global and image[names + name : names + name + 3] in (b"_Py", b"PyE", b"PyO"):
                    image[at + 4] = 2 << 4 | info & 15  # STB_WEAK
