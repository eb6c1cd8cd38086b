"""What rounding explains of a mean over a window: sums cancel, and runtimes add float32 in an order of their own."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import FLOAT32
from export_model.exporter.verify.rounding import FACTOR, RUNS


def pooled(size: int) -> Graph:
    window = {"ksize": (1, size, size, 1), "strides": (1, 1, 1, 1), "padding": "VALID", "data_format": "NHWC"}
    image = Node("x", "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, size, size, 1))})
    return Graph((image, Node("y", "AvgPool", ("x",), window)))


@pytest.mark.parametrize("size", [2, 3, 7, 14])
def test_a_mean_that_cancels_is_off_by_its_terms(size: int) -> None:
    """Held from both sides: what adding one after the other is off by, and not a hundred times that."""
    half = np.random.default_rng(size).uniform(-1e4, 1e4, (400, size * size // 2)).astype(np.float32)
    x = np.concatenate([half, -half[:, ::-1], np.zeros((400, size % 2), np.float32)], axis=1)
    graph, feeds = pooled(size), {"x": x.reshape(-1, size, size, 1)}
    exact = run_graph(graph, feeds, ["y"])["y"].reshape(-1)
    total = np.add.accumulate(x[:, np.random.default_rng(1).permutation(size * size)], axis=1)[:, -1]
    off = np.abs(total / np.float32(size * size) - exact)
    moved = [np.abs(run_graph(graph, feeds, ["y"], Jitter(seed))["y"].reshape(-1) - exact) for seed in range(RUNS)]
    bound = FACTOR * np.max(moved, axis=0)
    assert (off <= bound).mean() > 0.99
    assert bound.max() < 100 * off.max() + 1e-2
    assert bound.max() < 1e-3 * np.abs(x).max()
