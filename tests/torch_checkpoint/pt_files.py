"""Checkpoints written without PyTorch: pickles put together opcode by opcode, in both forms of torch.save.

The layout follows torch/serialization.py; tests hold it against files that PyTorch itself wrote.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fixtures.torch_checkpoint.cases import waves

PROTOCOL = b"\x80\x02"
STOP = b"."
_TYPES = {
    "float32": "FloatStorage",
    "float64": "DoubleStorage",
    "float16": "HalfStorage",
    "int64": "LongStorage",
    "int32": "IntStorage",
    "int16": "ShortStorage",
    "int8": "CharStorage",
    "uint8": "ByteStorage",
    "bool": "BoolStorage",
}


@dataclass(frozen=True)
class Stored:
    """A storage as a persistent id names it."""

    key: str
    kind: str
    count: int


@dataclass(frozen=True)
class Call:
    """``module.name(*arguments)``, with a state that is set on the result where there is one."""

    module: str
    name: str
    arguments: tuple[Any, ...] = ()
    state: Any = None


def pickled(value: Any) -> bytes:
    """A value as one pickle of protocol 2."""
    return PROTOCOL + _put(value) + STOP


def _put(value: Any) -> bytes:
    if value is None:
        return b"N"
    if isinstance(value, bool):
        return b"\x88" if value else b"\x89"
    if isinstance(value, int):
        if -(2**31) <= value < 2**31:
            return b"J" + struct.pack("<i", value)
        data = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
        return b"\x8a" + bytes([len(data)]) + data
    if isinstance(value, float):
        return b"G" + struct.pack(">d", value)
    if isinstance(value, str):
        data = value.encode()
        return b"X" + struct.pack("<I", len(data)) + data
    if isinstance(value, tuple):
        return b"(" + b"".join(map(_put, value)) + b"t"
    if isinstance(value, list):
        return b"](" + b"".join(map(_put, value)) + b"e"
    if isinstance(value, Mapping):
        return b"}(" + b"".join(_put(k) + _put(v) for k, v in value.items()) + b"u"
    if isinstance(value, Stored):
        kind = f"ctorch\n{value.kind}\n".encode()
        return b"(" + _put("storage") + kind + _put(value.key) + _put("cpu") + _put(value.count) + b"tQ"
    assert isinstance(value, Call), value
    made = f"c{value.module}\n{value.name}\n".encode() + _put(value.arguments) + b"R"
    return made if value.state is None else made + _put(value.state) + b"b"


def scalar(code: str, data: bytes) -> Call:
    """A scalar of numpy's as protocol 2 pickles it: what a run that ended keeps of its returns."""
    dtype = Call("numpy", "dtype", (code, False, True), (3, "<", None, None, None, -1, -1, 0))
    return Call(
        "numpy._core.multiarray", "scalar", (dtype, Call("_codecs", "encode", (data.decode("latin1"), "latin1")))
    )


RETURNS = scalar("f4", struct.pack("<f", -8.75))


class Writer:
    """Collects the storages of the tensors that are pickled."""

    def __init__(self, byteorder: str = "little") -> None:
        self.order = "<" if byteorder == "little" else ">"
        self.byteorder = byteorder
        self.storages: dict[str, np.ndarray] = {}

    def tensor(self, array: np.ndarray, *, kind: str = "", strides: Sequence[int] | None = None) -> Call:
        """A tensor with a storage of its own; ``strides`` are elements, of the storage as it stands."""
        key = str(len(self.storages))
        self.storages[key] = array.reshape(-1)
        stored = Stored(key, kind or _TYPES[array.dtype.name], array.size)
        steps = tuple(s // array.itemsize for s in array.copy(order="C").strides) if strides is None else strides
        shape = tuple(array.shape)
        arguments = (stored, 0, shape, tuple(steps), False, Call("collections", "OrderedDict"))
        return Call("torch._utils", "_rebuild_tensor_v2", arguments)

    def state(self, tensors: Mapping[str, Any]) -> Call:
        """A state dictionary: an OrderedDict, filled later, with its ``_metadata``."""
        items = [(k, v if isinstance(v, Call) else self.tensor(np.asarray(v))) for k, v in tensors.items()]
        # torch fills it by SETITEMS; given as pairs it is the same to a reader
        return Call(
            "collections", "OrderedDict", ([list(pair) for pair in items],), {"_metadata": {"": {"version": 1}}}
        )

    def _bytes(self, key: str) -> bytes:
        array = self.storages[key]
        return array.astype(array.dtype.newbyteorder(self.order)).tobytes()

    def zip(self, value: Any, *, root: str = "archive", compression: int = zipfile.ZIP_STORED) -> bytes:
        """As PyTorch 1.6 and later write it."""
        return zipped(
            {
                f"{root}/data.pkl": pickled(value),
                f"{root}/byteorder": self.byteorder.encode(),
                **{f"{root}/data/{key}": self._bytes(key) for key in self.storages},
                f"{root}/version": b"3\n",
            },
            compression,
        )

    def row(self, value: Any) -> bytes:
        """As PyTorch before 1.6 writes it."""
        facts = {"protocol_version": 1001, "little_endian": self.byteorder == "little", "type_sizes": {"int": 4}}
        parts = [pickled(v) for v in (0x1950A86A20F9469CFC6C, 1001, facts, value, list(self.storages))]
        for key, array in self.storages.items():
            parts += [struct.pack(f"{self.order}q", array.size), self._bytes(key)]
        return b"".join(parts)


def zipped(entries: Mapping[str, bytes], compression: int = zipfile.ZIP_STORED) -> bytes:
    """An archive of entries."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return stream.getvalue()


def weights(layout: Path) -> dict[str, np.ndarray]:
    """The tensors that a ``<name>.json`` of the fixtures describes."""
    found: dict[str, np.ndarray] = {}
    for name, entry in json.loads(layout.read_text()).items():
        if "values" in entry:
            found[name] = np.array(entry["values"], entry["dtype"]).reshape(entry["shape"])
        else:
            found[name] = waves(entry["waves"], entry["shape"])
    return found


def checkpoint(tensors: Mapping[str, Any], form: str = "zip", **others: Any) -> bytes:
    """A whole checkpoint of an actor's tensors."""
    writer = Writer()
    step = writer.state({"_GlobalSteps__global_step": np.array([1000], np.int64)})
    value = {"Policy": writer.state(tensors), "global_step": step, **others}
    return writer.zip(value) if form == "zip" else writer.row(value)


def actor(
    observed: int = 3, hidden: int = 4, actions: int = 2, branches: Sequence[int] = (), **changed: Any
) -> dict[str, Any]:
    """The tensors of a small actor as ML-Agents 1.1 names them; ``changed`` replaces some (None: leaves it out)."""
    shapes = {
        "network_body._body_endoder.seq_layers.0.weight": (hidden, observed),
        "network_body._body_endoder.seq_layers.0.bias": (hidden,),
    }
    if actions:
        shapes |= {
            "action_model._continuous_distribution.log_sigma": (1, actions),
            "action_model._continuous_distribution.mu.weight": (actions, hidden),
            "action_model._continuous_distribution.mu.bias": (actions,),
        }
    for index, size in enumerate(branches):
        name = f"action_model._discrete_distribution.branches.{index}"
        shapes |= {f"{name}.weight": (size, hidden), f"{name}.bias": (size,)}
    tensors: dict[str, Any] = {"version_number": np.array([3.0], np.float32)}
    tensors |= {"memory_size_vector": np.zeros(1, np.float32)}
    tensors |= {name: waves(name, shape) for name, shape in shapes.items()}
    tensors |= {name.replace("__", "."): value for name, value in changed.items()}
    return {name: value for name, value in tensors.items() if value is not None}
