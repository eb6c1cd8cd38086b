"""A memory that carries the drawn action (``--for unity6``) is compared as numbers, and over steps."""

from __future__ import annotations

from pathlib import Path

import onnx
import pytest

from export_model.exporter.export.again import verify_folder
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import export
from fixtures import path as fixture
from tests.faults.artefacts import opened


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
    assert {c.kind for c in before.comparisons if c.output == "recurrent_out"} == {
        "shape",
        "numbers",
        "rollout",
        "draws",
    }
    artefact = opened("onnx", folder)
    plant(artefact.model)  # type: ignore[operator, attr-defined]
    artefact.save()
    after = verify_folder(folder, source=fixture("recurrent"), runtimes="onnxruntime")
    assert after.passed is False
    failed = [c for c in after.failures if c.runtime == "onnxruntime"]
    assert "recurrent_out" in {c.output for c in failed}
    assert kind in {c.kind for c in failed}
