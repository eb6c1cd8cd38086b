"""Graphs that were damaged at random: a policy comes out, or one clear error; soon, and in little memory.

Byte by byte (a bad disk), and field by field through the schema (a malicious or broken exporter).
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.recognise import REFUSED, UNKNOWN, recognise
from export_model.converters.formats.registry import FORMATS
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.inspect.inspection import inspect_source
from export_model.signatures.errors import BundleError, ExportModelError
from export_model.signatures.roles import Role
from fixtures import FIXTURES
from fixtures import path as fixture
from tests.commands import files_in
from tests.handmade import continuous_policy, graph_bytes, sampled_policy

#: Traced for coverage, thousands of examples take three times as long and run what every other test runs.
pytestmark = [pytest.mark.slow, pytest.mark.no_cover]

#: Seconds of this process that one graph may take.
SECONDS = 2.0
#: How much the process may grow over a whole test.
MEMORY = 512 << 20
DATA = {name: fixture(name).read_bytes() for name in FIXTURES}


def examples(count: int) -> settings:
    """The same examples in every run; how long one takes is judged by ``SECONDS``."""
    return settings(
        max_examples=count, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )


OPS = [
    *(
        "Add",
        "AddN",
        "ArgMax",
        "BiasAdd",
        "BroadcastTo",
        "Cast",
        "Concat",
        "ConcatV2",
        "Const",
        "Conv2D",
        "ClipByValue",
    ),
    *("DivNoNan", "Enter", "Exit", "ExpandDims", "Fill", "FusedBatchNorm", "GatherV2", "Identity", "LeakyRelu"),
    *("LoopCond", "MatMul", "MaxPool", "Merge", "Mul", "Multinomial", "NextIteration", "OneHot", "Pack", "Pad"),
    *(
        "Placeholder",
        "PlaceholderWithDefault",
        "Prod",
        "RandomStandardNormal",
        "Range",
        "ReadFile",
        "Reshape",
        "Select",
    ),
    *("SelectV2", "Shape", "Slice", "Softmax", "Split", "SplitV", "Squeeze", "StridedSlice", "Sum", "Switch"),
    *("TensorArrayReadV3", "TensorArrayV3", "TensorArrayWriteV3", "Tile", "Transpose", "Unpack", "ZerosLike", "Xyz"),
]
SIZES = st.sampled_from([-2, -1, 0, 1, 2, 3, 7, 2**20, 2**31, 2**40, 2**62])
DTYPES = st.sampled_from([0, 1, 2, 3, 4, 7, 9, 10, 14, 19, 20, 21, 22, 23, 101, 9999])
NUMBERS = st.sampled_from([b"\xff\xff\xff\xff", b"\0\0\x80\x7f", b"\xff\xff\x7f\x7f", b"\0\0\0\0", b"\1\0\0\x80"])


class Damaged(bytes):
    """A file's content that is not printed where a test fails; the examples are the same in every run."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes>"


def peak() -> int:
    """The most memory that this process has had, in bytes (0 where that is not known)."""
    if sys.platform == "win32":
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


@pytest.fixture(autouse=True)
def _little_memory() -> Iterator[None]:
    before = peak()
    yield
    assert peak() - before < MEMORY


def stands(data: bytes) -> bool:
    """Export ``data``; whether policies came out. Asserts what holds if none did."""
    with tempfile.TemporaryDirectory() as top:
        source, out = Path(top) / "damaged.bytes", Path(top) / "out"
        source.write_bytes(data)
        begin = time.process_time()
        try:
            done = list(export([source], ExportOptions(out, verify="none")))
        except ExportModelError as error:
            assert error.exit_status == 2
            assert error.message.startswith(f"{source}: ")
            assert error.why or error.fix
            assert files_in(out) == set()
            done = []
        assert time.process_time() - begin < SECONDS
        for result in done:
            Bundle.open(result.folder).verify_hashes()
        return bool(done)


@st.composite
def with_damaged_bytes(draw: st.DrawFn) -> bytes:
    data = bytearray(DATA[draw(st.sampled_from(FIXTURES))])
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data) - 1))
        how = draw(st.sampled_from(["flip", "delete", "insert", "cut"]))
        if how == "flip":
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif how == "delete":
            del data[at : at + draw(st.integers(1, 16))]
        elif how == "insert":
            data[at:at] = draw(st.binary(min_size=1, max_size=16))
        else:
            del data[max(at, 1) :]
        if not data:
            data = bytearray(b"\n")
    return Damaged(data)


@examples(200)
@given(with_damaged_bytes())
def test_damaged_bytes_give_a_policy_or_an_error(data: bytes) -> None:
    stands(data)


# ------------------------------------------------------------------ fields


def _any_tensor(draw: st.DrawFn, graph: Any) -> Any:
    constants = [n for n in graph.node if n.op == "Const"]
    return draw(st.sampled_from(constants)).attr["value"].tensor if constants else schema.TensorProto()


def _reference(draw: st.DrawFn, graph: Any) -> str:
    suffix = draw(st.sampled_from(["", "", "", ":0", ":1", ":5", ":²", ":999999999999"]))
    prefix = draw(st.sampled_from(["", "", "", "^", ":"]))
    return f"{prefix}{draw(st.sampled_from(list(graph.node))).name}{suffix}"


def _remove_input(draw: st.DrawFn, graph: Any, node: Any) -> None:
    if node.input:
        del node.input[draw(st.integers(0, len(node.input) - 1))]


def _add_input(draw: st.DrawFn, graph: Any, node: Any) -> None:
    node.input.insert(draw(st.integers(0, len(node.input))), _reference(draw, graph))


def _replace_input(draw: st.DrawFn, graph: Any, node: Any) -> None:
    if node.input:
        node.input[draw(st.integers(0, len(node.input) - 1))] = _reference(draw, graph)


def _swap_inputs(draw: st.DrawFn, graph: Any, node: Any) -> None:
    node.input[:] = list(node.input)[::-1]


def _change_op(draw: st.DrawFn, graph: Any, node: Any) -> None:
    node.op = draw(st.sampled_from(OPS))


def _change_name(draw: st.DrawFn, graph: Any, node: Any) -> None:
    node.name = draw(st.sampled_from([n.name for n in graph.node]) | st.text(max_size=3))


def _remove_attribute(draw: st.DrawFn, graph: Any, node: Any) -> None:
    if node.attr:
        del node.attr[draw(st.sampled_from(sorted(node.attr)))]


def _change_attribute(draw: st.DrawFn, graph: Any, node: Any) -> None:
    names = [*sorted(node.attr), "shape", "dtype", "T", "axis", "strides", "seed"]
    attribute = node.attr[draw(st.sampled_from(names))]
    kind = draw(st.sampled_from(["i", "s", "type", "b", "f", "shape", "list", "tensor", "func"]))
    if kind == "i":
        attribute.i = draw(SIZES)
    elif kind == "s":
        attribute.s = draw(st.sampled_from([b"", b"SAME", b"VALID", b"EXPLICIT", b"NCHW", b"\xff"]))
    elif kind == "type":
        attribute.type = draw(DTYPES)
    elif kind == "b":
        attribute.b = draw(st.booleans())
    elif kind == "f":
        attribute.f = draw(st.sampled_from([0.0, float("nan"), 1e30]))
    elif kind == "shape":
        attribute.shape.dim.add(size=draw(SIZES))
    elif kind == "list":
        attribute.list.i.extend(draw(st.lists(SIZES, max_size=5)))
    elif kind == "tensor":
        attribute.tensor.dtype = draw(DTYPES)
        attribute.tensor.tensor_shape.dim.add(size=draw(SIZES))
    else:
        attribute.func.name = "f"


def _change_tensor(draw: st.DrawFn, graph: Any, node: Any) -> None:
    tensor = _any_tensor(draw, graph)
    kind = draw(st.sampled_from(["size", "axis", "dtype", "short", "values", "rank", "strings"]))
    if kind == "size" and tensor.tensor_shape.dim:
        tensor.tensor_shape.dim[0].size = draw(SIZES)
    elif kind == "axis":
        tensor.tensor_shape.dim.add(size=draw(SIZES))
    elif kind == "dtype":
        tensor.dtype = draw(DTYPES)
    elif kind == "short":
        tensor.tensor_content = tensor.tensor_content[:-1]
    elif kind == "rank":
        tensor.tensor_shape.unknown_rank = True
    elif kind == "strings":
        tensor.dtype = 7
        tensor.string_val.extend([b"x" * 1000, b""])
    elif tensor.tensor_content:
        at = draw(st.integers(0, len(tensor.tensor_content) // 4 - 1)) * 4
        content = tensor.tensor_content
        tensor.tensor_content = content[:at] + draw(NUMBERS) + content[at + 4 :]
    else:
        tensor.int_val.append(draw(st.sampled_from([-5, 0, 3, 2**31 - 1])))


def _remove_node(draw: st.DrawFn, graph: Any, node: Any) -> None:
    graph.node.remove(node)


def _copy_node(draw: st.DrawFn, graph: Any, node: Any) -> None:
    copy = graph.node.add()
    copy.CopyFrom(node)
    copy.name += draw(st.sampled_from(["", "_1", "/action", ":0"]))


CHANGES = [
    *(_remove_input, _add_input, _replace_input, _swap_inputs, _change_op, _change_name, _remove_attribute),
    *(_change_attribute, _change_tensor, _remove_node, _copy_node),
]


@st.composite
def with_damaged_fields(draw: st.DrawFn) -> bytes:
    graph = schema.GraphDef.FromString(DATA[draw(st.sampled_from(FIXTURES))])
    for _ in range(draw(st.integers(1, 3))):
        draw(st.sampled_from(CHANGES))(draw, graph, draw(st.sampled_from(list(graph.node))))
    return Damaged(schema.serialise(graph))


@examples(250)
@given(with_damaged_fields())
def test_damaged_fields_give_a_policy_or_an_error(data: bytes) -> None:
    stands(data)


def test_damage_is_not_all_fatal_nor_all_harmless() -> None:
    """What the tests above try would say little if every graph were refused at the door."""
    outcomes = []

    @examples(40)
    @given(with_damaged_fields())
    def collect(data: bytes) -> None:
        outcomes.append(stands(data))

    collect()
    assert {True, False} == set(outcomes)


# ------------------------------------------------------------------ options


@st.composite
def with_strange_options(draw: st.DrawFn) -> tuple[bytes, CompileOptions]:
    graph = draw(st.sampled_from([graph_bytes(continuous_policy()), graph_bytes(sampled_policy()), *DATA.values()]))
    nodes = schema.GraphDef.FromString(graph).node
    any_node = st.sampled_from([n.name for n in nodes])
    inputs = st.sampled_from([n.name for n in nodes if n.op == "Placeholder"])
    floats = st.sampled_from([n.name for n in nodes if n.op == "Placeholder" and n.attr["dtype"].type == 1])
    roles = st.sampled_from(list(Role))
    options = CompileOptions(
        names=draw(st.sampled_from(["canonical", "source"])),
        noise=draw(st.sampled_from(["lift", "keep", "zero"])),
        deterministic=draw(st.booleans()),
        inputs=draw(st.dictionaries(inputs, roles, max_size=2)),
        outputs=draw(st.dictionaries(any_node, roles, max_size=2)),
        values=draw(st.dictionaries(floats, st.sampled_from([0.0, 1.0, -3.0, 1e30]), max_size=1)),
    )
    return Damaged(graph), options


@examples(200)
@given(with_strange_options())
def test_any_roles_give_a_policy_or_an_error(given_: tuple[bytes, CompileOptions]) -> None:
    data, options = given_
    with tempfile.TemporaryDirectory() as top:
        source = Path(top) / "a.bytes"
        source.write_bytes(data)
        begin = time.process_time()
        try:
            found = inspect_source(source, options)
        except ExportModelError as error:
            assert error.message.startswith(f"{source}: ")
        else:
            assert all(len(p.policy.signature.outputs) for p in found.policies)
        assert time.process_time() - begin < SECONDS


# ------------------------------------------------------------------ recognition


KINDS = (*FORMATS, *REFUSED, UNKNOWN)
STARTS = [
    *(b"", b"PK\x03\x04", b"\x1f\x8b", b"\x89HDF", b"UnityFS", b"\x80\x04", b"{", b"<!doctype", b"node {", b"\x08\x01"),
    *(
        b"\x08\x08",
        b"\x0a\x04",
        b"\x10\0\0\0\0\0\0\0",
        b"version https://git-lfs",
        b"%YAML 1.1\n%TAG !u!",
        b"\xef\xbb\xbf",
    ),
]


@examples(500)
@given(
    st.sampled_from(STARTS), st.binary(max_size=200), st.sampled_from(["a.bytes", "a.sentis", "m.data-00000-of-1", ""])
)
def test_anything_is_recognised_as_something(start: bytes, rest: bytes, name: str) -> None:
    assert recognise(start + rest, name) in KINDS


@st.composite
def damaged_archives(draw: st.DrawFn) -> bytes:
    stream = BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in draw(st.lists(st.text(min_size=1, max_size=5), max_size=3, unique=True)):
            archive.writestr(name, b"content")
    data = bytearray(stream.getvalue())
    for _ in range(draw(st.integers(1, 4))):
        data[draw(st.integers(4, len(data) - 1)) if len(data) > 4 else 0] = draw(st.integers(0, 255))
    return bytes(data)


@examples(300)
@given(damaged_archives())
def test_a_damaged_archive_is_recognised_as_something(data: bytes) -> None:
    assert recognise(data) in KINDS


# ------------------------------------------------------------------ contracts


@pytest.fixture(scope="module")
def policy_json(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bundles")
    (result,) = export([fixture("recurrent")], ExportOptions(folder, verify="none"))
    return result.folder


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)


def _paths(content: Any) -> Iterator[tuple[Any, Any]]:
    """Every place in a JSON document: the container and the key."""
    keys = content if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ()
    for key in keys:
        yield content, key
        yield from _paths(content[key])


@examples(300)
@given(st.data())
def test_a_contract_with_anything_in_any_place_is_refused_or_the_same(policy_json: Path, data: st.DataObject) -> None:
    original = json.loads((policy_json / "policy.json").read_text())
    content = json.loads((policy_json / "policy.json").read_text())
    places = list(_paths(content))
    container, key = places[data.draw(st.integers(0, len(places) - 1))]
    container[key] = data.draw(ANYTHING)
    try:
        (policy_json / "policy.json").write_text(json.dumps(content))
        read = Bundle.open(policy_json)
        read.verify_hashes()
        read.graph()
    except BundleError as error:
        assert str(policy_json) in error.message
        return
    finally:
        (policy_json / "policy.json").write_text(json.dumps(original))
    assert {k: v for k, v in content.items() if k != "files"} == {k: v for k, v in original.items() if k != "files"}
