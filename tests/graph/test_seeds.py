"""The seed of the trainer's run is in no artefact: with it, every start (in TensorFlow.js every run) draws the same."""

from __future__ import annotations

from pathlib import Path

from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.ops.samplers import SAMPLERS
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from fixtures import path as fixture


def seeds(graph_bytes: bytes) -> list[tuple[int, int]]:
    nodes = [n for n in read_graph(graph_bytes).nodes if n.op in SAMPLERS]
    return [(n.attrs.get("seed", 0), n.attrs.get("seed2", 0)) for n in nodes]


def test_no_sampler_keeps_its_seed(tmp_path: Path) -> None:
    assert any(seed for seed, _ in seeds(fixture("sampled").read_bytes())), "the fixture has none to lose"
    (result,) = export([fixture("sampled")], ExportOptions(tmp_path, verify="none"))
    written = seeds((result.folder / "sampled.bytes").read_bytes())
    assert written
    assert set(written) == {(0, 0)}
    for folder in ("saved_model", "tfjs"):
        graph = read_source(result.folder / folder).models[0].graph
        assert all(n.attrs.get("seed", 0) == 0 == n.attrs.get("seed2", 0) for n in graph.nodes if n.op in SAMPLERS)
