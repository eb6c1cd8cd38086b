"""Files that are never held whole: pieces of any layout, and messages whose large contents lie beside them."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.chunks import Pieces, equal
from export_model.converters.files.external_data import LARGE, LARGE_FILE, Detached
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import DamagedFileError
from tests.bench.big_policies import KINDS
from tests.exporting import export_model
from tests.handmade import constant, graph_def

WIDE = np.arange(5 << 18, dtype=np.float32).reshape(1 << 10, -1)
LAYOUTS = {
    "as it lies": WIDE,
    "transposed": WIDE.T,
    "transposed twice": WIDE.reshape(8, 128, -1).transpose(2, 0, 1),
    "one row of rows": WIDE.T[None],
    "every other": WIDE[::2, ::3],
    "big-endian": WIDE.astype(">f4"),
    "unaligned": np.frombuffer(b"-" + WIDE.tobytes(), np.uint8)[1:].view("<f4").reshape(WIDE.shape),
    "a number": np.array(3.5, np.float32),
    "nothing": np.zeros((0, 4), np.float32),
    "truths": np.arange(100) % 3 == 0,
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_array_of_any_layout_is_written_as_its_numbers(layout: str, tmp_path: Path) -> None:
    array = LAYOUTS[layout]
    expected = array.astype(array.dtype.newbyteorder("<")).tobytes()
    whole = Pieces(b"before", array, b"behind")
    assert whole.to_bytes() == b"before" + expected + b"behind"
    assert whole.write(tmp_path / "file") == sha256_hex((tmp_path / "file").read_bytes())
    assert whole.size == (tmp_path / "file").stat().st_size
    cuts = sorted([0, 3, 8, whole.size // 3 + 1, whole.size - 3, whole.size + 9])
    assert b"".join(whole.part(a, b).to_bytes() for a, b in pairwise(cuts)) == whole.to_bytes()


def test_arrays_are_equal_where_their_bytes_are() -> None:
    assert equal(WIDE.T, np.ascontiguousarray(WIDE.T))
    assert not equal(np.array([0.0]), np.array([-0.0]))


def graph_of_weights() -> bytes:
    """A graph of just more than what is taken apart, with constants around the size from which they are."""
    sizes = [1, LARGE // 4 - 1, LARGE // 4, LARGE_FILE // 4]
    message = graph_def([constant(f"c{i}", np.arange(n, dtype=np.float32)) for i, n in enumerate(sizes)])
    return schema.serialise(message)


def test_a_message_without_its_weights_becomes_the_same_again() -> None:
    data, detached = graph_of_weights(), Detached()
    message = schema.parse(schema.GraphDef, data, "graph", detached)
    assert len(schema.serialise(message)) < 3 * LARGE
    assert schema.pieces(message, detached).to_bytes() == data
    for node in read_graph(data).nodes:
        assert node.value is not None
        np.testing.assert_array_equal(node.value, np.arange(node.value.size))


@pytest.mark.parametrize("cut", [1, 100, LARGE_FILE // 2])
def test_a_large_file_that_is_cut_off_is_damaged(cut: int) -> None:
    with pytest.raises(DamagedFileError):
        read_graph(graph_of_weights()[:-cut])


@pytest.mark.parametrize("kind", ["frozen", "onnx"])
def test_an_export_holds_the_weights_once(kind: str, tmp_path: Path) -> None:
    """A source of 16 MB in four formats: its bytes, and some megabytes beside them."""
    place = tmp_path / f"big.{kind}"
    KINDS[kind](16, place)
    export_model("fixtures/continuous.bytes", tmp_path / "warm", verify="none")  # what is imported is no weight
    tracemalloc.start()
    export_model(place, tmp_path / "out", verify="none")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < place.stat().st_size * 1.5 + (4 << 20)
