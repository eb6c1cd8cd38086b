"""A checkpoint's values: ``<prefix>.index`` and ``<prefix>.data-?????-of-?????`` (TensorFlow's "bundle", V2 format).

The index is a table (table.py) of tensor name → BundleEntryProto, with a BundleHeaderProto under the empty key
(tensor_bundle.proto). An entry says in which shard the tensor's bytes lie, where, and their masked
CRC-32C. A variable that was partitioned has an entry with slices (tensor_slice.proto) and no bytes; each slice has an
entry of its own, whose key encodes the name and the extents in TensorFlow's ordered code (tensor_bundle.cc,
saved_tensor_slice_util.cc: EncodeTensorNameSlice; ordered_code.cc).

Nothing is read before it is asked for, and nothing is allocated before the shard is known to hold it.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.fetch import MAX_WEIGHTS, open_regular_file, read_bytes
from export_model.converters.formats.checkpoint.crc32c import crc32c, mask_crc
from export_model.converters.formats.checkpoint.table import read_table
from export_model.signatures.errors import DamagedFileError, ExportModelError, NotAPolicyError, SourceError

_MAX_AXES = 32
_MAX_SLICES = 1 << 12
_FIX = "copy the checkpoint again, all of its files, or take one of another step: --step N"

#: (start, length) per axis; a length of 0 stands for the whole axis.
Extents = Sequence[tuple[int, int]]


#: Where a checkpoint of Python objects says what they are.
_OBJECTS = "_CHECKPOINTABLE_OBJECT_GRAPH"


class Checkpoint:
    """The tensors of a checkpoint, by name."""

    def __init__(self, prefix: Path) -> None:
        """Read the index of ``prefix``. Raises SourceError, DamagedFileError, NotAPolicyError for a V1 checkpoint."""
        self.prefix = prefix
        self._read: dict[str, np.ndarray] = {}
        self.index = prefix.with_name(prefix.name + ".index")
        try:
            self._entries = dict(read_table(read_bytes(self.index)))
        except ExportModelError as error:
            raise error.at(self.index.name) from error.__cause__
        except OSError as error:
            raise SourceError("cannot be read", where=self.index.name, why=error.strerror, fix=_FIX) from error
        header = self._entries.pop(b"", None)
        if header is None:
            raise self._damaged_error("it has no header", "the table is not the index of a checkpoint")
        if header[:1] == b"\x0a":
            raise version_1(self.index.name)
        self._header = self._message(schema.BundleHeaderProto, header, "header")
        if not 0 < self._header.num_shards < 100000:
            raise self._damaged_error(f"its header claims {self._header.num_shards} shards")
        self._order: Literal["<", ">"] = ">" if self._header.endianness == 1 else "<"

    @property
    def names(self) -> list[str]:
        """The names of its tensors, slices of partitioned ones apart."""
        return [key.decode("utf-8", "replace") for key in self._entries if key[:1] != b"\0"]

    @property
    def of_objects(self) -> bool:
        """Whether its keys are paths of Python objects (trackable_object_graph.proto), not names of a graph."""
        return _OBJECTS in self

    @property
    def files(self) -> tuple[Path, ...]:
        """The index and every shard."""
        return (self.index, *(self._shard(i) for i in range(self._header.num_shards)))

    def __contains__(self, name: str) -> bool:
        return name.encode() in self._entries

    @property
    def place(self) -> str:
        """What errors call it."""
        return self.prefix.name

    def missing(self, keys: Sequence[str]) -> NotAPolicyError:
        """The error for variables that the policy needs, and that have no value here."""
        if self.of_objects:
            return of_objects(self)
        alike = [n for n in self.names if n.rpartition("/")[2] == keys[0].rpartition("/")[2]]
        return NotAPolicyError(
            f"the checkpoint has no value for the variable {several(keys)}",
            where=self.place,
            why=f"the policy needs it; what it does have: {', '.join((alike or self.names)[:4]) or 'nothing'}",
            fix="give the checkpoint of this graph, or another step: --step N",
        )

    def read(self, name: str, extents: Extents | None = None) -> np.ndarray:
        """The tensor ``name``, or the part of it that ``extents`` say.

        Raises DamagedFileError that names the tensor and the file; KeyError where there is no such tensor.
        """
        entry = self._entry(name.encode(), name)
        if name not in self._read:
            self._read[name] = self._join_slices(name, entry) if entry.slices else self._tensor(name, entry)
        array = self._read[name]
        if extents is None:
            return array
        return array[self._window(name, array.shape, extents)].copy()

    # -------------------------------------------------------------- entries

    def _entry(self, key: bytes, name: str) -> Any:
        return self._message(schema.BundleEntryProto, self._entries[key], f"entry of {name!r}")

    def _shape(self, name: str, entry: Any) -> tuple[int, ...]:
        shape = tuple(int(d.size) for d in entry.shape.dim)
        if entry.shape.unknown_rank or len(shape) > _MAX_AXES or any(n < 0 for n in shape):
            raise self._damaged_error(f"the shape of {name!r} is not known")
        return shape

    def _dtype(self, name: str, entry: Any) -> np.dtype:
        dtype = schema.dtype_of(entry.dtype)
        if dtype.kind in "SO":
            raise self._damaged_error(f"{name!r} holds no numbers", f"its dtype is number {entry.dtype}")
        return dtype.newbyteorder(self._order)

    def _tensor(self, name: str, entry: Any) -> np.ndarray:
        """A tensor whose bytes lie in one piece in one shard."""
        shape, dtype = self._shape(name, entry), self._dtype(name, entry)
        size = math.prod(shape) * dtype.itemsize
        if entry.size != size:
            raise self._damaged_error(
                f"{name!r} has {entry.size} bytes", f"a {dtype.name} tensor of shape {list(shape)} has {size}"
            )
        data = self._bytes(name, entry)
        return np.frombuffer(data, dtype).astype(dtype.newbyteorder("="), copy=False).reshape(shape)

    def by_variable(self) -> dict[str, str]:
        """Of a checkpoint of objects: the name of each variable that no other has → its key, as far as it says so.

        The graph of objects is a scalar string: its length as a varint, four bytes of checksum, the message.
        """
        if not self.of_objects:
            return {}
        data = self._raw(_OBJECTS, self._entry(_OBJECTS.encode(), _OBJECTS))
        start = next((i for i, byte in enumerate(data[:10]) if byte < 0x80), 0) + 5
        objects = self._message(schema.TrackableObjectGraph, data[start:], "graph of objects")
        kept = [a for node in objects.nodes for a in node.attributes if a.full_name and a.checkpoint_key]
        counts = Counter(a.full_name for a in kept)
        return {a.full_name: a.checkpoint_key for a in kept if counts[a.full_name] == 1}

    def _bytes(self, name: str, entry: Any) -> bytes:
        data = self._raw(name, entry)
        if mask_crc(crc32c(data)) != entry.crc32c:
            raise self._damaged_values(name, entry)
        return data

    def _damaged_values(self, name: str, entry: Any) -> DamagedFileError:
        return DamagedFileError(
            f"the values of {name!r} are damaged",
            where=self._shard(entry.shard_id).name,
            why="they have another checksum (crc32c) than they were written with",
            fix=_FIX,
        )

    def _raw(self, name: str, entry: Any) -> bytes:
        if not 0 <= entry.shard_id < self._header.num_shards:
            raise self._damaged_error(f"{name!r} is in shard {entry.shard_id} of {self._header.num_shards}")
        shard = self._shard(entry.shard_id)
        if not shard.exists() and not shard.is_symlink():
            raise SourceError(
                "is missing",
                where=shard.name,
                why="the values of a checkpoint are in its .data files, the .index only says where",
                fix="put the .data file beside the .index, or take a checkpoint that has both: --step N",
            )
        with open_regular_file(shard, MAX_WEIGHTS) as file:
            held = os.fstat(file.fileno()).st_size
            if entry.offset < 0 or entry.size < 0 or entry.offset + entry.size > held:
                raise DamagedFileError(
                    f"{name!r} is beyond the end of the file",
                    where=shard.name,
                    why=f"{entry.size} bytes from {entry.offset} on are not in a file of {held}: it was cut off",
                    fix=_FIX,
                )
            file.seek(entry.offset)
            data = file.read(entry.size)
        if len(data) != entry.size:
            raise self._damaged_values(name, entry)
        return data

    def _shard(self, number: int) -> Path:
        return self.prefix.with_name(f"{self.prefix.name}.data-{number:05d}-of-{self._header.num_shards:05d}")

    # -------------------------------------------------------------- partitioned variables

    def _join_slices(self, name: str, entry: Any) -> np.ndarray:
        """The tensor that slices make up; every element must be in one of them."""
        shape, dtype = self._shape(name, entry), self._dtype(name, entry)
        if len(entry.slices) > _MAX_SLICES:
            raise self._damaged_error(f"{name!r} claims {len(entry.slices)} slices")
        parts: list[tuple[tuple[slice, ...], np.ndarray]] = []
        filled = 0
        for part in entry.slices:
            extents = [(int(e.start), int(e.length)) for e in part.extent]
            window = self._window(name, shape, extents)
            key = slice_key(name, extents)
            if key not in self._entries:
                raise self._damaged_error(f"a slice of {name!r} is missing", f"it is at {_extents_text(extents)}")
            array = self._tensor(f"{name} {_extents_text(extents)}", self._entry(key, name))
            if array.shape != tuple(w.stop - w.start for w in window) or array.dtype != dtype.newbyteorder("="):
                raise self._damaged_error(
                    f"the slice of {name!r} at {_extents_text(extents)} has another shape or dtype"
                )
            parts.append((window, array))
            filled += array.size
        # The parts are in memory already, so the whole is no larger than what the shards hold.
        if filled != math.prod(shape):
            raise self._damaged_error(f"{name!r} has {math.prod(shape)} elements and its slices {filled}")
        whole = np.empty(shape, dtype.newbyteorder("="))
        seen = np.zeros(shape, np.bool_)
        for window, array in parts:
            whole[window] = array
            seen[window] = True
        if not seen.all():
            raise self._damaged_error(f"the slices of {name!r} do not make up the whole")
        return whole

    def _window(self, name: str, shape: tuple[int, ...], extents: Extents) -> tuple[slice, ...]:
        if len(extents) != len(shape):
            raise self._damaged_error(f"a slice of {name!r} has {len(extents)} axes, the tensor {len(shape)}")
        window = []
        for (start, length), size in zip(extents, shape, strict=True):
            stop = start + length if length else size
            if not 0 <= start <= stop <= size or (length == 0 and start):
                raise self._damaged_error(f"a slice of {name!r} reaches beyond its shape {list(shape)}")
            window.append(slice(start, stop))
        return tuple(window)

    # -------------------------------------------------------------- errors

    def _message(self, kind: Any, data: bytes, what: str) -> Any:
        try:
            return schema.parse(kind, data, what)
        except DamagedFileError as error:
            raise error.at(self.index.name) from error.__cause__

    def _damaged_error(self, what: str, why: str | None = None) -> DamagedFileError:
        return DamagedFileError(f"the checkpoint's index is damaged: {what}", where=self.index.name, why=why, fix=_FIX)


def version_1(where: str) -> NotAPolicyError:
    """The refusal of a checkpoint in the first format: one file, a table of slices (saved_tensor_slice.proto)."""
    return NotAPolicyError(
        "is a checkpoint in TensorFlow's first format (V1)",
        where=where,
        why="TensorFlow before 1.0 wrote it, or Saver(write_version=V1); its slices of tensors are not read here",
        fix="in any TensorFlow: restore it with tf.compat.v1.train.Saver, save it again (V2 is the default), give that",
    )


def of_objects(checkpoint: Checkpoint) -> NotAPolicyError:
    """The refusal of what ``tf.train.Checkpoint`` writes."""
    return NotAPolicyError(
        "is a checkpoint of Python objects",
        where=checkpoint.place,
        why="TensorFlow 2's tf.train.Checkpoint wrote it; what is computed with its values is in the Python code only",
        fix="save the model as a SavedModel (tf.saved_model.save, model.export), and give that",
    )


def several(keys: Sequence[str]) -> str:
    """The first of the names, and how many more there are."""
    return f"{keys[0]!r}" + (f" (and {len(keys) - 1} more)" if len(keys) > 1 else "")


def _extents_text(extents: Extents) -> str:
    """As TensorFlow writes a slice: ``"0,2:-"``."""
    return ":".join("-" if not length else f"{start},{length}" for start, length in extents)


# ------------------------------------------------------------------ keys of slices (ordered_code.cc)


def slice_key(name: str, extents: Extents) -> bytes:
    """The key of a slice: 0, the name, the number of axes, and start and length of each (-1: the whole axis)."""
    key = _number(0) + _string(name.encode()) + _number(len(extents))
    for start, length in extents:
        key += _encode_signed(start) + _encode_signed(length or -1)
    return key


def _number(value: int) -> bytes:
    """An unsigned integer: how many bytes it has, then these, the highest first."""
    data = value.to_bytes((value.bit_length() + 7) // 8, "big")
    return bytes([len(data)]) + data


def _string(value: bytes) -> bytes:
    """Bytes 0 and 255 are escaped, and 0 1 is the end."""
    return value.replace(b"\xff", b"\xff\x00").replace(b"\x00", b"\x00\xff") + b"\x00\x01"


def _encode_signed(value: int) -> bytes:
    """A signed integer, sign-extended to the fewest bytes; their count is xored into the first as leading ones."""
    magnitude = ~value if value < 0 else value
    length = magnitude.bit_length() // 7 + 1
    if length > 8:
        raise ValueError(f"{value} must be an extent of at most 8 bytes")
    word = bytearray(value.to_bytes(length, "big", signed=True))
    word[0] ^= 0xFF00 >> length & 0xFF
    return bytes(word)
