"""Checkpoints of the V2 format: every dtype and shape, shards, slices; damage is named with tensor and file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.checkpoint.tensor_bundle import Checkpoint, slice_key
from export_model.signatures.errors import DamagedFileError, ExportModelError, NotAPolicyError, SourceError
from tests.checkpoint.writing import bundle, table
from tests.conftest import examples

DTYPES = (np.float32, np.float64, np.float16, np.int32, np.int64, np.uint8, np.bool_)
VALUES = st.dictionaries(
    st.text("abcdefgh/_", min_size=1, max_size=12),
    st.sampled_from(DTYPES).flatmap(
        lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
    ),
    min_size=1,
    max_size=8,
)
FRESH = examples(60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


@FRESH
@given(VALUES, st.integers(1, 3), st.booleans())
def test_any_checkpoint_is_read_back(tmp_path: Path, values: dict[str, np.ndarray], shards: int, big: bool) -> None:
    bundle(tmp_path / "m", values, shards=shards, big=big)
    checkpoint = Checkpoint(tmp_path / "m")
    assert checkpoint.names == sorted(values, key=str.encode)
    assert len(checkpoint.files) == 1 + shards
    for name, value in values.items():
        read = checkpoint.read(name)
        assert (read.dtype, read.shape) == (value.dtype, value.shape)
        np.testing.assert_array_equal(read, value)


@FRESH
@given(st.integers(0, 2), st.data())
def test_a_changed_bit_is_found(tmp_path: Path, shards: int, data: st.DataObject) -> None:
    for left in tmp_path.iterdir():  # by the example before
        left.unlink()
    values = {"dense/kernel": np.arange(12, dtype=np.float32).reshape(3, 4), "step": np.array(5, np.int64)}
    bundle(tmp_path / "m", values, shards=shards + 1)
    file = data.draw(st.sampled_from(sorted(p for p in tmp_path.iterdir() if p.stat().st_size)))
    content = bytearray(file.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    file.write_bytes(bytes(content))
    try:
        checkpoint = Checkpoint(tmp_path / "m")
        read = {name: checkpoint.read(name) for name in values}
    except ExportModelError as error:
        assert file.name in str(error.where)
    else:  # in the table's metaindex or in the footer's padding
        for name, value in values.items():
            np.testing.assert_array_equal(read[name], value)


def test_slices_are_joined_and_cut(tmp_path: Path) -> None:
    value = np.arange(24, dtype=np.float32).reshape(6, 4)
    parts = [((0, 2), (0, 0)), ((2, 4), (0, 3)), ((2, 4), (3, 1))]
    bundle(tmp_path / "m", {"part": value, "whole": value}, slices={"part": parts}, shards=2)
    checkpoint = Checkpoint(tmp_path / "m")
    assert checkpoint.names == ["part", "whole"]
    for name in ("part", "whole"):
        np.testing.assert_array_equal(checkpoint.read(name), value)
        np.testing.assert_array_equal(checkpoint.read(name, ((1, 3), (0, 0))), value[1:4])
        with pytest.raises(DamagedFileError, match="beyond its shape"):
            checkpoint.read(name, ((5, 3), (0, 0)))
        with pytest.raises(DamagedFileError, match="1 axes"):
            checkpoint.read(name, ((0, 1),))


def test_slices_that_leave_a_hole_are_refused(tmp_path: Path) -> None:
    value = np.arange(6, dtype=np.float32)
    bundle(tmp_path / "hole", {"part": value}, slices={"part": [((0, 2),), ((3, 3),)]})
    with pytest.raises(DamagedFileError, match="6 elements and its slices 5"):
        Checkpoint(tmp_path / "hole").read("part")
    bundle(tmp_path / "twice", {"part": value}, slices={"part": [((0, 4),), ((2, 2),)]})
    with pytest.raises(DamagedFileError, match="do not make up the whole"):
        Checkpoint(tmp_path / "twice").read("part")


def test_the_key_of_a_slice_is_tensorflows() -> None:
    """The first two are of a checkpoint that TensorFlow 2.21 wrote; the others follow ordered_code.cc."""
    assert slice_key("kernel", ((0, 3), (0, 4))) == b"\x00kernel\x00\x01\x01\x02\x80\x83\x80\x84"
    assert slice_key("kernel", ((5, 2), (0, 4))) == b"\x00kernel\x00\x01\x01\x02\x85\x82\x80\x84"
    assert slice_key("kernel", ((0, 0),)) == b"\x00kernel\x00\x01\x01\x01\x80\x7f"
    assert slice_key("a\x00", ((100, 9000),)) == b"\x00a\x00\xff\x00\x01\x01\x01\xc0\x64\xe0\x23\x28"


def test_missing_and_short_shards_are_named(tmp_path: Path) -> None:
    values = {"a": np.zeros(100, np.float32), "b": np.ones(100, np.float32)}
    bundle(tmp_path / "m", values)
    shard = tmp_path / "m.data-00000-of-00001"
    shard.write_bytes(shard.read_bytes()[:500])
    np.testing.assert_array_equal(Checkpoint(tmp_path / "m").read("a"), values["a"])
    with pytest.raises(DamagedFileError, match=r"'b' is beyond the end of the file") as caught:
        Checkpoint(tmp_path / "m").read("b")
    assert caught.value.where == shard.name
    shard.unlink()
    with pytest.raises(SourceError, match=r"data-00000-of-00001: is missing"):
        Checkpoint(tmp_path / "m").read("a")


def entry(dtype: int = 1, shape: tuple[int, ...] = (2,), shard: int = 0, offset: int = 0, size: int = 8) -> bytes:
    message = schema.BundleEntryProto(dtype=dtype, shard_id=shard, offset=offset, size=size)
    for n in shape:
        message.shape.dim.add(size=n)
    data: bytes = message.SerializeToString()
    return data


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (entry(shape=(1 << 40, 1 << 40)), "has 8 bytes"),
        (entry(shape=(3,)), "has 8 bytes"),
        (entry(shape=(-1,)), "shape of 'x' is not known"),
        (entry(shape=(1,) * 40, size=4), "shape of 'x' is not known"),
        (entry(shard=7), "shard 7 of 1"),
        (entry(offset=-8), "beyond the end of the file"),
        (entry(offset=1 << 60), "beyond the end of the file"),
        (entry(dtype=7), "holds no numbers"),
        (entry(dtype=8), "dtype number 8"),
        (b"\xff\xff", "not a whole entry of 'x'"),
    ],
)
def test_entries_that_lie(tmp_path: Path, wrong: bytes, text: str) -> None:
    header = schema.BundleHeaderProto(num_shards=1).SerializeToString()
    (tmp_path / "m.index").write_bytes(table([(b"", header), (b"x", wrong)]))
    (tmp_path / "m.data-00000-of-00001").write_bytes(bytes(8))
    with pytest.raises(ExportModelError, match=text):
        Checkpoint(tmp_path / "m").read("x")


@pytest.mark.parametrize(
    ("header", "error", "text"),
    [
        (None, DamagedFileError, "no header"),
        (
            b"\x10\x00",
            DamagedFileError,
            "claims 0 shards",
        ),
        (b"\x08\xff\xff\xff\xff\x07", DamagedFileError, "shards"),
        (b"\x0a\x02\x12\x00", NotAPolicyError, r"first format \(V1\)"),
    ],
)
def test_headers(tmp_path: Path, header: bytes | None, error: type[Exception], text: str) -> None:
    (tmp_path / "m.index").write_bytes(table([(b"x", entry())] if header is None else [(b"", header)]))
    with pytest.raises(error, match=text):
        Checkpoint(tmp_path / "m")
