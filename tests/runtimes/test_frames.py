"""What a child answers may be anything: a frame is read, or refused, and takes no more memory than it may."""

from __future__ import annotations

import io
import json
import struct
from random import Random
from typing import Any

import numpy as np
import pytest

from export_model.converters.files.children.frames import MAX_HEADER_BYTES, FramingError, read_frame, write_frame

HEADER = {
    "ok": True,
    "error": "words",
    "tensors": [
        {"name": "0/a", "dtype": "float32", "shape": [2, 3]},
        {"name": "1/a", "dtype": "int64", "shape": [1]},
    ],
}
ODD = (None, -1, 0, 2**31, 2**70, 1.5, 1e308, "x", "O", "V0", "U3", "b1", "bfloat16", "i4,i4", ["f4"], {}, [2**70, 0])


def changed(value: Any, random: Random) -> Any:
    """The value with parts of it replaced, left out or doubled."""
    if random.random() < 0.25:
        return random.choice(ODD)
    if isinstance(value, dict):
        return {k: changed(v, random) for k, v in value.items() if random.random() > 0.1}
    if isinstance(value, list):
        return [changed(v, random) for v in value] * random.choice((1, 1, 1, 2))
    return value


def framed(header: Any, body: bytes = b"") -> io.BytesIO:
    text = json.dumps(header).encode()
    return io.BytesIO(struct.pack("<I", len(text)) + text + body)


def test_a_changed_frame_is_read_or_refused() -> None:
    """OverflowError and MemoryError came out of 31 of these before."""
    random = Random(1)
    for _ in range(20_000):
        frame = framed(changed(HEADER, random), random.randbytes(random.choice((0, 24, 32, 40))))
        try:
            header, tensors = read_frame(frame)
        except (EOFError, FramingError):
            continue
        assert isinstance(header, dict) and all(isinstance(a, np.ndarray) for a in tensors.values())


@pytest.mark.parametrize(
    "stream",
    [
        io.BytesIO(struct.pack("<I", MAX_HEADER_BYTES + 1)),
        framed({"tensors": [{"name": "a", "dtype": "float32", "shape": [1 << 40]}]}),
        framed({"tensors": [{"name": str(i), "dtype": "uint8", "shape": [60]} for i in range(2)]}, bytes(120)),
    ],
)
def test_more_than_an_answer_may_have_is_not_waited_for(stream: io.BytesIO) -> None:
    with pytest.raises(FramingError):
        read_frame(stream, 100)


def test_as_much_as_an_answer_may_have_is_read() -> None:
    stream = io.BytesIO()
    write_frame(stream, {"ok": True}, {"a": np.arange(25, dtype=np.float32)})
    stream.seek(0)
    assert read_frame(stream, 100)[1]["a"].sum() == 300
