"""Artefacts that are looked into as views of their files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.external_data import LARGE_FILE
from export_model.converters.files.fetch import read_bytes
from export_model.converters.files.memory_mapped import Mapped
from export_model.signatures.errors import DamagedFileError, SourceError
from fixtures import path as fixture
from tests.exporting import export_model


def test_a_large_file_is_a_view_which_outlives_being_let_go(tmp_path: Path) -> None:
    content = np.random.default_rng(1).bytes(2 * LARGE_FILE)
    (tmp_path / "large").write_bytes(content)
    files = Mapped()
    view = files.read(tmp_path / "large")
    assert isinstance(view, memoryview) and view.readonly and view == content
    array = np.frombuffer(view, np.uint8)
    files.let_go()
    assert array.tobytes() == content
    del files
    assert array.tobytes() == content


def test_a_small_file_is_read_and_what_is_none_is_refused_as_ever(tmp_path: Path) -> None:
    (tmp_path / "small").write_bytes(b"abc")
    (tmp_path / "empty").write_bytes(b"")
    assert Mapped().read(tmp_path / "small") == b"abc"
    for name, kind in (("empty", DamagedFileError), ("missing", SourceError), (".", SourceError)):
        said = []
        for read in (Mapped().read, read_bytes):
            with pytest.raises(kind) as refused:
                read(tmp_path / name)
            said.append(str(refused.value))
        assert said[0] == said[1]
    with pytest.raises(SourceError, match="no more than 2 are read"):
        Mapped().read(tmp_path / "small", most=2)


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="Linux says there what is resident")
def test_what_was_let_go_takes_no_memory(tmp_path: Path) -> None:
    size = 64 << 20
    (tmp_path / "large").write_bytes(bytes(size))
    files = Mapped()
    array = np.frombuffer(files.read(tmp_path / "large"), np.uint8)

    def mapped() -> int:
        return int(Path("/proc/self/statm").read_text().split()[2]) * os.sysconf("SC_PAGE_SIZE")

    before = mapped()
    assert array.sum() == 0
    assert mapped() - before > size // 2
    files.let_go()
    assert mapped() - before < size // 2


def test_both_are_looked_into_by_their_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("export_model.converters.files.memory_mapped.LARGE_FILE", 1)
    seen = set[tuple[str, type]]()
    read = Mapped.read

    def noted(self: Mapped, path: Path, **options: int) -> bytes | memoryview:
        found = read(self, path, **options)
        seen.add((path.suffix, type(found)))
        return found

    monkeypatch.setattr(Mapped, "read", noted)
    (result,) = export_model(fixture("continuous"), tmp_path, verify="tensorflow,onnxruntime")
    assert result.passed
    assert seen == {(".onnx", memoryview), (".bytes", memoryview)}
