"""What an export costs is said: before it is written where weights become much text, and by step with ``-v``."""

from __future__ import annotations

from pathlib import Path

from fixtures import path
from tests.bench.robot_networks import dense_network
from tests.commands import export_model


def test_many_weights_as_text_are_said_before_they_are_written(tmp_path: Path) -> None:
    model, given = tmp_path / "large.onnx", ("-o", tmp_path / "out", "--to", "c", "--verify", "none")
    dense_network("large", (64, 1024, 1024, 4), "Relu").save(model)
    said = export_model(model, *given).err
    assert "note: the weights of large take 18 MB as text (c), 4 MB by --weights file" in said
    assert "as text" not in export_model(model, *given, "--weights", "file").err
    assert "as text" not in export_model(path("continuous"), *given).err


def test_verbose_says_where_the_time_went(tmp_path: Path) -> None:
    given = ("-o", tmp_path, "--to", "onnx", "--verify", "none")
    said = export_model(path("continuous"), *given, "-v").err
    _, steps = said.split("where the time went:\n")
    assert {line.split()[2] for line in steps.splitlines()} >= {"reading", "compiling", "writing"}
    assert "where the time went" not in export_model(path("continuous"), *given).err
