"""What can be seen of a file's bytes without reading its format: text, JSON, a ZIP archive, protobuf's fields."""

from __future__ import annotations

import codecs
import io
import json
import re
import struct
import zipfile
from functools import cached_property
from itertools import islice
from typing import Any

from export_model.converters.files.wire_format import GROUP, GROUP_END, CutOffError, WireError, message_fields
from export_model.signatures.bounded import loads

_HEAD = 4096
#: How a pickle begins, of protocol 2 on.
PICKLES = tuple(bytes((0x80, protocol)) for protocol in (2, 3, 4, 5))
#: PyTorch's magic number as a pickle, with which ``torch.save`` began its files before 1.6 (torch/serialization.py).
_TORCH_MAGIC = b"\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
_SURROGATE = re.compile(r"[\ud800-\udfff]|\\u[dD][89a-fA-F]")


class Content:
    """A file's bytes and name, looked at from all sides; each look is taken once. Nothing here raises."""

    def __init__(self, data: bytes, name: str = "") -> None:
        self.data, self.name = data, name
        self.head = data[:_HEAD]

    def starts(self, *beginnings: bytes) -> bool:
        """Whether it begins with one of these."""
        return self.head.startswith(beginnings)

    @cached_property
    def text(self) -> str | None:
        """The beginning as text, white space before it left out; None where it is none."""
        try:
            text = codecs.getincrementaldecoder("utf-8-sig")().decode(self.head)  # may end inside a character
        except UnicodeDecodeError:
            return None
        return None if any(ord(c) < 9 or 13 < ord(c) < 27 for c in text) else text.lstrip()

    @cached_property
    def json(self) -> dict[str, Any] | None:
        """The object that it is in JSON, None where it is none."""
        if self.text is None or not self.text.startswith("{"):
            return None
        try:
            found: dict[str, Any] = loads(self.data.decode("utf-8-sig"))
        except (ValueError, RecursionError):
            return None
        return found

    @cached_property
    def entries(self) -> list[str]:
        """The names in a ZIP archive; empty where it is none, or damaged."""
        if not self.starts(b"PK\x03\x04"):
            return []
        try:
            return zipfile.ZipFile(io.BytesIO(self.data)).namelist()
        except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError, struct.error):
            return []

    @property
    def is_torch_row(self) -> bool:
        """Whether it is pickles in a row, as PyTorch wrote them (from protocol 4 on behind the header of a frame)."""
        return self.starts(*PICKLES) and _TORCH_MAGIC in self.head[:32]

    @cached_property
    def fields(self) -> list[tuple[int, int, memoryview]]:
        """(number, wire type, payload) of the first fields of a protobuf message; empty where it is none."""
        return _fields(memoryview(self.data)) if self.text is None else []

    @property
    def numbers(self) -> set[tuple[int, int]]:
        """(number, wire type) of the first fields of a protobuf message."""
        return {(number, wire) for number, wire, _ in self.fields}

    @cached_property
    def is_graph(self) -> bool:
        """Whether it is a GraphDef: it begins with a node (field 1), which has a name (1) and an op (2)."""
        if not self.fields or self.fields[0][:2] != (1, 2):
            return False
        first = _fields(self.fields[0][2], 3)
        return [field[:2] for field in first[:2]] == [(1, 2), (2, 2)] and _is_op_name(bytes(first[1][2][:100]))


def json_in(data: bytes | str) -> Any:
    """Parse untrusted JSON text.

    Raises ValueError for other text, for half a surrogate pair and for too many values; and RecursionError.
    """
    text = data if isinstance(data, str) else data.decode("utf-8-sig")
    found = loads(text)
    if _SURROGATE.search(text):  # halves of a character: nothing can be written under such a name
        json.dumps(found, ensure_ascii=False).encode()
    return found


def _is_op_name(data: bytes) -> bool:
    return bool(data) and data[:1].isalpha() | data.startswith(b"_") and all(c < 128 for c in data) and len(data) < 100


def _fields(data: memoryview, limit: int = 64) -> list[tuple[int, int, memoryview]]:
    """(number, type, content) of a message's first fields, the last of which may be cut off; none of no message."""
    found: list[tuple[int, int, memoryview]] = []
    try:
        for tag, _, start, end in islice(message_fields(data, 0, len(data)), limit):
            if tag & 7 in (GROUP, GROUP_END):
                return []
            found.append((tag >> 3, tag & 7, data[start:end]))
    except CutOffError:
        pass
    except WireError:
        return []
    return found
