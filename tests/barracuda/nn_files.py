"""A small writer of ``.nn`` files, for tests: the bytes as Unity and the Python trainers lay them out."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from export_model.converters.formats.barracuda.format import Dataset, Layer, NnInput, NnMemory, NnModel, Trailer

Array = np.ndarray


def i32(number: int) -> bytes:
    return struct.pack("<i", number)


def text(words: str) -> bytes:
    return i32(len(words.encode("utf-16-le")) // 2) + words.encode()


def ints(values: Sequence[int]) -> bytes:
    return i32(len(values)) + b"".join(map(i32, values))


def listed(items: Iterable[bytes]) -> bytes:
    found = list(items)
    return i32(len(found)) + b"".join(found)


def write_nn(model: NnModel) -> bytes:
    parts = [
        struct.pack("<q", model.version),
        listed(text(i.name) + ints(i.shape) for i in model.inputs),
        listed(map(text, model.outputs)),
        listed(ints(m.shape) + text(m.input) + text(m.output) for m in model.memories),
        listed(map(_layer, model.layers)),
    ]
    if model.version >= 20:
        parts.append(i32(int(model.half)))
    data = b"".join(parts)
    if model.version >= 19:
        data += bytes(16 - len(data) % 16)
    data += model.weights.astype("<f2" if model.half else "<f4").tobytes()
    if model.trailer is not None:
        data += b"".join(map(text, (model.trailer.ir_source, model.trailer.ir_version, model.trailer.producer)))
        data += listed(text(a) + text(b) for a, b in model.trailer.warnings)
        if model.version >= 18:
            data += listed(text(a) + text(b) for a, b in model.trailer.metadata)
    return data


def _layer(layer: Layer) -> bytes:
    return b"".join(
        (
            text(layer.name),
            i32(layer.type) + i32(layer.activation) + i32(0) + i32(0),
            ints(layer.pad) + ints(layer.stride) + ints(layer.pool),
            i32(layer.axis) + struct.pack("<ff", layer.alpha, layer.beta) + i32(0),
            listed(map(text, layer.inputs)),
            listed(
                text(d.name) + ints(d.shape) + struct.pack("<qii", d.offset, d.item_size, d.length)
                for d in layer.datasets
            ),
        )
    )


class Maker:
    """Puts a model together: layers with their arrays, which go into the weights."""

    def __init__(self, version: int = 16) -> None:
        self.version = version
        self.inputs: list[NnInput] = []
        self.memories: list[NnMemory] = []
        self.layers: list[Layer] = []
        self.outputs: list[str] = []
        self.weights: list[Array] = []

    def input(self, name: str, *shape: int) -> str:
        self.inputs.append(NnInput(name, self._shape((-1, *shape))))
        return name

    def memory(self, size: int, taken: str, given: str) -> str:
        self.memories.append(NnMemory(self._shape((1, 1, 1, size)), taken, given))
        return taken

    def _shape(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        n, h, w, c = shape
        return shape if self.version < 17 else (1, 1, n, 1, 1, h, w, c)

    def layer(
        self,
        name: str,
        kind: int,
        *inputs: str,
        data: Mapping[str, Array] | None = None,
        **fields: object,
    ) -> str:
        datasets = []
        for key, array in (data or {}).items():
            values = np.asarray(array, np.float32)
            offset = sum(w.size for w in self.weights)
            datasets.append(Dataset(key, self._shape(values.shape), offset, 4, values.size))
            self.weights.append(values)
        self.layers.append(Layer(name, kind, inputs=inputs, datasets=tuple(datasets), **fields))  # type: ignore[arg-type]
        return name

    def load(self, name: str, array: Array | float) -> str:
        values = np.asarray(array, np.float32)
        return self.layer(name, 255, data={name: values.reshape((1,) * (4 - values.ndim) + values.shape)})

    def model(self, *, trailer: Trailer | None = None) -> NnModel:
        flat = [w.reshape(-1) for w in self.weights]
        weights = np.concatenate(flat) if flat else np.zeros(0, np.float32)
        outputs = tuple(self.outputs or [self.layers[-1].name])
        return NnModel(
            self.version,
            tuple(self.inputs),
            outputs,
            tuple(self.memories),
            tuple(self.layers),
            weights,
            trailer=trailer,
        )
