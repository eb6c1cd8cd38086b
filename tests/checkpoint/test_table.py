"""Tables and their checksums: any content is read back, any damage is a clear error."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.formats.checkpoint import table as module
from export_model.converters.formats.checkpoint.crc32c import crc32c, mask_crc
from export_model.converters.formats.checkpoint.table import MAGIC, read_table
from export_model.signatures.errors import DamagedFileError, ExportModelError
from tests.checkpoint.writing import block, table, varint
from tests.conftest import examples

PAIRS = st.dictionaries(st.binary(max_size=12), st.binary(max_size=40), min_size=1, max_size=40).map(
    lambda d: sorted(d.items())
)


# ------------------------------------------------------------------ checksums


def bitwise(data: bytes) -> int:
    """CRC-32C by its definition."""
    state = 0xFFFFFFFF
    for byte in data:
        state ^= byte
        for _ in range(8):
            state = state >> 1 ^ (0x82F63B78 if state & 1 else 0)
    return state ^ 0xFFFFFFFF


def test_crc32c_of_known_strings() -> None:
    """The test vectors of RFC 3720, B.4, and the masking that crc32c.h documents."""
    assert crc32c(b"123456789") == 0xE3069283
    assert crc32c(bytes(32)) == 0x8A9136AA
    assert crc32c(b"\xff" * 32) == 0x62A8AB43
    assert crc32c(bytes(range(32))) == 0x46DD794E
    assert mask_crc(0) == 0xA282EAD8
    assert mask_crc(0xFFFFFFFF) == 0xA282EAD7


@given(st.integers(0, 3000), st.binary(min_size=1, max_size=40))
def test_crc32c_in_lanes_is_the_same(extra: int, pattern: bytes) -> None:
    data = (pattern * (40000 // len(pattern) + 1))[: 32768 + extra]
    assert len(data) >= 32768
    assert crc32c(data) == _by_pieces(data) == crc32c(data[extra:], crc32c(data[:extra]))


def _by_pieces(data: bytes) -> int:
    import export_model.converters.formats.checkpoint.crc32c as own

    return own._scalar(0xFFFFFFFF, data) ^ 0xFFFFFFFF


@given(st.binary(max_size=200))
def test_crc32c_of_short_data_is_by_the_definition(data: bytes) -> None:
    assert crc32c(data) == bitwise(data)


# ------------------------------------------------------------------ tables


@given(PAIRS, st.integers(1, 10), st.integers(1, 6))
def test_any_table_is_read_back(pairs: list[tuple[bytes, bytes]], size: int, interval: int) -> None:
    data = table(pairs, per_block=size, interval=interval)
    assert list(read_table(data)) == pairs


def test_an_empty_table() -> None:
    assert list(read_table(table([]))) == []


@examples(300)
@given(PAIRS, st.data())
def test_a_changed_bit_is_found(pairs: list[tuple[bytes, bytes]], data: st.DataObject) -> None:
    """Every byte that is read is under a checksum or in the footer; what is under none changes nothing."""
    good = bytearray(table(pairs, per_block=3))
    position = data.draw(st.integers(0, len(good) - 1))
    good[position] ^= 1 << data.draw(st.integers(0, 7))
    try:
        read = list(read_table(bytes(good)))
    except DamagedFileError as error:
        assert error.fix
    else:
        assert read == pairs  # the metaindex, or the padding of the footer


@given(PAIRS, st.data())
def test_a_shorter_file_is_refused(pairs: list[tuple[bytes, bytes]], data: st.DataObject) -> None:
    good = table(pairs)
    with pytest.raises(DamagedFileError):
        list(read_table(good[: data.draw(st.integers(0, len(good) - 1))]))
    start = data.draw(st.integers(1, len(good) - 1))
    with pytest.raises(DamagedFileError):
        list(read_table(good[start:]))


def framed(content: bytes, kind: bytes = b"\0") -> bytes:
    return content + kind + struct.pack("<I", mask_crc(crc32c(content + kind)))


def with_index(blocks: bytes, index: bytes) -> bytes:
    """A table of these bytes and this index block."""
    place = varint(len(blocks)) + varint(len(index))
    return blocks + framed(index) + (varint(0) + varint(0) + place).ljust(40, b"\0") + MAGIC


@given(st.binary(max_size=80))
def test_a_block_of_anything_under_a_good_checksum(content: bytes) -> None:
    """What a checksum cannot find: a writer that lies."""
    body = framed(content)
    index = block([(b"zzzz", varint(0) + varint(len(content)))], 1)
    for data in (with_index(body, index), with_index(body, content)):
        try:
            list(read_table(data))
        except ExportModelError as error:
            assert error.what


def test_faults_are_named() -> None:
    pairs = [(b"a", b"1"), (b"b", b"2"), (b"c", b"3")]
    good = bytearray(table(pairs))
    good[2] ^= 1
    with pytest.raises(DamagedFileError, match=r"data block at byte 0 has another checksum \(crc32c\)"):
        list(read_table(bytes(good)))
    content = block(pairs, 2)
    place = varint(0) + varint(len(content))
    twice = with_index(framed(content), block([(b"c", place), (b"d", place)], 1))
    with pytest.raises(DamagedFileError, match="overlaps"):
        list(read_table(twice))
    beyond = with_index(framed(content), block([(b"c", varint(0) + varint(1 << 40))], 1))
    with pytest.raises(DamagedFileError, match="beyond the end of the file"):
        list(read_table(beyond))
    disorder = block([(b"b", b""), (b"a", b"")], 1)
    wrong = with_index(framed(disorder), block([(b"z", varint(0) + varint(len(disorder)))], 1))
    with pytest.raises(DamagedFileError, match="disorder"):
        list(read_table(wrong))
    snappy = with_index(framed(content, b"\1"), block([(b"c", place)], 1))
    with pytest.raises(DamagedFileError, match="compression 1"):
        list(read_table(snappy))
    low = with_index(framed(content), block([(b"b", place)], 1))
    with pytest.raises(DamagedFileError, match="beyond the key that the index names"):
        list(read_table(low))


def test_keys_that_unfold_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each key takes a few bytes and stands for all of the one before."""
    monkeypatch.setattr(module, "MAX_KEY_BYTES", 10_000)
    content = bytearray(varint(0) + varint(1000) + varint(0) + b"k" * 1000)
    for number in range(1, 200):
        content += varint(1000 + number - 1) + varint(1) + varint(0) + b"k"
    content += struct.pack("<II", 0, 1)
    data = with_index(framed(bytes(content)), block([(b"z", varint(0) + varint(len(content)))], 1))
    with pytest.raises(DamagedFileError, match="keys of more than 10000 bytes"):
        list(read_table(data))
