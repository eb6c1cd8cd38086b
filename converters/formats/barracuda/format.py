"""The bytes of a ``.nn`` file to records: versions 15 to 20, every byte accounted for.

Everything is little-endian; a *str* is an int32 length and that many characters, an *arr* an int32 count and as many
int32. The order of the fields: version (int64), inputs, outputs, memories, layers, then the weights (one stream of
floats that the layers' datasets point into), then what only Unity's own writer adds. What changed:

===========  ==============================================================================================
15           previews of ML-Agents 0.7 (Barracuda 0.1.x); the same bytes as 16
16           what the Python trainers wrote, 0.7 to 0.23; the trailer of Unity's writer is optional
17           shapes may have eight entries (S, R, N, T, D, H, W, C), and an axis counts in those
18           metadata at the end of the trailer
19           1 to 16 zero bytes before the weights, so that they lie at a multiple of 16
20           an int32 before that padding: the weights' type, 0 float32, 1 half
===========  ==============================================================================================

Source: ``barracuda.py`` of ML-Agents 0.7 to 0.23, Barracuda's ModelLoader.cs and ModelWriter.cs of 0.1.x to 3.0.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from export_model.signatures.errors import DamagedFileError

VERSIONS = range(15, 21)
#: The first version of each change; see the module.
EIGHT_AXES, METADATA, ALIGNED, TYPED_WEIGHTS = 17, 18, 19, 20
ALIGNMENT = 16
_FLOAT, _HALF = 0, 1
_MAX_AXES = 8
_INT, _LONG = struct.Struct("<i"), struct.Struct("<q")
MAX_LAYERS = 1 << 14

#: The ``version_number`` from which on classes are drawn in the model and memories are inputs and outputs.
_DRAWS_IN_MODEL = 3

Ints = tuple[int, ...]
_Item = TypeVar("_Item")


class NnInput(Struct, frozen=True):
    """An input of the model; a shape has four entries (N, H, W, C) or eight, −1 where the length is free."""

    name: str
    shape: Ints


class NnMemory(Struct, frozen=True):
    """A part of the recurrent state: ``input`` is fed with what ``output`` gave in the step before."""

    shape: Ints
    input: str
    output: str


class Dataset(Struct, frozen=True):
    """A constant in the weight stream; ``offset`` and ``length`` count elements, not bytes."""

    name: str
    shape: Ints
    offset: int
    item_size: int
    length: int


class Layer(Struct, frozen=True):
    """One layer. Its name is also that of its result; what the other fields mean depends on ``type``."""

    name: str
    type: int
    activation: int = 0
    pad: Ints = ()
    stride: Ints = ()
    pool: Ints = ()
    axis: int = -1
    alpha: float = 1.0
    beta: float = 0.0
    inputs: tuple[str, ...] = ()
    datasets: tuple[Dataset, ...] = ()


class Trailer(Struct, frozen=True):
    """What only Unity's own writer adds after the weights.

    ``metadata`` came with version 18. Unity's loaders stop before it in an older file, so that what is there is for
    other readers alone: ours keeps a policy's contract in it.
    """

    ir_source: str
    ir_version: str
    producer: str
    warnings: tuple[tuple[str, str], ...] = ()
    metadata: tuple[tuple[str, str], ...] = ()


class NnModel(Struct, frozen=True, eq=False):
    """A ``.nn`` file. ``weights`` is float32 (halves are widened, which loses nothing); ``half`` says they were."""

    version: int
    inputs: tuple[NnInput, ...]
    outputs: tuple[str, ...]
    memories: tuple[NnMemory, ...]
    layers: tuple[Layer, ...]
    weights: npt.NDArray[np.float32]
    half: bool = False
    trailer: Trailer | None = None

    def metadata(self, key: str) -> str | None:
        """The metadata called ``key``, None where there is none."""
        return None if self.trailer is None else dict(self.trailer.metadata).get(key)

    @property
    def from_python(self) -> bool:
        """Whether ML-Agents' converter wrote it (and not Unity): nothing stands behind the weights."""
        return self.version < EIGHT_AXES and self.trailer is None

    def number(self, name: str) -> float | None:
        """The one number of a dataset called ``name`` (``version_number``), None where there is none."""
        for layer in self.layers:
            for dataset in layer.datasets:
                if dataset.name == name and dataset.length == 1:
                    return float(self.weights[dataset.offset])
        return None

    def array(self, dataset: Dataset) -> npt.NDArray[np.float32]:
        """A dataset's numbers as [N, H, W, C]. Raises DamagedFileError for a shape of more axes."""
        values = self.weights[dataset.offset : dataset.offset + dataset.length]
        return values.reshape(four_axes(dataset.shape, f"dataset {dataset.name!r}"))


def draws_in_model(version: float) -> bool:
    """Whether a model of this API version of ML-Agents draws classes by itself and has its memory as an input."""
    return version >= _DRAWS_IN_MODEL


def four_axes(shape: Ints, where: str) -> tuple[int, int, int, int]:
    """A shape of four or eight entries as N, H, W, C; the other axes must have length 1."""
    if len(shape) == 4:
        n, h, w, c = shape
    elif len(shape) == 8 and all(shape[i] in (1, -1) for i in (0, 1, 3, 4)):
        n, h, w, c = shape[2], shape[5], shape[6], shape[7]
    else:
        raise DamagedFileError(
            f"{where} has the shape {list(shape)}",
            why="a tensor of a policy has the axes N, H, W, C (four entries, or eight with the rest of length 1)",
            fix="models of volumes or sequences are not read; give the .onnx that it was imported from",
        )
    return n, h, w, c


def parse(data: bytes) -> NnModel:
    """Read the bytes of a ``.nn`` file.

    Raises DamagedFileError that names the place: what was read, the offset in the file, why it cannot be.
    """
    return _Parser(data).model()


class _Parser:
    """Reads from the front; nothing is allocated before the bytes for it are known to be there."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0
        self._what = "the version"

    # ------------------------------------------------------------------ the parts

    def model(self) -> NnModel:
        version = self._integer(_LONG)
        if version not in VERSIONS:
            raise self._error(f"the version is {version}", "the versions that were ever written are 15 to 20")
        inputs = self._list("inputs", 8, lambda: NnInput(self._text(), self._shape()))
        outputs = self._list("outputs", 4, self._text)
        memories = self._list("memories", 12, lambda: NnMemory(self._shape(), self._text(), self._text()))
        layers = self._list("layers", 56, self._layer, MAX_LAYERS)
        half, padding = False, 0
        if version >= TYPED_WEIGHTS:
            self._what = "the type of the weights"
            kind = self._integer()
            if kind not in (_FLOAT, _HALF):
                raise self._error(f"the type of the weights is {kind}", "0 (float32) and 1 (half) are known")
            half = kind == _HALF
        if version >= ALIGNED:
            self._what, padding = "the padding before the weights", ALIGNMENT - self._at % ALIGNMENT
            if any(self._take(padding)):
                raise self._error("the padding before the weights is not zero", "its content is not known")
        weights = self._weights(layers, half)
        trailer = self._trailer(version) if self._at < len(self._data) else None
        if self._at != len(self._data):
            raise self._error(f"{len(self._data) - self._at} bytes follow the end", "they belong to nothing")
        return NnModel(
            version=version,
            inputs=inputs,
            outputs=outputs,
            memories=memories,
            layers=layers,
            weights=weights,
            half=half,
            trailer=trailer,
        )

    def _layer(self) -> Layer:
        name = self._text()
        self._what = f"layer {name!r}"
        kind, activation = self._integer(), self._integer()
        self._ints(), self._ints()  # two arrays that every writer leaves empty
        pad, stride, pool = self._ints(), self._ints(), self._ints()
        axis = self._integer()
        alpha, beta = struct.unpack("<ff", self._take(8))
        self._ints()  # a third
        inputs = self._list(f"inputs of layer {name!r}", 4, self._text)
        datasets = self._list(f"datasets of layer {name!r}", 24, self._dataset)
        return Layer(
            name=name,
            type=kind,
            activation=activation,
            pad=pad,
            stride=stride,
            pool=pool,
            axis=axis,
            alpha=alpha,
            beta=beta,
            inputs=inputs,
            datasets=datasets,
        )

    def _dataset(self) -> Dataset:
        name = self._text()
        shape = self._shape()
        return Dataset(name, shape, self._integer(_LONG), self._integer(), self._integer())

    def _weights(self, layers: tuple[Layer, ...], half: bool) -> npt.NDArray[np.float32]:
        """The stream; it ends where the lengths of all datasets together say, as Unity's loader has it."""
        self._what = "the weights"
        datasets = [(layer, dataset) for layer in layers for dataset in layer.datasets]
        total = sum(dataset.length for _, dataset in datasets)
        for layer, dataset in datasets:
            self._what = f"dataset {dataset.name!r} of layer {layer.name!r}"
            elements = 1
            for length in dataset.shape:
                elements *= length
            if min(dataset.shape) < 0 or elements != dataset.length:
                raise self._error(
                    f"its shape {list(dataset.shape)} does not have its {dataset.length} elements",
                    "a converter that did not know the type of a constant leaves it empty",
                )
            if dataset.offset < 0 or dataset.offset + dataset.length > total:
                raise self._error(
                    f"it is at {dataset.offset} to {dataset.offset + dataset.length}",
                    f"the weights have {total} elements",
                )
            if dataset.item_size not in ((4, 2) if half else (4,)):
                raise self._error(f"its elements have {dataset.item_size} bytes", "weights are float32 or half")
        self._what = "the weights"
        size = 2 if half else 4
        stream = np.frombuffer(self._take(total * size), "<f2" if half else "<f4")
        with np.errstate(invalid="ignore"):  # signalling NaNs
            return stream.astype(np.float32)

    def _trailer(self, version: int) -> Trailer:
        self._what = "the importer's report after the weights"
        source, ir_version, producer = self._text(), self._text(), self._text()
        warnings = self._list("importer's warnings", 8, lambda: (self._text(), self._text()))
        metadata: tuple[tuple[str, str], ...] = ()
        if version >= METADATA or self._at < len(self._data):
            metadata = self._list("metadata", 8, lambda: (self._text(), self._text()))
        return Trailer(source, ir_version, producer, warnings, metadata)

    # ------------------------------------------------------------------ the primitives

    def _take(self, count: int) -> bytes:
        left = len(self._data) - self._at
        if not 0 <= count <= left:
            raise self._error(f"the file ends inside {self._what}", f"{count} bytes should follow, {left} are left")
        self._at += count
        return self._data[self._at - count : self._at]

    def _integer(self, form: struct.Struct = _INT) -> int:
        number: int = form.unpack(self._take(form.size))[0]
        return number

    def _count(self, smallest: int) -> int:
        """A number of items of at least ``smallest`` bytes each, for which there is room."""
        count = self._integer()
        left = len(self._data) - self._at
        if count < 0 or count * smallest > left:
            raise self._error(f"{self._what}: a count of {count}", f"only {left} bytes are left for that")
        return count

    def _ints(self) -> Ints:
        count = self._count(4)
        return struct.unpack(f"<{count}i", self._take(4 * count))

    def _shape(self) -> Ints:
        shape = self._ints()
        if not 0 < len(shape) <= _MAX_AXES:
            raise self._error(f"{self._what}: a shape of {len(shape)} axes", "shapes have four or eight")
        return shape

    def _text(self) -> str:
        """Characters, not bytes: Unity writes UTF-8 and counts in UTF-16 units. Names of the trainers are ASCII."""
        count = self._count(1)
        raw = self._take(count)
        if raw.isascii():
            return raw.decode("ascii")
        self._at -= count
        characters: list[str] = []
        while count > 0:
            first = self._data[self._at] if self._at < len(self._data) else 0
            size = 1 if first < 0x80 else 2 if first < 0xE0 else 3 if first < 0xF0 else 4
            count -= 2 if size == 4 else 1
            try:
                characters.append(self._take(size).decode("utf-8"))
            except UnicodeDecodeError as error:
                raise self._error(f"{self._what}: a name is not text", str(error)) from error
        return "".join(characters)

    def _list(self, what: str, smallest: int, read: Callable[[], _Item], most: int = 1 << 31) -> tuple[_Item, ...]:
        self._what = f"the {what}"
        items = []
        count = self._count(smallest)
        if count > most:
            raise self._error(f"it has {count} {what}", f"no more than {most} are read; a policy has some hundreds")
        for number in range(count):
            self._what = f"number {number + 1} of the {what}"
            items.append(read())
        return tuple(items)

    def _error(self, what: str, why: str) -> DamagedFileError:
        prefix = "" if self._what in what else f"{self._what}: "
        return DamagedFileError(
            f"{prefix}{what}",
            where=f"byte {self._at}",
            why=why,
            fix="copy or download the .nn again; if it is whole in Unity, please open an issue with it",
        )
