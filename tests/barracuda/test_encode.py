"""Bytes: what is read and written again is the same file, and what is written is what the tests' own writer writes."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from export_model.converters.formats.barracuda.format import NnModel, Trailer, parse
from export_model.converters.formats.barracuda.writer import encode
from tests.barracuda.conftest import SHARED
from tests.barracuda.nn_files import write_nn
from tests.barracuda.test_format import PAIRS, assert_same, models
from tests.conftest import examples


@given(models())
@examples(150)
def test_a_model_is_encoded_as_the_format_lays_it_out(model: NnModel) -> None:
    assert encode(model) == write_nn(model)


@given(models())
@examples(100)
def test_a_file_read_and_written_again_is_the_same_bytes(model: NnModel) -> None:
    data = write_nn(model)
    assert encode(parse(data)) == data


@given(models(), PAIRS)
@examples(100)
def test_metadata_lies_behind_what_loaders_of_an_older_version_read(
    model: NnModel, pairs: tuple[tuple[str, str], ...]
) -> None:
    trailer = model.trailer or Trailer("Script", "NA", "export-model")
    model = replace(model, trailer=replace(trailer, metadata=pairs))
    data = encode(model)
    assert_same(parse(data), model)
    before = encode(replace(model, trailer=replace(trailer, metadata=())))
    if model.version < 18:
        assert data.startswith(before)


@given(models(), st.integers(0, 3))
@examples(50)
def test_metadata_are_found_by_their_key(model: NnModel, number: int) -> None:
    pairs = tuple((f"key {i}", str(i)) for i in range(number))
    found = replace(model, trailer=Trailer("", "", "", (), pairs))
    assert [found.metadata(f"key {i}") for i in range(4)] == [*map(str, range(number)), *[None] * (4 - number)]
    assert replace(model, trailer=None).metadata("key 0") is None


@pytest.mark.corpus
def test_every_nn_beside_this_checkout_is_written_back_byte_for_byte(shared: Path) -> None:
    files = sorted(SHARED.rglob("*.nn"))
    assert len(files) > 100
    for path in files:
        data = path.read_bytes()
        assert encode(parse(data)) == data, path
