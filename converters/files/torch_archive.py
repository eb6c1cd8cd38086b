"""The two forms that torch.save writes: a ZIP archive (PyTorch 1.6 on), and pickles in a row with storages behind them.

ZIP (torch/serialization.py, caffe2/serialize/inline_container.cc): ``<name>/data.pkl``, ``<name>/data/<key>`` per
storage (its raw bytes), ``<name>/byteorder``; entries are stored, not compressed. In a row: pickles of a magic number,
the protocol 1001, facts of the system, the object, the list of storage keys; then for each key an int64 (elements) and
the bytes. Memory is bounded by the file's own size: tensors are cut out of its bytes when they are asked for.
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Collection, Mapping
from typing import Any, Literal

import numpy as np
from msgspec import Struct

from export_model.converters.files.unpickle import PickledTensor, StorageType, unpickle
from export_model.converters.files.zip_archives import ZIP_ERRORS, open_archive
from export_model.signatures.errors import DamagedFileError, NotAPolicyError

_MAGIC = 0x1950A86A20F9469CFC6C
_PROTOCOL = 1001
#: Bytes of a local file header before the name, and bits of its flags (APPNOTE.TXT 4.3.7, 4.4.4).
_LOCAL_HEADER, _UTF_8 = 30, 1 << 11
_COPY_AGAIN = "copy or download it again"
_FOREIGN = "give a checkpoint as its trainer wrote it"


class Storage(Struct, frozen=True):
    """A run of numbers in the file: which one (``key``), its dtype, how many it should have."""

    key: str
    dtype: str
    count: int


class Archive:
    """A checkpoint: ``value`` is what was saved, its tensors still in the file."""

    def __init__(self, data: bytes) -> None:
        """Read the bytes of a file. Raises SourceError, NotAPolicyError, DamagedFileError."""
        self._data = data
        self._order: Literal["<", ">"] = "<"
        #: key → the storage's bytes
        self._storages: dict[str, memoryview] = {}
        self._given = 0
        self.value = self._zip() if self._data.startswith(b"PK\x03\x04") else self._row()

    def array(self, tensor: PickledTensor, name: str) -> np.ndarray:
        """A tensor's numbers (bfloat16 as float32), a view of the file's bytes where it can be. ``name`` is for errors.

        Raises DamagedFileError where they do not lie in their storage.
        """
        storage = tensor.storage
        if not isinstance(storage, Storage):
            raise _damaged_error(f"{name}: its storage is none", "the pickle is damaged")
        data = self._storages.get(storage.key)
        if data is None:
            raise _damaged_error(
                f"{name}: its storage {storage.key!r} is not in the file", "the file is cut or was edited"
            )
        dtype = np.dtype("uint16" if storage.dtype == "bfloat16" else storage.dtype).newbyteorder(self._order)
        count = math.prod(tensor.shape)
        last = tensor.offset + sum((n - 1) * s for n, s in zip(tensor.shape, tensor.strides, strict=True))
        if count and (last >= storage.count or storage.count * dtype.itemsize > len(data)):
            raise _damaged_error(f"{name}: it reaches beyond its storage", "the file is cut off or damaged")
        # A tensor that repeats its storage (stride 0), and many tensors of one storage, could ask for any memory.
        self._given += count * dtype.itemsize
        if count > storage.count or self._given > 4 * len(self._data):
            raise _damaged_error(f"{name}: it has more numbers than the file", "no trainer repeats a weight")
        if not count:
            return np.zeros(tuple(min(n, 1) for n in tensor.shape), dtype.newbyteorder("="))
        flat = np.frombuffer(data, dtype, storage.count)[tensor.offset :]
        view = np.lib.stride_tricks.as_strided(
            flat, tensor.shape, tuple(s * dtype.itemsize for s in tensor.strides), writeable=False
        )
        native = view.astype(dtype.newbyteorder("="), copy=False)
        if storage.dtype == "bfloat16":  # the upper half of a float32
            return (native.astype(np.uint32) << 16).view(np.float32)
        return native

    def _persistent(self, identity: tuple[Any, ...], *, stored: bool = True) -> Storage:
        """``("storage", storage type, key, device, elements)``; before PyTorch 1.6 a view's place follows."""
        if len(identity) < 5 or identity[0] not in ("storage", b"storage"):
            raise _damaged_error("a persistent id must be a storage's", "the pickle is damaged")
        kind, key, count = identity[1], identity[2], identity[4]
        if not isinstance(kind, StorageType) or not isinstance(key, str) or not isinstance(count, int):
            raise _damaged_error("a storage has no type, key or length", "the pickle is damaged")
        if identity[5:] not in ((), (None,)):
            raise NotAPolicyError(
                "it holds a storage that is a view of another",
                why="only PyTorch before 0.4 wrote such files, and none of the trainers that are read",
                fix=_FOREIGN,
            )
        width = 2 if kind.dtype == "bfloat16" else np.dtype(kind.dtype).itemsize
        if count < 0 or (stored and count * width > len(self._data)):
            raise _damaged_error(
                f"the storage {key!r} should have {count} numbers, more than the file", "the file is cut off or damaged"
            )
        return Storage(key, kind.dtype, count)

    # ------------------------------------------------------------------ a ZIP archive

    def _zip(self) -> Any:
        try:
            with open_archive(self._data) as archive:
                entries = {e.filename: e for e in archive.infolist()}
                names = [n for n in entries if n == "data.pkl" or n.endswith("/data.pkl")]
                if len(names) != 1:
                    raise _damaged_error("it has no data.pkl, or more than one", "torch.save writes one")
                return self._of_entries(archive, entries, names[0].removesuffix("data.pkl"))
        except ZIP_ERRORS as error:
            raise _damaged_error(f"its archive cannot be read: {error}", "the file is cut off or damaged") from error

    def _of_entries(self, archive: zipfile.ZipFile, entries: Mapping[str, zipfile.ZipInfo], root: str) -> Any:
        """Return what was saved. Raises what reading a ZIP archive raises, too."""
        if f"{root}constants.pkl" in entries or any(n.startswith(f"{root}code/") for n in entries):
            raise NotAPolicyError(
                "is a TorchScript module (torch.jit.save)",
                why="a state dictionary is expected here",
                fix="give the module itself",
            )
        self._check_sizes(entries.values())
        self._read_order(archive, entries, root)
        self._take_storages(entries, f"{root}data/", "")
        return unpickle(io.BytesIO(archive.read(f"{root}data.pkl")), self._persistent)

    def _read_order(self, archive: zipfile.ZipFile, entries: Mapping[str, zipfile.ZipInfo], root: str) -> None:
        if f"{root}byteorder" in entries and archive.read(f"{root}byteorder") == b"big":
            self._order = ">"

    def _take_storages(self, entries: Mapping[str, zipfile.ZipInfo], folder: str, prefix: str) -> None:
        """Keep the storages in a folder of the archive, their keys behind a prefix."""
        for name, entry in entries.items():
            if name.startswith(folder):
                self._storages[prefix + name.removeprefix(folder)] = self._uncompressed_entry(entry)

    def _uncompressed_entry(self, entry: zipfile.ZipInfo) -> memoryview:
        """What ``ZipFile.read`` gives of an entry that is not compressed, without a copy. Raises what that raises."""
        at, view = entry.header_offset, memoryview(self._data)
        mark, flags, name, extra = struct.unpack_from("<4s2xH18xHH", view, at)
        start = at + _LOCAL_HEADER + name + extra
        called = bytes(view[at + _LOCAL_HEADER : at + _LOCAL_HEADER + name])
        content = view[start : start + entry.file_size]
        if mark != b"PK\x03\x04" or called.decode("utf-8" if flags & _UTF_8 else "cp437") != entry.orig_filename:
            raise zipfile.BadZipFile(f"no entry {entry.filename!r} at its place")
        if len(content) != entry.file_size or zlib.crc32(content) != entry.CRC:
            raise zipfile.BadZipFile(f"bad CRC-32 for {entry.filename!r}")
        return content

    def _check_sizes(self, entries: Collection[zipfile.ZipInfo]) -> None:
        for entry in entries:
            if entry.compress_type != zipfile.ZIP_STORED:
                raise NotAPolicyError(
                    f"its entry {entry.filename!r} is compressed",
                    why="torch.save does not compress, and a small file may unfold to any size",
                    fix="give the file as training left it",
                )
        if sum(entry.file_size for entry in entries) > len(self._data):
            raise _damaged_error(
                "its entries are larger than the file", "they overlap: the file was edited or is damaged"
            )

    # ------------------------------------------------------------------ pickles in a row

    def _row(self) -> Any:
        stream = io.BytesIO(self._data)
        if unpickle(stream, _none) != _MAGIC:
            raise NotAPolicyError(
                "is a pickle, but not one that torch.save wrote",
                why="its first value is not PyTorch's magic number",
                fix=_FOREIGN,
            )
        if unpickle(stream, _none) != _PROTOCOL:
            raise _damaged_error("its protocol is not 1001", "no PyTorch wrote another")
        system = unpickle(stream, _none)
        if isinstance(system, dict) and system.get("little_endian") is False:
            self._order = ">"
        found: dict[str, Storage] = {}

        def persistent(identity: tuple[Any, ...]) -> Storage:
            storage = self._persistent(identity)
            return found.setdefault(storage.key, storage)

        value = unpickle(stream, persistent)
        keys = unpickle(stream, _none)
        if not isinstance(keys, list):
            raise _damaged_error("its list of storages is none", "the file is damaged")
        view, at = memoryview(self._data), stream.tell()
        for key in keys:
            if not isinstance(key, str) or key not in found or key in self._storages:
                raise _damaged_error("its list of storages names one that no tensor has", "the file is damaged")
            storage = found[key]
            width = 2 if storage.dtype == "bfloat16" else np.dtype(storage.dtype).itemsize
            count = int.from_bytes(view[at : at + 8], "little" if self._order == "<" else "big")
            end = at + 8 + count * width
            if count != storage.count or end > len(view):
                raise _damaged_error(
                    f"its storage {key!r} is not as long as it should be", "the file is cut off or damaged"
                )
            self._storages[key] = view[at + 8 : end]
            at = end
        return value


def _none(identity: tuple[Any, ...]) -> Storage:
    raise _damaged_error("found a tensor where another value is expected", "the pickle is damaged")


def _damaged_error(what: str, why: str) -> DamagedFileError:
    return DamagedFileError(what, why=why, fix=_COPY_AGAIN)
