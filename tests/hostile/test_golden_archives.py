"""Recordings that say to be larger than they are, or hold programs: refused before anything of that size is made."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import pytest

from export_model.exporter.verify.golden import read_golden
from export_model.signatures.errors import UsageError
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec

SIGNATURE = PolicySignature(
    family="", action_space="continuous",
    inputs=(TensorSpec("state", Role.VECTOR, "float32", (None, 3)),),
    outputs=(TensorSpec("action", Role.CONTINUOUS, "float32", (None, 2)),),
)  # fmt: skip


def header(shape: tuple[int, ...], descr: str = "<f4") -> bytes:
    text = str({"descr": descr, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


ENTRIES = {
    "zeros that unpack to a thousand times": header((1 << 23, 3)) + bytes(3 << 25),
    "a header of four EiB": header((1 << 60,)),
    "a header of numbers that overflow": header((1 << 62, 1 << 62)),
    "a pickle": header((1,), "|O") + b"cos\nsystem\n(S'touch marker'\ntR.",
    "a header that does not end": header((1,)).replace(b"}", b"("),
    "a header that Python warns of": header((1, 3)).replace(b"(1", b"1if") + bytes(12),
    "a header of calls": header((1, 3)).replace(b"(1, 3)", b"x(1,3)") + bytes(12),
    "a header of brackets": b"\x93NUMPY\x02\0" + struct.pack("<I", 9_000) + b"(" * 9_000,
    "a header without an end": b"\x93NUMPY\x02\0" + struct.pack("<I", 1 << 31) + b"{",
    "a header of version 1 that is cut": b"\x93NUMPY\x01\0\x01",
    "negative numbers": header((-1, 3)) + bytes(12),
    "numbers that are a record": header((1, 3), "f4,f4") + bytes(24),
    "no header": b"state",
    "nothing": b"",
}


@pytest.mark.parametrize("name", ENTRIES)
def test_it_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / "recorded.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("state.npy", ENTRIES[name])
    with pytest.raises(UsageError, match="--golden"):
        read_golden(path, SIGNATURE)


def test_what_is_no_array_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "recorded.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("state", b"hello")
    with pytest.raises(UsageError, match="'state' must be an array"):
        read_golden(path, SIGNATURE)


def test_an_array_alone_of_four_eib(tmp_path: Path) -> None:
    path = tmp_path / "recorded.npy"
    path.write_bytes(header((1 << 60,)))
    with pytest.raises(UsageError, match="--golden"):
        read_golden(path, SIGNATURE)
