"""ZIP archives that mean one file to us and another to their own program, or unfold without an end."""

from __future__ import annotations

import io
import json
import struct
import tracemalloc
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from export_model.converters.files.torch_archive import Archive
from export_model.converters.formats.keras.config import config_inside, config_of
from export_model.converters.formats.stable_baselines3.source import _entries
from export_model.exporter.verify.golden import read_golden
from export_model.signatures.errors import DamagedFileError, ExportModelError
from tests.hostile.test_golden_archives import SIGNATURE, header

CONFIG = json.dumps({"class_name": "Sequential", "config": {}}).encode()
READERS: dict[str, tuple[Callable[[Path], object], Mapping[str, bytes]]] = {
    "golden": (lambda path: read_golden(path, SIGNATURE), {"state.npy": header((1, 3)) + bytes(12)}),
    "Keras": (config_of, {"config.json": CONFIG}),
    "Stable-Baselines3": (lambda path: _entries(path.read_bytes()), {"data": b"{}", "policy.pth": b"x"}),
    "PyTorch": (lambda path: Archive(path.read_bytes()), {"a/data.pkl": b"\x80\x02}."}),
}


def written(entries: Mapping[str, bytes], fault: str) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, data in entries.items():
            entry = zipfile.ZipInfo(name)
            if fault == "is a link":
                entry.external_attr = 0o120777 << 16
            archive.writestr(entry, data, zipfile.ZIP_BZIP2 if fault == "by another method" else zipfile.ZIP_STORED)
        if fault == "twice":
            with pytest.warns(UserWarning, match="Duplicate"):
                archive.writestr(next(iter(entries)), b"other")
    data = made.getvalue()
    if fault == "is encrypted":
        at = data.index(b"PK\x01\x02") + 8
        data = data[:at] + b"\x01\x00" + data[at + 2 :]
    return data


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("fault", ["twice", "is a link", "by another method", "is encrypted", ""])
def test_an_archive_has_each_entry_once_and_as_it_is(reader: str, fault: str, tmp_path: Path) -> None:
    read, entries = READERS[reader]
    path = tmp_path / "given.zip"
    path.write_bytes(written(entries, fault))
    if not fault:
        read(path)
        return
    with pytest.raises(ExportModelError, match=fault):
        read(path)


def test_a_method_that_unfolds_without_a_bound_is_not_begun(tmp_path: Path) -> None:
    """zipfile unfolds 4 KiB of bzip2 at once, which may be gigabytes, whatever the entry says to be."""
    path = tmp_path / "bomb.keras"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr("config.json", bytes(1 << 25))
    data = path.read_bytes()
    at = data.index(b"PK\x01\x02") + 24
    path.write_bytes(data[:at] + struct.pack("<I", 100) + data[at + 4 :])
    tracemalloc.start()
    try:
        with pytest.raises(DamagedFileError, match="another method"):
            config_of(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
    finally:
        tracemalloc.stop()


def test_what_keras_would_load_is_what_is_checked(tmp_path: Path) -> None:
    """A file that is a ZIP archive from its first byte, and HDF5 from byte 512 on, as Keras reads an ``.h5``."""
    h5py = pytest.importorskip("h5py")
    inner, path = tmp_path / "inner.h5", tmp_path / "both.h5"
    with h5py.File(inner, "w", userblock_size=512) as file:
        file.attrs["model_config"] = '{"class_name": "Lambda"}'
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        begin = 512 - 30 - len("model.weights.h5")
        archive.writestr("model.weights.h5", bytes(begin) + inner.read_bytes()[512:])
        archive.writestr("config.json", CONFIG)
    path.write_bytes(made.getvalue())
    assert config_of(path) == json.loads(CONFIG)
    assert config_inside(str(path)) == {"class_name": "Lambda"}
