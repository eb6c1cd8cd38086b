"""A memory that carries the drawn action (``--for unity6``): its other columns are compared as numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest

from converters.formats.frozen_graph.reader import read_graph
from converters.graph.nodes import Graph
from exporter.export.again import verify_folder
from exporter.export.options import ExportOptions
from exporter.export.pipeline import export
from exporter.verify.drawn_columns import drawn_columns, without_draws
from fixtures import path as fixture
from tests.faults.artefacts import opened
from tests.handmade import constant, graph_bytes, node, placeholder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (result,) = export([fixture("recurrent")], ExportOptions(tmp_path, profile="unity6", verify="none"))
    return result.folder


def swapped_memory(model: onnx.ModelProto) -> None:
    """[c|h|action] as [h|c|action]."""
    made = {name: n for n in model.graph.node for name in n.output}
    at = made["recurrent_out"]
    while at.op_type != "Concat" or len(at.input) < 2 or made[at.input[0]].op_type == "Cast":
        at = made[at.input[0]]
    inner = made[at.input[0]] if made[at.input[0]].op_type == "Concat" else at
    inner.input[0], inner.input[1] = inner.input[1], inner.input[0]


def kept_zeros(model: onnx.ModelProto) -> None:
    """The action is not kept: zeros are."""
    made = {name: n for n in model.graph.node for name in n.output}
    at = made["recurrent_out"]
    while at.op_type != "Concat":
        at = made[at.input[0]]
    last = at.input[-1]
    model.graph.node.insert(
        list(model.graph.node).index(at), onnx.helper.make_node("Sub", [last, last], ["planted/zeros"])
    )
    at.input[-1] = "planted/zeros"


@pytest.mark.parametrize(("plant", "kind"), [(swapped_memory, "numbers"), (kept_zeros, "draws")])
def test_a_fault_beside_the_kept_action_is_found(plant: object, kind: str, folder: Path) -> None:
    before = verify_folder(folder, source=fixture("recurrent"), runtimes="onnxruntime")
    assert before.passed is True
    assert {c.kind for c in before.comparisons if c.output == "recurrent_out"} == {"numbers", "draws"}
    artefact = opened("onnx", folder)
    plant(artefact.model)  # type: ignore[operator, attr-defined]
    artefact.save()
    after = verify_folder(folder, source=fixture("recurrent"), runtimes="onnxruntime")
    assert after.passed is False
    failed = [c for c in after.failures if c.runtime == "onnxruntime"]
    assert {c.output for c in failed} == {"recurrent_out"}
    assert kind in {c.kind for c in failed}


def graph(*nodes: object) -> Graph:
    return read_graph(graph_bytes([placeholder("x"), constant("axis", 1), constant("one", 1), *nodes]))


def test_columns_that_a_sampler_decides() -> None:
    drawn = node("drawn", "Multinomial", "x", "one", output_dtype=np.int64, seed=1, seed2=2)
    number = node("number", "Cast", "drawn", SrcT=np.int64, DstT=np.float32)
    both = node("both", "ConcatV2", "x", "number", "axis", N=2)
    rows = [constant("to", np.array([-1, 1, 4], np.int32)), node("rows", "Reshape", "both", "to")]
    mixed = node("mixed", "Mul", "both", "both")
    short = [constant("flat", np.array([-1], np.int32)), node("line", "Reshape", "both", "flat")]
    made = graph(drawn, number, both, *rows, mixed, *short)
    found = drawn_columns(made, ["x", "drawn", "both", "rows", "mixed", "line"])
    assert {name: mask.tolist() for name, mask in found.items()} == {
        "both": [False, False, False, True],
        "rows": [False, False, False, True],
    }
    values = np.array([[1, 2, 3, 4], [5, 6, 7, np.nan]], np.float32)
    assert np.array_equal(without_draws(values, found["both"]), [[1, 2, 3, 0], [5, 6, 7, np.nan]], equal_nan=True)
