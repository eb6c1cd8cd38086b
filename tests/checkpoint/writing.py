"""A small writer of TensorFlow's tables and checkpoints, for tests: every block size and restart interval."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.checkpoint.crc32c import crc32c, mask_crc
from export_model.converters.formats.checkpoint.table import MAGIC
from export_model.converters.formats.checkpoint.tensor_bundle import Extents, slice_key
from export_model.converters.formats.frozen_graph.tensors import from_array

Pairs = Sequence[tuple[bytes, bytes]]


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def block(pairs: Pairs, interval: int) -> bytes:
    out, restarts, last = bytearray(), [], b""
    for number, (key, value) in enumerate(pairs):
        shared = 0
        if number % interval == 0:
            restarts.append(len(out))
        else:
            while shared < min(len(key), len(last)) and key[shared] == last[shared]:
                shared += 1
        out += varint(shared) + varint(len(key) - shared) + varint(len(value)) + key[shared:] + value
        last = key
    restarts = restarts or [0]
    return bytes(out) + struct.pack(f"<{len(restarts)}I", *restarts) + struct.pack("<I", len(restarts))


def table(pairs: Pairs, *, per_block: int = 8, interval: int = 4) -> bytes:
    out = bytearray()

    def put(content: bytes) -> bytes:
        handle = varint(len(out)) + varint(len(content))
        content += b"\0"  # not compressed
        out.extend(content + struct.pack("<I", mask_crc(crc32c(content))))
        return handle

    index = []
    for at in range(0, len(pairs), per_block):
        part = pairs[at : at + per_block]
        index.append((part[-1][0], put(block(part, interval))))
    meta = put(block([], 1))
    place = put(block(index, 1))
    return bytes(out) + (meta + place).ljust(40, b"\0") + MAGIC


def bundle(
    prefix: Path,
    values: Mapping[str, np.ndarray],
    *,
    shards: int = 1,
    slices: Mapping[str, Sequence[Extents]] | None = None,
    big: bool = False,
) -> None:
    """Write a checkpoint; ``slices`` cuts a variable into parts of these extents."""
    data = [bytearray() for _ in range(shards)]
    header = schema.BundleHeaderProto(num_shards=shards, endianness=int(big))
    header.version.producer = 1
    entries = {b"": header.SerializeToString()}

    def put(key: bytes, array: np.ndarray, number: int) -> None:
        raw = np.asarray(array, array.dtype.newbyteorder(">" if big else "<")).tobytes()
        shard = number % shards
        entry = described(array)
        entry.shard_id, entry.offset, entry.size = shard, len(data[shard]), len(raw)
        entry.crc32c = mask_crc(crc32c(raw))
        data[shard] += raw
        entries[key] = entry.SerializeToString()

    for number, (name, array) in enumerate(sorted(values.items())):
        parts = (slices or {}).get(name)
        if parts is None:
            put(name.encode(), array, number)
            continue
        entry = described(array)
        for extents in parts:
            proto = entry.slices.add()
            for start, length in extents:
                proto.extent.add(start=start, length=length)
            window = tuple(slice(s, s + n if n else None) for s, n in extents)
            put(slice_key(name, extents), array[window], number)
        entries[name.encode()] = entry.SerializeToString()
    prefix.parent.mkdir(parents=True, exist_ok=True)
    prefix.with_name(prefix.name + ".index").write_bytes(table(sorted(entries.items())))
    for number, content in enumerate(data):
        prefix.with_name(f"{prefix.name}.data-{number:05d}-of-{shards:05d}").write_bytes(bytes(content))


def described(array: np.ndarray) -> object:
    entry = schema.BundleEntryProto(dtype=schema.dtype_number(array.dtype))
    for size in array.shape:
        entry.shape.dim.add(size=size)
    entry.shape.SetInParent()
    return entry


# ------------------------------------------------------------------ a training graph


class TrainingGraph:
    """A GraphDef as training wrote it: variables, a saver, an optimizer's slots, a loss."""

    def __init__(self) -> None:
        self.message = schema.GraphDef()
        self.message.versions.producer = 24
        self.variables: dict[str, np.ndarray] = {}

    def node(self, name: str, op: str, *inputs: str, **attrs: object) -> str:
        proto = self.message.node.add(name=name, op=op)
        proto.input.extend(inputs)
        for key, value in attrs.items():
            if isinstance(value, np.ndarray):
                proto.attr[key].tensor.CopyFrom(from_array(value))
            elif isinstance(value, np.dtype):
                proto.attr[key].type = schema.dtype_number(value)
            elif isinstance(value, str):
                proto.attr[key].s = value.encode()
            else:
                proto.attr[key].shape.SetInParent()
                for size in value:  # type: ignore[attr-defined]
                    proto.attr[key].shape.dim.add(size=size)
        return name

    def const(self, name: str, value: np.ndarray) -> str:
        return self.node(name, "Const", dtype=value.dtype, value=value)

    def variable(self, name: str, value: np.ndarray, *, op: str = "VariableV2", slots: bool = True) -> str:
        """A variable with its initial value; returns what reads it."""
        self.variables[name] = value
        shared = {"shared_name": name} if op == "VarHandleOp" else {}
        self.node(name, op, dtype=value.dtype, shape=value.shape, **shared)
        initial = self.const(f"{name}/Initializer/zeros", np.zeros_like(value))
        assign = "AssignVariableOp" if op == "VarHandleOp" else "Assign"
        self.node(f"{name}/Assign", assign, name, initial)
        if slots:
            self.variable(f"{name}/Adam", np.full_like(value, 9), slots=False)
            self.node(f"train/update_{name}", "ApplyAdam", name, f"{name}/Adam", "loss")
        return self.node(f"{name}/read", "ReadVariableOp" if op == "VarHandleOp" else "Identity", name)

    def saver(self, keys: Mapping[str, str] | None = None, slices: Mapping[str, str] | None = None) -> None:
        names = [(keys or {}).get(n, n) for n in self.variables]
        self.node("save/Const", "Placeholder", dtype=np.dtype(np.bytes_), shape=())
        self.const("save/RestoreV2/tensor_names", np.array([n.encode() for n in names]))
        texts = [(slices or {}).get(n, "").encode() for n in self.variables]
        self.const("save/RestoreV2/shape_and_slices", np.array(texts))
        self.node(
            "save/RestoreV2",
            "RestoreV2",
            "save/Const",
            "save/RestoreV2/tensor_names",
            "save/RestoreV2/shape_and_slices",
        )
        for number, name in enumerate(self.variables):
            value = f"save/RestoreV2:{number}" if number else "save/RestoreV2"
            handle = next(n.op for n in self.message.node if n.name == name) == "VarHandleOp"
            if handle:
                value = self.node(f"save/Identity_{number}", "Identity", value)
            self.node(f"save/Assign_{number}", "AssignVariableOp" if handle else "Assign", name, value)

    def write(self, path: Path, *, meta: bool = False) -> Path:
        message = self.message
        if meta:
            message = schema.MetaGraphDef()
            message.meta_info_def.tags.append("train")
            message.graph_def.CopyFrom(self.message)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(schema.serialise(message))
        return path


def policy(seed: int = 0, *, op: str = "VariableV2") -> TrainingGraph:
    """action = tanh(vector_observation · kernel + bias), with a loss and a nested action that is none."""
    random = np.random.default_rng(seed)
    graph = TrainingGraph()
    f32 = np.dtype(np.float32)
    graph.node("vector_observation", "Placeholder", dtype=f32, shape=(-1, 3))
    graph.node("advantages", "Placeholder", dtype=f32, shape=(-1,))
    kernel = graph.variable("dense/kernel", random.standard_normal((3, 2)).astype(f32), op=op)
    bias = graph.variable("dense/bias", random.standard_normal(2).astype(f32), op=op)
    graph.variable("version_number", np.array(2, np.int32), slots=False)
    graph.variable("global_step", np.array(1000, np.int32), slots=False)
    graph.node("product", "MatMul", "vector_observation", kernel, T=f32)
    graph.node("biased", "BiasAdd", "product", bias, T=f32)
    graph.node("action", "Tanh", "biased", T=f32)
    graph.node("critic/policy/action", "Mul", "action", "biased", T=f32)
    graph.node("loss", "Mul", "critic/policy/action", "advantages", T=f32)
    graph.saver()
    return graph


def expected(graph: TrainingGraph, observation: np.ndarray) -> np.ndarray:
    return np.tanh(observation @ graph.variables["dense/kernel"] + graph.variables["dense/bias"])
