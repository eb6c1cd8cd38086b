"""The bytes: what is written is read back, and what is not a ``.nn`` is an error that says where."""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import fields, replace

from export_model.converters.formats.barracuda.format import (
    VERSIONS,
    Dataset,
    Layer,
    NnInput,
    NnMemory,
    NnModel,
    Trailer,
    parse,
)
from export_model.converters.formats.barracuda.graph import to_graph
from export_model.signatures.errors import DamagedFileError, ExportModelError
from tests.barracuda.cases import Case, all_cases
from tests.barracuda.conftest import public_files
from tests.barracuda.nn_files import Maker, write_nn
from tests.conftest import examples

INT32 = st.integers(-(2**31), 2**31 - 1)
NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",)), max_size=12)
FLOATS = st.floats(width=32, allow_nan=False)
PAIRS = st.lists(st.tuples(NAMES, NAMES), max_size=3).map(tuple)


@st.composite
def models(draw: st.DrawFn) -> NnModel:
    version = draw(st.sampled_from(VERSIONS))
    half = version >= 20 and draw(st.booleans())
    axes = st.sampled_from((4, 8) if version >= 17 else (4,))

    def shapes(low: int = -1, high: int = 2**31 - 1) -> st.SearchStrategy[tuple[int, ...]]:
        return axes.flatmap(lambda n: st.tuples(*[st.integers(low, high)] * n))

    def ints() -> tuple[int, ...]:
        return tuple(draw(st.lists(INT32, max_size=8)))

    layers, weights = [], []
    for _ in range(draw(st.integers(0, 4))):
        datasets = []
        for _ in range(draw(st.integers(0, 3))):
            shape = draw(shapes(0, 2))
            length = int(np.prod(shape))
            offset = sum(w.size for w in weights)
            datasets.append(Dataset(draw(NAMES), shape, offset, 2 if half and draw(st.booleans()) else 4, length))
            values = draw(st.lists(st.floats(-1000, 1000, width=16), min_size=length, max_size=length))
            weights.append(np.array(values, np.float32))
        layers.append(
            Layer(
                draw(NAMES), draw(INT32), draw(INT32), ints(), ints(), ints(), draw(INT32), draw(FLOATS), draw(FLOATS),
                tuple(draw(st.lists(NAMES, max_size=3))), tuple(datasets),
            )
        )  # fmt: skip
    trailer = None
    if draw(st.booleans()):
        metadata = draw(PAIRS) if version >= 18 else ()
        trailer = Trailer(draw(NAMES), draw(NAMES), draw(NAMES), draw(PAIRS), metadata)
    return NnModel(
        version,
        tuple(draw(st.lists(st.builds(NnInput, NAMES, shapes()), max_size=3))),
        tuple(draw(st.lists(NAMES, max_size=3))),
        tuple(draw(st.lists(st.builds(NnMemory, shapes(), NAMES, NAMES), max_size=2))),
        tuple(layers),
        np.concatenate(weights) if weights else np.zeros(0, np.float32),
        half,
        trailer,
    )


def assert_same(a: NnModel, b: NnModel) -> None:
    for f in fields(NnModel):
        if f.name != "weights":
            assert getattr(a, f.name) == getattr(b, f.name), f.name
    np.testing.assert_array_equal(a.weights, b.weights)


@given(models())
@examples(150)
def test_what_is_written_is_read_back(model: NnModel) -> None:
    assert_same(parse(write_nn(model)), model)


@given(models(), st.data())
@examples(60)
def test_a_file_cut_anywhere_is_an_error_with_its_place(model: NnModel, data: st.DataObject) -> None:
    whole = write_nn(model)
    end = len(write_nn(replace(model, trailer=None)))
    cut = data.draw(st.integers(0, len(whole) - 1))
    if cut == end:  # without the trailer, which is optional, it is whole again
        assert parse(whole[:cut]).trailer is None
        return
    with pytest.raises(DamagedFileError) as caught:
        parse(whole[:cut])
    assert caught.value.where is not None
    assert caught.value.where.startswith("byte ")
    assert caught.value.why
    assert caught.value.fix


@given(st.binary(max_size=300), st.sampled_from(VERSIONS))
@examples(300)
def test_garbage_is_refused(data: bytes, version: int) -> None:
    for file in (data, struct.pack("<q", version) + data):
        try:
            to_graph(parse(file))
        except ExportModelError:
            continue
        assert parse(file).layers == ()


def small() -> NnModel:
    m = Maker()
    m.input("vector_observation", 1, 1, 4)
    m.load("version_number", 2.0)
    data = {"k": np.ones((4, 1, 1, 2)), "b": np.zeros((1, 1, 1, 2))}
    m.layer("action", 1, "vector_observation", data=data)
    return m.model()


@given(st.data())
@examples(400)
def test_a_changed_byte_is_read_or_refused(data: st.DataObject) -> None:
    file = bytearray(write_nn(small()))
    for _ in range(data.draw(st.integers(1, 4))):
        file[data.draw(st.integers(0, len(file) - 1))] = data.draw(st.integers(0, 255))
    try:
        to_graph(parse(bytes(file)))
    except ExportModelError as error:
        assert str(error)


@given(st.sampled_from(all_cases()), st.data())
@examples(400)
def test_changed_numbers_in_any_kind_of_layer_are_read_or_refused(case: Case, data: st.DataObject) -> None:
    file = bytearray(write_nn(case.model))
    numbers = st.sampled_from((-(2**31), -5, -1, 0, 1, 2, 3, 4, 8, 255, 1 << 24, 2**31 - 1))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, min(len(file), 800) - 4))
        file[at : at + 4] = struct.pack("<i", data.draw(numbers))
    try:
        to_graph(parse(bytes(file)))
    except ExportModelError as error:
        assert str(error)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d + b"\0" * 3, "the importer's report"),
        (lambda d: struct.pack("<q", 14) + d[8:], "the version is 14"),
        (lambda d: struct.pack("<q", 21) + d[8:], "the version is 21"),
        (lambda d: d[:8] + struct.pack("<i", 2**31 - 1) + d[12:], "a count of 2147483647"),
        (lambda d: d[:8] + struct.pack("<i", -1) + d[12:], "a count of -1"),
        (lambda d: d[:-1], "the file ends inside the weights"),
        (lambda d: b"", "the file ends inside the version"),
    ],
)
def test_the_error_says_what_is_wrong(change: object, words: str) -> None:
    assert callable(change)
    with pytest.raises(DamagedFileError, match=words):
        parse(change(write_nn(small())))


@pytest.mark.parametrize(
    ("dataset", "words"),
    [
        (Dataset("k", (1, 1, 1, 3), 0, 4, 2), "does not have its 2 elements"),
        (Dataset("k", (1, 1, 1, -2), 0, 4, -2), "does not have its -2 elements"),
        (Dataset("k", (1, 1, 1, 2), 1, 4, 2), "is at 1 to 3"),
        (Dataset("k", (1, 1, 1, 2), -1, 4, 2), "is at -1 to 1"),
        (Dataset("k", (1, 1, 1, 2), 0, 2, 2), "have 2 bytes"),
        (Dataset("k", (2**31 - 1,) * 4, 0, 4, 2**31 - 1), "does not have its 2147483647 elements"),
        (Dataset("k", (1, 1, 1, 2**31 - 1), 0, 4, 2**31 - 1), "the file ends inside the weights"),
    ],
)
def test_a_dataset_that_cannot_be(dataset: Dataset, words: str) -> None:
    layer = Layer("a", 255, datasets=(dataset,))
    model = NnModel(16, (), (), (), (layer,), np.zeros(2, np.float32))
    with pytest.raises(DamagedFileError, match=words):
        parse(write_nn(model))


def test_nothing_is_allocated_for_a_count_that_the_file_does_not_hold() -> None:
    m = small()
    file = write_nn(m)[:12] + b"\xff\xff\xff\x7f" * 50
    tracemalloc.start()
    try:
        with pytest.raises(DamagedFileError):
            parse(file)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_the_padding_before_aligned_weights_is_1_to_16_zeros() -> None:
    for extra in range(20):
        m = Maker(19)
        m.layer("a" * extra, 255, data={"k": np.ones((1, 1, 1, 3))})
        file = write_nn(m.model())
        assert (len(file) - 12) % 16 == 0
        assert parse(file).weights.tolist() == [1, 1, 1]
        with pytest.raises(DamagedFileError, match="padding"):
            parse(file[:-13] + b"\1" + file[-12:])


def test_halves_are_widened() -> None:
    layer = Layer("a", 255, datasets=(Dataset("k", (1, 1, 1, 3), 0, 2, 3),))
    values = np.array([0.1, -65504, 6e-8], np.float16)
    model = NnModel(20, (), (), (), (layer,), values.astype(np.float32), half=True)
    read = parse(write_nn(model))
    assert read.half
    assert read.weights.dtype == np.float32
    np.testing.assert_array_equal(read.weights, values.astype(np.float32))


def test_a_name_counts_in_utf16_units_as_in_csharp() -> None:
    m = Maker(17)
    name = "Größe 𝔸 日"
    m.layer(name, 255, data={name: np.ones((1, 1, 1, 1))})
    read = parse(write_nn(m.model(trailer=Trailer("ONNX", "6", "pytorch", (("l", "wörn"),)))))
    assert read.layers[0].name == name
    assert read.trailer == Trailer("ONNX", "6", "pytorch", (("l", "wörn"),))


@pytest.mark.corpus
def test_every_public_file_is_read_to_its_last_byte(shared: Path) -> None:
    """58 files, 7 of them of version 15, which differs from 16 in nothing but the number."""
    files = public_files()
    found = [parse(p.read_bytes()) for p in files]
    assert len(found) == 58
    assert sorted({m.version for m in found}) == [15, 16]
    assert sum(m.version == 15 for m in found) == 7
    for path, model in zip(files, found, strict=True):
        assert write_nn(model) == path.read_bytes()
        assert model.trailer is None
        assert not model.half
