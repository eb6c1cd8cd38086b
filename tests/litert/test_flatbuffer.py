"""The tables of a .tflite against LiteRT's own schema (``ai_edge_litert.schema_py_generated``), and damaged ones."""

from __future__ import annotations

import json
import struct
from random import Random
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.litert import schema
from export_model.converters.formats.litert.flatbuffer import decode, encode
from export_model.converters.formats.registry import WRITTEN
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import DamagedFileError
from fixtures import FIXTURES, path
from tests.handmade import continuous_policy, graph_bytes

generated = pytest.importorskip("ai_edge_litert.schema_py_generated", reason="pip install 'export-model[litert]'")


def written(name: str) -> bytes:
    """A fixture's file."""
    policy = read_source(path(name)).policies()[0]
    (pieces,) = WRITTEN["litert"].artifact(policy, WriteOptions(json.dumps({"name": name}))).files.values()
    return pieces.to_bytes()


def theirs(name: str) -> str:
    """A field as the generated classes call it."""
    first, *rest = {"activation": "fused_activation_function"}.get(name, name).split("_")
    return first + "".join(part.capitalize() for part in rest)


def same(ours: Any, other: Any, table: str) -> None:
    """What was read by our rows is what LiteRT's own classes read, field for field."""
    for field in schema.TABLES[table]:
        found = getattr(other, theirs(field.name))
        if field.kind == "union":
            if field.name in ours:
                name = next(k for k, n in schema.OPTIONS.items() if n == ours["builtin_options_type"])
                assert type(found).__name__ == f"{name}T"
                same(ours[field.name], found, name)
        elif field.name not in ours:
            assert found is None or found == field.default or len(found) == 0
        elif field.kind == "str":
            assert found.decode() == ours[field.name]
        elif field.kind == "data":
            assert bytes(found) == bytes(ours[field.name])
        elif field.kind in ("[i32]", "[f32]", "[i64]", "[u8]"):
            assert list(found) == list(ours[field.name])
        elif field.kind.startswith("["):
            assert len(found) == len(ours[field.name])
            for a, b in zip(ours[field.name], found, strict=True):
                same(a, b, field.kind[1:-1])
        elif isinstance(ours[field.name], dict):
            same(ours[field.name], found, field.kind)
        else:
            assert found == ours[field.name]


@pytest.mark.parametrize("name", FIXTURES)
def test_litert_reads_the_tables_that_were_written(name: str) -> None:
    data = written(name)
    assert data[4:8] == b"TFL3"
    model = decode(data)
    same(model, generated.ModelT.InitFromPackedBuf(data, 0), "Model")
    assert written(name) == data
    assert encode(model).to_bytes() == data


def test_weights_begin_where_vector_instructions_ask_for() -> None:
    """At multiples of 16, whatever stands before them (schema.fbs: force_align)."""
    for name in FIXTURES:
        data = written(name)
        start = np.frombuffer(data, np.uint8).ctypes.data
        places = [b["data"].ctypes.data - start for b in decode(data)["buffers"][1:]]
        assert places
        assert [at % 16 for at in places] == [0] * len(places)


def test_numbers_of_the_schema_are_litert_s() -> None:
    for name, builtin in schema.BUILTINS.items():
        assert getattr(generated.BuiltinOperator, name) == builtin.code
        assert builtin.options in schema.OPTIONS or not builtin.options
    for name, number in schema.OPTIONS.items():
        assert getattr(generated.BuiltinOptions, name) == number
    for dtype, (number, _) in schema.TYPES.items():
        assert getattr(generated.TensorType, dtype.name.upper()) == number
    for name, number in schema.ACTIVATIONS.items():
        assert getattr(generated.ActivationFunctionType, name or "NONE") == number
    for name, number in schema.PADDINGS.items():
        assert getattr(generated.Padding, name) == number


@pytest.mark.parametrize(
    ("dtype", "axes", "operator", "version"),
    [
        ("f", 2, "ADD", 1),
        ("l", 2, "ADD", 4),
        ("f", 5, "SUB", 3),
        ("l", 5, "SUB", 4),
        ("l", 2, "MUL", 5),
        ("f", 5, "DIV", 2),
        ("l", 2, "DIV", None),
        ("f", 5, "LESS", None),
        ("b", 2, "GATHER", 3),
        ("b", 2, "FILL", 2),
        ("f", 5, "TRANSPOSE", 4),
        ("i", 2, "ABS", 5),
    ],
)
def test_versions_are_the_lowest_that_do(dtype: str, axes: int, operator: str, version: int | None) -> None:
    """As TensorFlow 2.21's converter wrote the same operators (None: it refused them)."""
    assert schema.BUILTINS[operator].version(dtype, axes) == version


def test_large_numbers_and_all_kinds_of_fields_come_back() -> None:
    buffers = [{}, {"data": np.arange(6, dtype=np.float32).reshape(2, 3).T}, {"size": 2**40, "offset": 7}]
    quantised = {"scale": [0.5, 0.25], "zero_point": [-(2**40), 3], "quantized_dimension": 1}
    tensor = {"name": "größe", "shape": [3, 2], "buffer": 1, "quantization": quantised, "is_variable": 1}
    model = {"version": 3, "buffers": buffers, "subgraphs": [{"tensors": [tensor, tensor]}]}
    data = encode(model).to_bytes()
    found = decode(data)
    same(found, generated.ModelT.InitFromPackedBuf(data, 0), "Model")
    assert found["buffers"][2] == {"size": 2**40, "offset": 7}
    assert np.frombuffer(found["buffers"][1]["data"], np.float32).tolist() == [0, 3, 1, 4, 2, 5]


# ------------------------------------------------------------------ damaged


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    source = tmp_path_factory.mktemp("small") / "tiny.bytes"
    source.write_bytes(graph_bytes(continuous_policy()))
    (policy,) = read_source(source).policies()
    (pieces,) = WRITTEN["litert"].artifact(policy, WriteOptions("{}")).files.values()
    return pieces.to_bytes()


def test_every_beginning_of_a_file_is_refused_or_read(small: bytes) -> None:
    for length in range(len(small)):
        with pytest.raises(DamagedFileError, match=r"the \.tflite file is damaged"):
            decode(small[:length])
            raise DamagedFileError("the .tflite file is damaged", why="only its last bytes, of weights, are gone")


def test_changed_bytes_raise_nothing_but_that_it_is_damaged(small: bytes) -> None:
    random = Random(22)
    refused = 0
    for _ in range(4000):
        data = bytearray(small)
        for _ in range(random.randint(1, 4)):
            at = random.randrange(len(data) // 4) * 4
            value = random.choice((0, 1, 4, 8, random.getrandbits(31), 2**32 - 1, 2**31, len(data), len(data) - at))
            data[at : at + 4] = value.to_bytes(4, "little")
        try:
            decode(bytes(data))
        except DamagedFileError:
            refused += 1
    assert refused > 400


def number(data: bytes | bytearray, code: str, at: int) -> int:
    return int(struct.unpack_from(f"<{code}", data, at)[0])


def entries(data: bytes | bytearray, table: int, slot: int) -> list[int]:
    """Where the tables of a vector stand that a field leads to; the first entry is where the field itself stands."""
    vtable = table - number(data, "i", table)
    at = table + number(data, "H", vtable + 4 + 2 * slot)
    vector = at + number(data, "I", at)
    places = range(vector + 4, vector + 4 + 4 * number(data, "I", vector), 4)
    return [at, *(place + number(data, "I", place) for place in places)]


def test_what_many_lead_to_is_not_read_for_each_of_them() -> None:
    """Five hundred functions whose operators are one vector of five thousand: a few kilobytes, 2.5 million to read."""
    many = [{"name": str(i), "operators": [{"opcode_index": i + 1}]} for i in range(500)]
    last = {"operators": [{"opcode_index": 7}] * 5000}
    data = bytearray(encode({"version": 3, "subgraphs": [*many, last]}).to_bytes())
    _, *subgraphs = entries(data, number(data, "I", 0), 2)
    shared = entries(data, subgraphs[-1], 3)[0]
    vector = shared + number(data, "I", shared)
    for subgraph in subgraphs[:-1]:
        at = entries(data, subgraph, 3)[0]
        struct.pack_into("<I", data, at, vector - at)
    with pytest.raises(DamagedFileError, match="more often than a file of its length can"):
        decode(bytes(data))


def test_equal_operators_stand_once_in_a_file() -> None:
    model = {"version": 3, "subgraphs": [{"operators": [{"opcode_index": 7}] * 9}] * 9}
    data = encode(model).to_bytes()
    assert decode(data)["subgraphs"][8]["operators"][8] == {"opcode_index": 7}
    assert len(data) < 9 * 9 * 4 + 9 * 40 + 100
