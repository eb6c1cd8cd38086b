"""Files of a few megabytes that would be gigabytes of empty messages, short texts or numbers: counted, and refused."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet
from onnx import TensorProto

from export_model.converters.files import message_limits as counting
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.message_limits import MAX_FIELDS, fields_of
from export_model.converters.files.protobuf_messages import message_classes
from export_model.converters.formats.frozen_graph.tensors import to_array
from export_model.converters.formats.onnx.half_precision import widen
from export_model.converters.formats.onnx.messages import ModelProto
from export_model.converters.formats.onnx.proto import array_of, decode_model
from export_model.exporter.export.sources import read_source
from export_model.signatures.bounded import MAX_VALUES, loads
from export_model.signatures.contract import json_of
from export_model.signatures.errors import NotAPolicyError
from export_model.signatures.fields import FieldError
from tests.commands import export_model, is_refused
from tests.fuzz.seeds import _seeds
from tests.hostile.large import _chain
from tests.hostile.test_many_small_parts import attribute, inside, saved
from tests.hostile.zoo import onnx_policy

TOO_MANY = MAX_FIELDS + 1
#: Seconds of computing for a file that has just too many.
SECONDS = 20.0


def onnx(*graph: bytes) -> Callable[[], bytes]:
    return lambda: onnx_policy() + inside(7, *graph)


def in_tensor(number: int, content: bytes) -> Callable[[], bytes]:
    return onnx(inside(5, inside(number, content)))


#: file's name → content
FILES: dict[str, tuple[str, Callable[[], bytes]]] = {
    "ONNX, empty tensors": ("p.onnx", onnx(b"\x2a\0" * TOO_MANY)),
    "ONNX, empty nodes": ("p.onnx", onnx(b"\x0a\0" * TOO_MANY)),
    "ONNX, empty names of inputs": ("p.onnx", onnx(inside(1, b"\x0a\0" * TOO_MANY))),
    "ONNX, empty attributes": ("p.onnx", onnx(inside(1, b"\x2a\0" * TOO_MANY))),
    "ONNX, graphs in attributes": ("p.onnx", onnx(inside(1, inside(5, b"\x5a\0" * TOO_MANY)))),
    "ONNX, empty functions": ("p.onnx", lambda: onnx_policy() + b"\xca\x01\0" * TOO_MANY),
    "ONNX, numbers in a byte each": ("p.onnx", in_tensor(7, b"\1" * (8 * TOO_MANY))),
    "ONNX, numbers in a field each": ("p.onnx", onnx(inside(5, b"\x38\1" * TOO_MANY))),
    "ONNX, strings": ("p.onnx", onnx(inside(5, b"\x32\0" * TOO_MANY))),
    "frozen graph, empty tensors of a list": ("p.bytes", lambda: attribute(inside(1, b"\x42\0" * TOO_MANY))),
    "frozen graph, numbers in a byte each": ("p.bytes", lambda: attribute(inside(8, inside(10, b"\1" * 8 * TOO_MANY)))),
    "frozen graph, empty texts": ("p.bytes", lambda: attribute(inside(8, b"\x42\0" * TOO_MANY))),
    "SavedModel, empty tags": ("saved_model.pb", lambda: saved(inside(1, b"\x22\0" * TOO_MANY))),
    "SavedModel, axes of an output": (
        "saved_model.pb",
        lambda: saved(inside(5, inside(2, inside(2, inside(2, inside(3, b"\x12\0" * TOO_MANY)))))),
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_its_parts_are_counted_before_they_are_made(name: str, tmp_path: Path) -> None:
    called, content = FILES[name]
    (tmp_path / called).write_bytes(content())
    begun = time.process_time()
    with pytest.raises(NotAPolicyError, match=f"more than {MAX_FIELDS} parts"):
        read_source(tmp_path / called)
    assert time.process_time() - begun < SECONDS


@pytest.mark.parametrize("name", ["p.onnx", "p.bytes", "saved_model.pb"])
def test_a_command_says_so(name: str, tmp_path: Path) -> None:
    content = next(c for called, c in FILES.values() if called == name)
    (tmp_path / name).write_bytes(content())
    is_refused(export_model("inspect", tmp_path / name), name, "parts", "export the policy alone")


#: What protobuf passes over or reads, at least where it works in Python, and what could be taken for damage.
IN_FRONT = {
    "a group with what is no node": b"\xc3\x3e" + b"\x0a\x01\x07" + b"\xc4\x3e",
    "a group in a group": b"\xc3\x3e\x0b\x0a\x02\x0a\x05\x0c\xc4\x3e",
    "a length of 65 bits": b"\x0a" + b"\x80" * 9 + b"\x02",
}


@pytest.mark.parametrize("name", IN_FRONT)
def test_what_stands_in_front_does_not_hide_the_rest(name: str) -> None:
    table = counting._table(schema.GraphDef.DESCRIPTOR)
    found = fields_of(IN_FRONT[name] + b"\x0a\0" * 1000, table, 1 << 20)
    assert 1000 < found < 1010
    if "group" in name:
        assert len(schema.GraphDef.FromString(IN_FRONT[name] + b"\x0a\0" * 1000).node) == 1000


@pytest.mark.parametrize("damage", [b"\x0c", b"\x0b\x0f\x0c", b"\x0f", b"\x0a\x02\x0b\x0b"])
def test_the_count_ends_where_protobuf_refuses(damage: bytes) -> None:
    assert fields_of(damage + b"\x0a\0" * 1000, counting._table(schema.GraphDef.DESCRIPTOR), 1 << 20) < 5
    with pytest.raises(DecodeError):
        schema.GraphDef.FromString(damage + b"\x0a\0" * 1000)


#: A message that knows no field: what protobuf makes of each is what is in the file.
NOTHING = message_classes("nothing", {"Nothing": "536870911 none bool"}, {}, "proto3")["Nothing"]


def by_protobuf(data: bytes, table: counting.Table) -> int:
    """As ``fields_of``, by protobuf's own reading of fields that it does not know."""
    total = 0
    for field in UnknownFieldSet(NOTHING.FromString(data)):
        tag = field.field_number << 3 | field.wire_type
        inner = table.get(tag, 0)
        total += 1
        if inner is None:
            total += len(field.data) // 8
        elif inner != 0:
            total += by_protobuf(field.data, inner)  # type: ignore[arg-type]
    return total


@pytest.mark.parametrize(
    ("reader", "kind"), [("ONNX", ModelProto), ("frozen graph", schema.GraphDef), ("SavedModel", schema.SavedModel)]
)
def test_it_counts_what_protobuf_finds(reader: str, kind: Any) -> None:
    table = counting._table(kind.DESCRIPTOR)
    tried = 0
    for files in _seeds(reader):
        for name, data in files.items():
            if name.endswith((".onnx", ".bytes", ".pb")):
                tried += 1
                found = fields_of(data, table, 1 << 30)
                assert found == by_protobuf(data, table) > 20
                assert fields_of(data, table, found - 1) >= found  # more than so many
                for end in range(1, len(data), max(1, len(data) // 50)):
                    assert fields_of(data[:end], table, 1 << 30) <= found  # cut off
    assert tried > 2


def test_a_long_chain_is_counted_in_one_flat_loop() -> None:
    """300,000 nodes, which are refused for being so many once they are parsed: 1.2 s."""
    data = _chain(300_000).SerializeToString()
    begun = time.process_time()
    counting.check_size(schema.GraphDef, data)
    assert time.process_time() - begun < 6.0


def packed(bits: np.ndarray) -> bytes:
    """Numbers of 16 bits as varints of three bytes each."""
    wide = bits.astype(np.uint32)
    return np.stack([wide & 0x7F | 0x80, wide >> 7 & 0x7F | 0x80, wide >> 14], -1).astype(np.uint8).tobytes()


def test_weights_of_16_bits_that_are_kept_as_numbers_are_no_parts() -> None:
    """More of them than there may be fields of eight bytes each."""
    halves = np.linspace(-3, 3, 9 << 20, dtype=np.float32).astype(np.float16)
    numbers = packed(halves.view(np.uint16))
    assert len(numbers) > 8 * MAX_FIELDS
    kind = TensorProto(dims=[halves.size], data_type=TensorProto.FLOAT16).SerializeToString()
    model = decode_model(onnx_policy() + inside(7, inside(5, kind, inside(5, numbers))))
    widen(model)
    assert (array_of(model.graph.initializer[-1], None) == halves.astype(np.float32)).all()
    like = schema.TensorProto(dtype=19)
    like.tensor_shape.dim.add(size=halves.size)
    graph = attribute(inside(8, like.SerializeToString(), inside(13, numbers)))
    counting.check_size(schema.GraphDef, graph)
    (tensor,) = (a.tensor for n in schema.GraphDef.FromString(graph).node for a in n.attr.values() if a.tensor.half_val)
    assert (to_array(tensor) == halves).all()


@pytest.mark.parametrize("field", [1, 5, 7, 11])
@pytest.mark.parametrize("number", [b"\x01", b"\x01\x81\x01", b"\x80\x80\x01"])
def test_numbers_are_parts_that_are_small_or_no_weights(field: int, number: bytes) -> None:
    """Of axes an object is made each, and others have eight bytes."""
    data = onnx_policy() + inside(7, inside(5, inside(field, number * (8 * TOO_MANY // len(number) + 1))))
    if field == 5 and number[0] == 0x80:
        counting.check_size(ModelProto, data)
        return
    with pytest.raises(NotAPolicyError, match="parts"):
        counting.check_size(ModelProto, data)


@pytest.mark.parametrize("text", ["[" + "[]," * MAX_VALUES + "1]", '{"a":[' + "1," * MAX_VALUES + "1]}"])
def test_values_of_json_are_counted_before_they_are_made(text: str) -> None:
    with pytest.raises(ValueError, match=f"more than {MAX_VALUES} values"):
        loads(text)
    with pytest.raises(FieldError, match="more than"):
        json_of(text.encode())


def test_a_contract_of_nested_lists_is_refused(tmp_path: Path) -> None:
    (tmp_path / "policy.json").write_bytes(b"[" + b"[]," * (20 << 20) + b"[]]")
    begun = time.process_time()
    is_refused(export_model("inspect", tmp_path), "policy.json", "values")
    assert time.process_time() - begun < SECONDS
