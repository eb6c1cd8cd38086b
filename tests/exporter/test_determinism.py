"""The same source and options give the same bytes: twice in one process, in two, under any seed of the hashes."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from fixtures import FIXTURES
from fixtures import path as fixture
from tests.commands import export_model, files_in, python

FLAGS = {
    "as it is": (),
    "for Unity": ("--names", "source"),
    "noise kept": ("--noise", "keep"),
    "deterministic": ("--deterministic",),
    "newest opset": ("--opset", "21"),
}


def digests(folder: Path) -> dict[str, str]:
    """sha256 of every file but parity.json."""
    files = {p: folder / p for p in files_in(folder) if (folder / p).is_file() and not p.endswith("parity.json")}
    assert files
    return {p: hashlib.sha256(f.read_bytes()).hexdigest() for p, f in files.items()}


def in_this_process(folder: Path, *flags: str) -> dict[str, str]:
    ran = export_model(*map(fixture, FIXTURES), "-o", folder, "--verify", "none", *flags)
    assert ran.status == 0, ran.err
    return digests(folder)


@pytest.mark.slow
@pytest.mark.parametrize("how", FLAGS)
def test_the_bytes_do_not_depend_on_the_run(how: str, tmp_path: Path) -> None:
    first = in_this_process(tmp_path / "first", *FLAGS[how])
    assert in_this_process(tmp_path / "second", *FLAGS[how]) == first
    assert len(first) == 7 * 8


@pytest.mark.runtimes
@pytest.mark.parametrize("seed", ["0", "4242"])
def test_the_bytes_do_not_depend_on_the_process_or_its_hashes(seed: str, tmp_path: Path) -> None:
    expected = in_this_process(tmp_path / "here")
    surroundings = {"PYTHONHASHSEED": seed, "TZ": "Asia/Tokyo", "LC_ALL": "C", "HOME": str(tmp_path)}
    (tmp_path / "elsewhere").mkdir()
    ran = python(
        *("-m", "export_model", *map(fixture, FIXTURES), "-o", "there", "--verify", "none"),
        environment=surroundings,
        cwd=tmp_path / "elsewhere",
    )
    assert (ran.status, ran.err) == (0, "")
    assert digests(tmp_path / "elsewhere" / "there") == expected


def test_the_bytes_do_not_depend_on_where_the_source_lies_or_when_it_was_written(tmp_path: Path) -> None:
    copy = tmp_path / "a long way off" / "continuous.bytes"
    copy.parent.mkdir()
    copy.write_bytes(fixture("continuous").read_bytes())
    os.utime(copy, (1, 1))
    for source, folder in ((fixture("continuous"), "a"), (copy, "b")):
        assert export_model(source, "-o", tmp_path / folder, "--verify", "none").status == 0
    assert digests(tmp_path / "a") == digests(tmp_path / "b")


def test_what_was_exported_before_in_the_process_does_not_matter(tmp_path: Path) -> None:
    flags = ("--verify", "none", "-o")
    export_model(fixture("visual"), fixture("recurrent"), *flags, tmp_path / "a")
    export_model(fixture("recurrent"), fixture("visual"), *flags, tmp_path / "b")
    assert digests(tmp_path / "a") == digests(tmp_path / "b")
