"""Chains of ops without end as source code: loops of a bounded length in place of one expression."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.graph.program import MAX_TERMS
from export_model.exporter.export.pipeline import ExportOptions, export
from tests.handmade import constant, dense, graph_bytes, node, placeholder

LENGTH = 3000


def chain(folder: Path) -> Path:
    """A policy whose observation goes through thousands of sines and sums."""
    nodes = [placeholder("vector_observation", (None, 3)), constant("shift", np.float32(0.25))]
    last = "vector_observation"
    for i in range(LENGTH):
        nodes.append(node(f"n{i}", "Sin", last) if i % 2 else node(f"n{i}", "Add", last, "shift"))
        last = f"n{i}"
    nodes += dense("action", last, 3, 2)
    path = folder / "chain.bytes"
    path.write_bytes(graph_bytes(nodes))
    return path


@pytest.mark.parametrize("target", ["c", "csharp", "js"])
def test_a_chain_of_thousands_of_ops_is_written(target: str, tmp_path: Path) -> None:
    (result,) = export([chain(tmp_path)], ExportOptions(tmp_path / "out", targets=(target,), verify="none"))
    text = "".join(p.read_text() for p in result.folder.glob("chain.*") if p.suffix in (".h", ".cs", ".mjs"))
    assert max(map(len, text.splitlines())) < 80 * MAX_TERMS


@pytest.mark.runtimes
@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed: apt-get install gcc libc6-dev")
def test_its_numbers_are_those_of_the_graph(tmp_path: Path) -> None:
    (result,) = export([chain(tmp_path)], ExportOptions(tmp_path / "out", targets=("c",), verify="c"))
    assert result.report is not None
    assert result.report.passed
