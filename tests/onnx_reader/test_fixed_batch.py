"""Models that were exported for a fixed number of rows: where the batch goes when a shape is given in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.onnx.importer.fixed_batch import FixedBatch
from export_model.converters.graph.types import BATCH, Symbols
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.reports.summary import failure_lines
from tests.onnx_reader.models import Bench, floats, model, node

pytestmark = pytest.mark.xdist_group("onnx-policies")

Shape = Sequence[int | str]


@pytest.mark.parametrize(
    ("rows", "shape", "target", "wanted"),
    [
        (1, [BATCH, 36], [1, 36], [BATCH, 36]),
        (1, [BATCH, 36], [1, -1], [BATCH, 36]),
        (1, [BATCH, 36], [1, 1, 6, 6], [BATCH, 1, 6, 6]),
        (1, [BATCH, 8, 2, 2], [1, 32], [BATCH, 32]),
        (1, [BATCH, 1], [1], [BATCH]),
        (1, [1, BATCH], [1], [BATCH]),
        (4, [BATCH, 6], [4, 2, 3], [BATCH, 2, 3]),
        (4, [BATCH, 6], [24], None),
        # what an LSTM makes of its output: [steps, directions, rows, n] to [steps, rows, n]
        (1, [1, 1, BATCH, 8], [1, 1, 8], [1, BATCH, 8]),
        (1, [1, BATCH, 1, 8], [1, 1, 8], [1, BATCH, 8]),
        # what an LSTM takes: steps first
        (1, [BATCH, 16], [1, 1, 16], [1, BATCH, 16]),
        # queries, keys and values in one: [entities, rows, 3·n]
        (1, [5, BATCH, 24], [5, 1, 3, 8], [5, BATCH, 3, 8]),
    ],
)
def test_where_the_batch_goes(rows: int, shape: Shape, target: Sequence[int], wanted: list[Any] | None) -> None:
    found = FixedBatch(rows, Symbols()).target(target, shape)
    if wanted is None:
        assert found is not None
        assert [isinstance(d, str) for d in found] == [True]  # joined with what stands beside it
    else:
        assert found == wanted


def test_the_heads_of_an_attention_are_joined_to_the_batch_and_parted_again() -> None:
    rows = FixedBatch(1, Symbols())
    heads = rows.target([5, 2, 4], [5, BATCH, 8])
    assert heads is not None
    entities, joined, size = heads
    assert (entities, size) == (5, 4)
    assert joined not in (BATCH, 2)
    flat = rows.target([5, 8], [5, joined, 4])
    assert flat is not None
    assert isinstance(flat[0], str)
    assert flat[1] == 8
    assert rows.target([5, 1, 8], flat) == [5, BATCH, 8]


def test_what_is_not_about_the_batch_is_left_alone() -> None:
    rows = FixedBatch(1, Symbols())
    assert rows.target([3, 4], [12]) is None
    assert rows.target([3, 4], [BATCH, 5]) is None
    assert rows.target([-1, 4], ["other", 8]) is None


def test_a_whole_attention_layer(bench: Bench, tmp_path: Path) -> None:
    """As PyTorch's MultiheadAttention is written for one row: entities first, heads joined to the rows."""
    n, d, heads = 5, 8, 2
    nodes = [
        node("MatMul", ["obs_0", "e"], "x"),
        node("Transpose", ["x"], "t", perm=[1, 0, 2]),
        node("MatMul", ["t", "w"], "qkv"),
        node("Reshape", ["qkv", "s0"], "parts"),
        *(node("Gather", ["parts", f"i{i}"], f"p{i}", axis=2) for i in range(3)),
        *(node("Reshape", [f"p{i}", "s1"], f"h{i}") for i in range(3)),
        node("Transpose", ["h0"], "q", perm=[1, 0, 2]),
        node("Transpose", ["h1"], "k", perm=[1, 2, 0]),
        node("Transpose", ["h2"], "v", perm=[1, 0, 2]),
        node("MatMul", ["q", "k"], "scores"),
        node("Softmax", ["scores"], "a", axis=-1),
        node("MatMul", ["a", "v"], "mixed"),
        node("Transpose", ["mixed"], "back", perm=[1, 0, 2]),
        node("Reshape", ["back", "s2"], "rows"),
        node("Gemm", ["rows", "o"], "made"),
        node("Reshape", ["made", "s3"], "again"),
        node("Transpose", ["again"], "batch_first", perm=[1, 0, 2]),
        node("Add", ["x", "batch_first"], "sum"),
        node("ReduceMean", ["sum"], "mean", axes=[1], keepdims=0),
        node("Gemm", ["mean", "last"], "action"),
    ]
    constants = {
        "e": floats(4, d, seed=1), "w": floats(d, 3 * d, seed=2, scale=0.3), "o": floats(d, d, seed=3, scale=0.3),
        "last": floats(d, 3, seed=4), "s0": np.array([n, 1, 3, d]), "s1": np.array([n, heads, d // heads]),
        "s2": np.array([n, d]), "s3": np.array([n, 1, d]), **{f"i{i}": np.array(i) for i in range(3)},
    }  # fmt: skip
    message = model(nodes, {"obs_0": (np.float32, [1, n, 4])}, {"action": (np.float32, [1, 3])}, constants)
    (result,) = export([bench.place(message)], ExportOptions(tmp_path, verify=("onnxruntime",)), pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert result.policy.signature.input("entities_0").shape == (None, n, 4)
    assert result.policy.source.rows == 1
