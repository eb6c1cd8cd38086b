"""A few of the mutants of ``python -m tests.interfaces.mutants``, and files that are made to take long."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from export_model.converters.interfaces.metadata import read_metadata
from export_model.converters.interfaces.registry import read_interface
from export_model.signatures.errors import ExportModelError
from tests.interfaces.mutants import try_mutant


def test_mutants_are_read_or_left_out(tmp_path: Path) -> None:
    found = {try_mutant(number, tmp_path) for number in range(150)}
    assert {"read", "left out"} <= found


@pytest.mark.parametrize(
    "text",
    [
        "actions: !!python/object/apply:os.system ['touch ran']\nobservations: {}\n",
        "actions: {a: !!python/object/apply:os.system [touch ran], b: {scale: 1}}\nobservations: {}\n",
    ],
)
def test_nothing_is_executed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deploy.yaml").write_text(text)
    read_interface(tmp_path / "deploy.yaml", "policy.onnx", "policy")
    assert not (tmp_path / "ran").exists()


def test_aliases_of_long_texts_are_not_written_out(tmp_path: Path) -> None:
    text = f"observations: {{}}\nactions: {{}}\nlong: &a {'x' * 1_000_000}\n"
    text += "many: [" + ", ".join(["*a"] * 20_000) + "]\n"
    (tmp_path / "deploy.yaml").write_text(text)
    begun = time.monotonic()
    found = read_interface(tmp_path / "deploy.yaml", "policy.onnx", "policy")
    assert time.monotonic() - begun < 20
    assert sum(len(s.text) for s in found.kept) < 10_000


def test_large_metadata_is_left_out() -> None:
    assert read_metadata({"joint_names": "a," * 200_000}) is None
    with pytest.raises(ExportModelError):
        read_interface(Path("missing.yaml"), "", "")
