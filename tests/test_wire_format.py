"""The walker of protobuf's wire format, compared with protobuf's own reading of fields that it does not know."""

from __future__ import annotations

import contextlib
import struct
from typing import Any

import pytest
from google.protobuf.internal.encoder import _VarintBytes
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.files.protobuf_messages import message_classes
from export_model.converters.files.wire_format import (
    BYTES,
    LONG,
    SHORT,
    VARINT,
    CutOffError,
    WireError,
    message_fields,
    read_varint,
)

NOTHING = message_classes("nothing_walked", {"Nothing": "536870911 none bool"}, {}, "proto3")["Nothing"]
NUMBERS = st.integers(1, (1 << 29) - 2)
CONTENTS = st.one_of(
    st.tuples(st.just(VARINT), st.integers(0, (1 << 64) - 1)),
    st.tuples(st.just(LONG), st.integers(0, (1 << 64) - 1)),
    st.tuples(st.just(SHORT), st.integers(0, (1 << 32) - 1)),
    st.tuples(st.just(BYTES), st.binary(max_size=300)),
)


def written(number: int, kind: int, content: Any) -> bytes:
    tag = _VarintBytes(number << 3 | kind)
    if kind == BYTES:
        return bytes(tag + _VarintBytes(len(content)) + content)
    return bytes(
        tag + (_VarintBytes(content) if kind == VARINT else struct.pack("<I" if kind == SHORT else "<Q", content))
    )


def content_of(data: bytes, tag: int, start: int, end: int) -> Any:
    part = data[start:end]
    return (
        part
        if tag & 7 == BYTES
        else read_varint(part, 0, len(part))[0]
        if tag & 7 == VARINT
        else int.from_bytes(part, "little")
    )


@given(st.lists(st.tuples(NUMBERS, CONTENTS), max_size=20))
def test_the_fields_are_those_that_protobuf_reads(wanted: list[tuple[int, tuple[int, Any]]]) -> None:
    data = b"".join(written(number, *content) for number, content in wanted)
    found = [(tag >> 3, tag & 7, content_of(data, tag, *span)) for tag, _, *span in message_fields(data, 0, len(data))]
    assert found == [(f.field_number, f.wire_type, f.data) for f in UnknownFieldSet(NOTHING.FromString(data))]


@given(st.binary(max_size=60))
def test_what_protobuf_reads_is_walked_to_its_end(data: bytes) -> None:
    with contextlib.suppress(DecodeError):
        NOTHING.FromString(data)
        ends = [end for *_, end in message_fields(data, 0, len(data))]
        assert (ends or [0])[-1] == len(data)


@given(st.lists(st.tuples(NUMBERS, CONTENTS), min_size=1, max_size=5), st.data())
def test_a_message_that_is_cut_off_is_told_from_a_whole_one(wanted: list[Any], chosen: st.DataObject) -> None:
    data = b"".join(written(number, *content) for number, content in wanted)
    cut = data[: chosen.draw(st.integers(1, len(data) - 1))]
    try:
        NOTHING.FromString(cut)
        return
    except DecodeError:
        pass
    with contextlib.suppress(CutOffError):
        assert list(message_fields(cut, 0, len(cut)))[-1][-1] > len(cut)


@pytest.mark.parametrize("damage", [b"\x0e\x00", b"\x0f\x00", b"\x02\x00", b"\x05aaaa"])
def test_a_type_or_number_that_no_field_has_is_refused(damage: bytes) -> None:
    with pytest.raises(DecodeError):
        NOTHING.FromString(damage)
    with pytest.raises(WireError):
        list(message_fields(damage, 0, len(damage)))
