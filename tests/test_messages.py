"""Messages are the same in protobuf's C library, asked directly, and in its implementation in Python."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.commands import ROOT, python

SCRIPT = """
import sys
from google.protobuf.internal import api_implementation
from export_model.converters.files.protobuf_messages import message_classes

classes = message_classes(
    "tried",
    {
        "Part": "1 x int32*, 2 s string",
        "Whole": "1 part Part*, 2 by_name <Part, 3 raw bytes, 4 one Part",
        "Either": "1 a int32, 2 b string",
    },
    {"Either": "value"},
    "proto3",
)
whole = classes["Whole"](raw=b"abc")
whole.part.add(x=[1, -2], s="é")
whole.by_name["b"].s = "1"
whole.by_name["a"].x.append(3)
either = classes["Either"](a=0)
data = whole.SerializeToString(deterministic=True)
again = classes["Whole"].FromString(data)
assert again == whole and dict(again.by_name) == dict(whole.by_name) and not again.HasField("one")
again.one.CopyFrom(whole.by_name["a"])
assert again.one.x == [3] and "raw" in str(again)
print(api_implementation.Type(), data.hex(), either.WhichOneof("value"), either.SerializeToString().hex())
"""


def said(implementation: str, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    monkeypatch.setenv("PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION", implementation)
    ran = python("-c", SCRIPT)
    assert ran.status == 0, ran.err
    return ran.out.split()


def test_both_implementations_of_protobuf_write_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    (quick, *in_c), (slow, *in_python) = said("upb", monkeypatch), said("python", monkeypatch)
    assert (quick, slow) == ("upb", "python")
    assert in_c == in_python


@pytest.mark.parametrize("implementation", ["upb", "python"])
def test_a_policy_is_read_and_written_in_either(
    implementation: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION", implementation)
    first = python("-m", "export_model", ROOT / "fixtures" / "continuous.bytes", "-o", tmp_path, "--verify", "none")
    assert first.status == 0, first.err
    for name in ("continuous.onnx", "saved_model"):
        out = tmp_path / "again" / Path(name).stem
        again = python("-m", "export_model", tmp_path / "continuous" / name, "-o", out, "--verify", "none")
        assert again.status == 0, again.err
