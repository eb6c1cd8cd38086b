"""Changes that keep a file's structure: protobuf trees without their schema, JSON, and files cut into parts.

All is drawn from the ``Random`` that is given, so that a mutant is made again from its number.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from random import Random
from typing import Any

from google.protobuf.message import DecodeError

#: Numbers that formats break at.
INTEGERS = (
    *(0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 14, 16, 19, 20, 21, 31, 32, 64, 101, 127, 128, 255, 256),
    *(-1, -2, -3, 1 << 16, 1 << 20, 1 << 24, (1 << 31) - 1, 1 << 31, 1 << 32, 1 << 40, 1 << 62, (1 << 63) - 1),
    *(-(1 << 31), -(1 << 63)),
)
FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-45, 1e38, -1e38, math.inf, -math.inf, math.nan)
#: Texts that break a reader, a terminal, a path or code.
TEXTS = (
    *(b"", b"\xff", b"\xc3\x28", b"a\xed\xa0\x80", b"\0", b"a\0b", b"a\nb", b"\x1b]52;c;eA==\x07", b"'\"`${x}"),
    *(b"</script>", b"../../x", b"/etc/passwd", b".", b"..", b"con", b"\xe2\x80\xae", b"\xf0\x9f\x92\xa9"),
    *(b"a" * 5000, b":0", b"a:1", b"^a", b"action", b"vector_observation", b"recurrent_in", b"Const", b"Identity"),
    *(b"Placeholder", b"VALID", b"NCHW", b"dtype", b"shape", b"value", b"axis", b"0", b"-1", b"1e999", b"NaN"),
    *(b"float32", b"int64", b"DT_INT32"),
)


def number(random: Random, near: int = 0) -> int:
    """An integer that is near another, or one that formats break at."""
    return near + random.choice((-1, 1, 2, -near)) if random.random() < 0.3 else random.choice(INTEGERS)


def text(random: Random, known: list[bytes]) -> bytes:
    """Text of elsewhere in the file, or text that breaks something."""
    if known and random.random() < 0.6:
        return random.choice(known)
    return random.choice(TEXTS)


def damaged(data: bytes, random: Random) -> bytes:
    """Bytes flipped, cut, put in, left out."""
    made = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 4))):
        at = random.randrange(len(made) + 1)
        how = random.randrange(5)
        if how == 0 and made:
            made[at % len(made)] ^= 1 << random.randrange(8)
        elif how == 1:
            del made[at : at + random.choice((1, 2, 4, 16, 256))]
        elif how == 2:
            made[at:at] = random.randbytes(random.choice((1, 2, 4, 16)))
        elif how == 3:
            made[at : at + 4] = (number(random) & 0xFFFFFFFF).to_bytes(4, "little")
        elif random.random() < 0.2:
            del made[at:]
    return bytes(made)


# ------------------------------------------------------------------ protobuf

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
#: Bytes that are longer are weights, not messages.
_LEAF = 1 << 14


@dataclass(slots=True)
class Field:
    """One field as it stands in the wire format; ``value`` is a list of fields where it may be a message."""

    number: int
    wire: int
    value: Any


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data) and shift < 70:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError


def _put(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def tree(data: bytes) -> list[Field]:
    """The fields of a message, and of what in it can be messages. Raises ValueError where it is none."""
    found = []
    at = 0
    while at < len(data):
        tag, at = _varint(data, at)
        number_, wire = tag >> 3, tag & 7
        value: Any
        if not 0 < number_ < 1 << 12:
            raise ValueError
        if wire == _VARINT:
            value, at = _varint(data, at)
        elif wire in (_FIXED32, _FIXED64):
            size = 4 if wire == _FIXED32 else 8
            value, at = data[at : at + size], at + size
        elif wire == _BYTES:
            size, at = _varint(data, at)
            value, at = data[at : at + size], at + size
            if len(value) != size:
                raise ValueError
            value = _inner(value)
        else:
            raise ValueError
        if at > len(data):
            raise ValueError
        found.append(Field(number_, wire, value))
    return found


def _inner(value: bytes) -> Any:
    if not value or len(value) > _LEAF or all(32 <= c < 127 for c in value):
        return value
    try:
        return tree(value)
    except ValueError:
        return value


def wire(fields: list[Field]) -> bytes:
    """The bytes of a tree."""
    out = bytearray()
    for field in fields:
        out += _put(field.number << 3 | field.wire)
        if field.wire == _VARINT:
            out += _put(field.value)
        elif field.wire == _BYTES:
            value = wire(field.value) if isinstance(field.value, list) else field.value
            out += _put(len(value)) + value
        else:
            out += field.value
    return bytes(out)


def _all(fields: list[Field]) -> Iterator[tuple[list[Field], int]]:
    for index, field in enumerate(fields):
        yield fields, index
        if isinstance(field.value, list):
            yield from _all(field.value)


def protobuf(data: bytes, random: Random, whole: Callable[[bytes], object] | None = None) -> bytes:
    """A message with a few of its fields changed, wherever they are; mostly one that ``whole`` decodes."""
    if random.random() < 0.04:
        return damaged(data, random)
    for _ in range(8):
        try:
            fields = tree(data)
        except ValueError:  # what was damaged before
            return damaged(data, random)
        for _ in range(random.choice((1, 1, 1, 2, 2, 3, 6))):
            places = list(_all(fields))
            if places:
                _change(places, random)
        made = wire(fields)
        if whole is None or random.random() < 0.05:
            break
        with contextlib.suppress(DecodeError):
            whole(made)
            break
    return made


def _change(places: list[tuple[list[Field], int]], random: Random) -> None:
    parent, index = random.choice(places)
    field = parent[index]
    other = (lambda p: p[0][p[1]])(random.choice(places))
    how = random.random()
    if how < 0.1:
        del parent[index]
    elif how < 0.16:
        parent.insert(random.randrange(len(parent) + 1), copy.deepcopy(field))
    elif how < 0.22:
        parent.insert(random.randrange(len(parent) + 1), copy.deepcopy(other))
    elif how < 0.30:
        parent[index] = Field(field.number, other.wire, copy.deepcopy(other.value))
    elif how < 0.34:
        position = random.randrange(len(parent))
        parent[index], parent[position] = parent[position], parent[index]
    elif how < 0.40:
        field.number = max(1, field.number + random.choice((-2, -1, 1, 2)))
    elif how < 0.42:
        value = wire([field])
        for _ in range(random.choice((3, 90, 110, 3000))):
            value = _put(field.number << 3 | _BYTES) + _put(len(value)) + value
        field.value, field.wire = value, _BYTES
    elif how < 0.44:
        parent[index:index] = [copy.deepcopy(field) for _ in range(random.choice((3, 40, 400)))]
    elif field.wire == _VARINT:
        field.value = number(random, field.value)
    elif field.wire == _BYTES and how < 0.95:
        known = [p[i].value for p, i in places if isinstance(p[i].value, bytes) and len(p[i].value) < 100]
        field.value = text(random, known)
    elif isinstance(field.value, bytes):
        field.value = damaged(field.value, random)
        if field.wire != _BYTES:
            field.value = field.value.ljust(8, b"\xff")[: 4 if field.wire == _FIXED32 else 8]


# ------------------------------------------------------------------ JSON

_JSON = (
    *(None, True, False, "", "x", "\0", "a\nb", "\x1b[2J", "\ud800", "../../x", "/etc/passwd", "</script>", "${x}"),
    *([], {}, [[]], [None], {"": 0}, 0.5, 1e308, math.inf, math.nan, -0.0, "1" * 5000, 1 << 70, -(1 << 70)),
)


def _paths(content: Any) -> Iterator[tuple[Any, Any]]:
    keys = list(content) if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ()
    for key in keys:
        yield content, key
        yield from _paths(content[key])


def json_tree(content: Any, random: Random) -> Any:
    """A document with a few of its places changed."""
    content = copy.deepcopy(content)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        places = list(_paths(content))
        if not places:
            return random.choice(_JSON)
        container, key = random.choice(places)
        other, where = random.choice(places)
        how = random.random()
        if how < 0.12:
            del container[key]
        elif how < 0.35:
            container[key] = copy.deepcopy(other[where])
        elif how < 0.45 and isinstance(container, list) and len(str(container)) < 5000:
            container.extend([copy.deepcopy(container[key])] * random.choice((1, 3, 1000)))
        elif how < 0.55 and isinstance(container, dict):
            container[text(random, []).decode("utf-8", "surrogateescape")] = container.pop(key)
        elif how < 0.60:
            value = container[key]
            for _ in range(random.choice((3, 90, 500))):
                value = [value]
            container[key] = value
        elif isinstance(container[key], int) and how < 0.85:
            container[key] = number(random, container[key])
        elif isinstance(container[key], str) and how < 0.85:
            container[key] = text(random, []).decode("utf-8", "surrogateescape")
        else:
            container[key] = copy.deepcopy(random.choice(_JSON))
    return content


# ------------------------------------------------------------------ files cut into parts

#: How a part is changed.
Change = Callable[[bytes, Random], bytes]


def parts(cut: list[bytes], random: Random, change: Change) -> bytes:
    """A file of parts with a few of them changed, left out, repeated, in other places."""
    made = list(cut)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        if not made:
            break
        index, other = random.randrange(len(made)), random.randrange(len(made))
        how = random.random()
        if how < 0.1:
            del made[index]
        elif how < 0.2:
            made.insert(other, made[index])
        elif how < 0.25:
            made[index], made[other] = made[other], made[index]
        elif how < 0.27:
            made[index:index] = [made[index]] * random.choice((10, 1000))
        elif how < 0.4:
            made[index] = made[other]
        else:
            made[index] = change(made[index], random)
    return b"".join(made)
