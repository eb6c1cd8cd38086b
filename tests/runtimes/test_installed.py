"""Installed parts are held against their known hashes when they are used; what has not changed is not read again."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from export_model.converters.files.children.process import RuntimeProcess
from export_model.converters.runtimes.installed import STAMP, check
from export_model.converters.runtimes.javascript.node import JS_SOURCE, js_home
from export_model.converters.runtimes.registry import RUNTIMES
from export_model.converters.runtimes.tensorflow.release import LIBRARIES, RELEASES
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import RuntimeUnavailableError
from tests.runtimes.pipe import NEEDS_NODE
from tests.runtimes.write_installed import installed

KNOWN = {"a.js": sha256_hex(b"right"), "lib/b.so": sha256_hex(b"too"), "not/there": "0" * 64}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "lib").mkdir()
    (tmp_path / "a.js").write_bytes(b"right")
    (tmp_path / "lib" / "b.so").write_bytes(b"too")
    return tmp_path


def test_a_file_is_read_when_it_is_new_or_was_changed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[bytes] = []
    seen = lambda data: (read.append(data), sha256_hex(data))[1]  # noqa: E731
    monkeypatch.setattr("export_model.converters.runtimes.installed.sha256_hex", seen)
    check(folder, KNOWN, "install it")
    assert read == [b"right", b"too"]
    check(folder, KNOWN, "install it")
    assert read == [b"right", b"too"]
    (folder / "a.js").rename(folder / "kept")
    (folder / "a.js").write_bytes(b"right")  # a cache that was restored: the same bytes in another inode
    check(folder, KNOWN, "install it")
    assert read == [b"right", b"too", b"right"]


@pytest.mark.parametrize("data", [b"wrong", b"", b"right!"])
def test_a_file_that_was_changed_is_refused(data: bytes, folder: Path) -> None:
    check(folder, KNOWN, "install it")
    before = (folder / "a.js").stat()
    (folder / "a.js").write_bytes(data)
    os.utime(folder / "a.js", ns=(before.st_atime_ns, before.st_mtime_ns))
    with pytest.raises(RuntimeUnavailableError, match=r"a\.js: is not the file that was installed"):
        check(folder, KNOWN, "install it")


@pytest.mark.parametrize("text", ["", "[]", '{"a.js": 1}', "[" * 100_000])
def test_a_stamp_that_is_none_is_no_proof(text: str, folder: Path) -> None:
    (folder / STAMP).write_text(text)
    check(folder, KNOWN, "install it")
    assert json.loads((folder / STAMP).read_text()).keys() == {"a.js", "lib/b.so"}


@NEEDS_NODE[0]
@NEEDS_NODE[1]
def test_the_list_of_npm_files_belongs_to_the_lock() -> None:
    """After a change of the lock: python -m tests.runtimes.write_installed."""
    assert json.loads((JS_SOURCE / "installed.json").read_text()) == installed(js_home() / "node_modules")


@NEEDS_NODE[0]
@NEEDS_NODE[1]
def test_a_file_that_was_put_beside_them_is_not_run(tmp_path: Path) -> None:
    package = tmp_path / "node_modules" / "@tensorflow" / "tfjs-core"
    package.mkdir(parents=True)
    (package / "package.json").write_text('{"main": "other.js"}')
    (package / "other.js").write_text(f"require('fs').writeFileSync({str(tmp_path / 'marker')!r}, 'x')")
    command = next(r for r in RUNTIMES if r.name == "tfjs-cpu").command()
    assert command[-1] == "--known"
    command[command.index("--modules") + 1] = str(tmp_path)
    with (
        RuntimeProcess("tfjs-cpu", command, confined=False) as process,
        pytest.raises(RuntimeUnavailableError) as error,
    ):
        process.start()
    assert "is not among the files that were installed" in str(error.value)
    assert not (tmp_path / "marker").exists()


def test_a_library_of_tensorflow_1_that_was_changed_is_not_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("export_model.converters.runtimes.tensorflow.library_folder", lambda release: tmp_path)
    for name in LIBRARIES:
        (tmp_path / name).write_bytes(b"\x7fELF")
    assert RELEASES[0].libraries.keys() == {*LIBRARIES}
    runtime = next(r for r in RUNTIMES if r.name == "tf1.4")
    with pytest.raises(RuntimeUnavailableError, match="is not the file that was installed"):
        runtime.command()
