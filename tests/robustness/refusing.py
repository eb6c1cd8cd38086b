"""Graphs that are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.commands import export_model, files_in, is_refused
from tests.handmade import NodeDef, graph_bytes


def refused(nodes: list[NodeDef], folder: Path, *words: object) -> str:
    """Export a graph; asserts the refusal, and that it names the file."""
    file = folder / "policy.bytes"
    file.write_bytes(graph_bytes(nodes))
    message = is_refused(export_model(file, "-o", folder / "out", "--verify", "none"), file, *words)
    assert files_in(folder) == {"policy.bytes"}
    return message


def tensor(nodes: list[NodeDef], name: str) -> Any:
    """The TensorProto of a constant."""
    return next(n for n in nodes if n.name == name).attr["value"].tensor
