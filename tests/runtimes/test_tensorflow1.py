"""TensorFlow 1.4 and 1.7: whether they are here, and how their libraries get into the cache. pip is a stand-in here."""

from __future__ import annotations

import struct
import sys
import zipfile
from pathlib import Path

import pytest
from msgspec.structs import replace

from export_model.converters.runtimes import tensorflow as found
from export_model.converters.runtimes.registry import Runtime, RuntimeInfo
from export_model.converters.runtimes.tensorflow import install as legacy_install
from export_model.converters.runtimes.tensorflow import release as legacy
from export_model.converters.runtimes.tensorflow.install import install, weaken_python_symbols
from export_model.converters.runtimes.tensorflow.release import (
    API_LIBRARY,
    LIBRARIES,
    RELEASES,
    is_whole,
    library_folder,
)
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import RuntimeUnavailableError

RUNTIMES = found.RUNTIMES[-len(RELEASES) :]
RELEASE = RELEASES[0]
NOT_HERE = "TensorFlow 1.4 and 1.7 are there for Linux on x86-64 with glibc only"


def quiet(_: str) -> None:
    """A progress callback that nobody reads."""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of a user whose machine can run them."""
    monkeypatch.setattr(legacy, "cache_folder", lambda: tmp_path / "cache")
    for module in (legacy, found, legacy_install):
        monkeypatch.setattr(module, "unsupported_reason", lambda: None)
    monkeypatch.setattr(legacy_install, "unsupported_reason", lambda: None)
    return tmp_path / "cache"


UNDEFINED_GLOBAL = (1 << 4, 0)


def elf(symbols: dict[str, tuple[int, int]]) -> bytes:
    """An ELF64 file with nothing but dynamic symbols: name → (binding and type, section)."""
    names = b"\0" + b"".join(n.encode() + b"\0" for n in symbols)
    entries = b""
    at = 1
    for name, (info, section) in symbols.items():
        entries += struct.pack("<IBBHQQ", at, info, 0, section, 0, 0)
        at += len(name) + 1
    start = 0x40
    header = bytearray(0x40)
    header[:6] = b"\x7fELF\x02\x01"
    struct.pack_into("<Q", header, 0x28, start + len(names) + len(entries))
    struct.pack_into("<HH", header, 0x3A, 64, 2)
    strings = struct.pack("<IIQQQQIIQQ", 0, 3, 0, 0, start, len(names), 0, 0, 1, 0)
    dynsym = struct.pack("<IIQQQQIIQQ", 0, 11, 0, 0, start + len(names), len(entries), 0, 0, 8, 24)
    return bytes(header) + names + entries + strings + dynsym


def symbol_bindings(image: bytes, count: int, names_length: int) -> list[int]:
    return [image[0x40 + names_length + 24 * i + 4] >> 4 for i in range(count)]


def wheel(path: Path) -> bytes:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("tensorflow/__init__.py", "raise RuntimeError('imported')")
        archive.writestr(f"tensorflow-1.4.0.data/purelib/tensorflow/python/{API_LIBRARY}", elf({}))
        archive.writestr("tensorflow-1.4.0.data/purelib/tensorflow/libtensorflow_framework.so", b"framework")
    return path.read_bytes()


@pytest.fixture
def pip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stand-in for Python whose ``-m pip download`` copies a small wheel and keeps its arguments."""
    good = tmp_path / "tensorflow-1.4.0-cp36-cp36m-manylinux1_x86_64.whl"
    wheel(good)
    script = tmp_path / "python"
    script.write_text(
        f"#!/bin/sh\necho \"$@\" > '{tmp_path}/arguments'\n"
        'while [ "$1" != --dest ]; do shift; done\n'
        f"cp '{good}' \"$2\"\n"
    )
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    return script


def known(tmp_path: Path) -> legacy.Release:
    """The release, had its wheel been the stand-in's."""
    data = (tmp_path / "tensorflow-1.4.0-cp36-cp36m-manylinux1_x86_64.whl").read_bytes()
    return replace(RELEASE, sha256=sha256_hex(data))


# ---- whether they are here -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("runtime", "release"), list(zip(RUNTIMES, RELEASES, strict=True)))
def test_what_lies_in_the_cache_is_installed(
    cache: Path, runtime: Runtime, release: legacy.Release, monkeypatch: pytest.MonkeyPatch
) -> None:
    how = f"export-model runtimes install {release.runtime}"
    assert runtime.find() == RuntimeInfo(release.runtime, False, None, how)
    with pytest.raises(RuntimeUnavailableError) as caught:
        runtime.command()
    assert caught.value.fix == how
    folder = library_folder(release)
    folder.mkdir(parents=True)
    (folder / LIBRARIES[0]).write_bytes(b"")
    assert not runtime.find().installed  # half of it is none
    (folder / LIBRARIES[1]).write_bytes(b"")
    assert runtime.find() == RuntimeInfo(release.runtime, True, release.version, how)
    with pytest.raises(RuntimeUnavailableError, match="is not the file that was installed"):
        runtime.command()
    monkeypatch.setattr("export_model.converters.runtimes.tensorflow.check", lambda *known: None)
    assert runtime.command()[-2:] == [release.runtime, str(folder / API_LIBRARY)]


@pytest.mark.parametrize(
    ("platform", "machine", "libc"),
    [
        ("linux", "aarch64", "glibc 2.36"),
        ("linux", "x86_64", ""),
        ("darwin", "x86_64", "glibc 2.36"),
        ("win32", "AMD64", ""),
    ],
)
def test_another_machine_is_told_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, platform: str, machine: str, libc: str
) -> None:
    monkeypatch.setattr(legacy, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(sys, "platform", platform)
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("os.confstr", lambda name: libc, raising=False)
    assert RUNTIMES[0].find() == RuntimeInfo("tf1.4", False, None, NOT_HERE, supported=False)
    with pytest.raises(RuntimeUnavailableError, match="does not run here") as caught:
        install(RELEASE, quiet)
    assert caught.value.why == NOT_HERE
    assert not list(tmp_path.iterdir())


def test_a_c_library_that_does_not_know_the_question_is_not_glibc(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> str:
        raise ValueError("unrecognized configuration name")

    monkeypatch.setattr("os.confstr", refuse, raising=False)
    assert legacy.unsupported_reason() == NOT_HERE


# ---- the installation ------------------------------------------------------------------------------------------------

needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="the stand-in for pip is a shell script")


@needs_posix
def test_install_keeps_the_two_libraries_of_the_wheel(cache: Path, pip: Path, tmp_path: Path) -> None:
    said: list[str] = []
    release = known(tmp_path)
    folder = install(release, said.append)
    assert folder == cache / "tf-1.4.0"
    assert {p.name for p in folder.iterdir()} == set(LIBRARIES)
    assert is_whole(folder)
    assert [p.name for p in cache.iterdir()] == ["tf-1.4.0"]
    arguments = (tmp_path / "arguments").read_text().split()
    assert arguments[:3] == ["-P", "-m", "pip"]
    assert arguments[-1] == "tensorflow==1.4.0"
    assert {"--no-deps", "--only-binary=:all:"} <= set(arguments)
    assert said == ["fetching TensorFlow 1.4.0 with pip (41 MB)", f"TensorFlow 1.4.0 is in {folder}"]
    assert install(release, said.append) == folder
    assert said[-1] == f"TensorFlow 1.4.0 is already in {folder}"


@needs_posix
def test_a_wheel_with_another_hash_is_refused_before_it_is_opened(cache: Path, pip: Path) -> None:
    with pytest.raises(RuntimeUnavailableError, match="not the one that is known") as caught:
        install(RELEASE, quiet)
    assert RELEASE.sha256 in (caught.value.why or "")
    assert list(cache.iterdir()) == []


@needs_posix
def test_a_failing_pip_is_an_error_with_its_last_words(cache: Path, pip: Path) -> None:
    pip.write_text("#!/bin/sh\nseq 1 20 >&2\necho 'ERROR: No matching distribution' >&2\nexit 1\n")
    with pytest.raises(RuntimeUnavailableError, match="could not be fetched") as caught:
        install(RELEASE, quiet)
    assert (caught.value.why or "").splitlines() == ["19", "20", "ERROR: No matching distribution"]
    assert "export-model runtimes install tf1.4" in (caught.value.fix or "")
    assert caught.value.exit_status == 3
    assert list(cache.iterdir()) == []


def test_a_cache_that_cannot_be_written_is_an_error(cache: Path) -> None:
    cache.write_text("a file where the folder should be")
    with pytest.raises(RuntimeUnavailableError) as caught:
        install(RELEASE, quiet)
    assert caught.value.where == str(cache / "tf-1.4.0")


@needs_posix
def test_a_damaged_folder_is_replaced(cache: Path, pip: Path, tmp_path: Path) -> None:
    folder = cache / "tf-1.4.0"
    folder.mkdir(parents=True)
    (folder / LIBRARIES[0]).write_bytes(b"cut off")
    install(known(tmp_path), quiet)
    assert is_whole(folder)
    assert (folder / LIBRARIES[0]).read_bytes() == b"framework"


# ---- the symbols -----------------------------------------------------------------------------------------------------


def test_undefined_symbols_of_python_become_weak_and_no_others(tmp_path: Path) -> None:
    symbols = {
        "_Py_CheckRecursionLimit": UNDEFINED_GLOBAL,
        "PyErr_Clear": UNDEFINED_GLOBAL,
        "malloc": UNDEFINED_GLOBAL,
        "PyObject_Own": (1 << 4, 7),  # defined here
        "_Py_Weak": (2 << 4, 0),
    }
    image = elf(symbols)
    path = tmp_path / "library.so"
    path.write_bytes(image)
    weaken_python_symbols(path)
    length = sum(len(n) + 1 for n in symbols) + 1
    assert symbol_bindings(image, 5, length) == [1, 1, 1, 1, 2]
    assert symbol_bindings(path.read_bytes(), 5, length) == [2, 2, 1, 1, 2]


def test_a_file_that_is_no_elf64_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "library.so"
    path.write_bytes(b"MZ" + bytes(100))
    with pytest.raises(RuntimeUnavailableError, match="not a little-endian ELF64"):
        weaken_python_symbols(path)
