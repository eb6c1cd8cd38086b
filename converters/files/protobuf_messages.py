"""Message classes from a table of fields, in a descriptor pool of their own.

No generated code has to match the installed protobuf, and a real ``tensorflow`` or ``onnx`` in the same process does
not clash. The descriptor is written as bytes (descriptor.proto has its numbers): neither what protobuf imports to
describe messages in Python nor the package ``onnx`` is needed to write a file.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from google.protobuf import descriptor_pool, message_factory

from export_model.converters.files.wire_format import varint

_SCALARS = {
    "string": 9,
    "bytes": 12,
    "int32": 5,
    "int64": 3,
    "uint32": 13,
    "uint64": 4,
    "float": 2,
    "double": 1,
    "bool": 8,
    "fixed32": 7,
}
_MESSAGE_KIND, _OPTIONAL, _REPEATED = 11, 1, 3


def message_classes(
    package: str, messages: Mapping[str, str], oneofs: Mapping[str, str], syntax: str
) -> Mapping[str, Any]:
    """The class of each message.

    A message's fields are "number name kind", with commas between them, kind with ``*`` for repeated and ``<K`` for a
    map from string to K.

    ``oneofs`` names the one oneof that all fields of a message are members of: their presence is visible even at the
    default value, as it is of every field in ``proto2``.
    """
    file = _text(1, f"{package}.proto") + _text(2, package) + _text(12, syntax)
    for name, fields in messages.items():
        file += _bytes(4, _message(package, name, fields, oneofs.get(name)))
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{package}.{name}")) for name in messages}


def _message(package: str, name: str, fields: str, oneof: str | None) -> bytes:
    described = _text(1, name)
    for text in fields.split(", "):
        number, field_name, kind = text.split()
        label = _REPEATED if kind[0] == "<" or kind[-1] == "*" else _OPTIONAL
        kind = kind.rstrip("*")
        if kind[0] == "<":
            entry = "".join(part.capitalize() for part in field_name.split("_")) + "Entry"
            pair = _field(package, 1, "key", "string", _OPTIONAL) + _field(package, 2, "value", kind[1:], _OPTIONAL)
            described += _bytes(3, _text(1, entry) + pair + _bytes(7, _number(7, 1)))  # MessageOptions.map_entry
            kind = f"{name}.{entry}"
        described += _field(package, int(number), field_name, kind, label, oneof is not None)
    return described if oneof is None else described + _bytes(8, _text(1, oneof))


def _field(package: str, number: int, name: str, kind: str, label: int, in_oneof: bool = False) -> bytes:
    described = _text(1, name) + _number(3, number) + _number(4, label) + _number(5, _SCALARS.get(kind, _MESSAGE_KIND))
    if kind not in _SCALARS:
        described += _text(6, f".{package}.{kind}")
    return _bytes(2, described + _number(9, 0) if in_oneof else described)


def _number(field: int, value: int) -> bytes:
    return varint(field << 3) + varint(value)


def _text(field: int, value: str) -> bytes:
    return _bytes(field, value.encode())


def _bytes(field: int, value: bytes) -> bytes:
    return varint(field << 3 | 2) + varint(len(value)) + value
