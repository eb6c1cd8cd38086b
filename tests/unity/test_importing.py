"""The importers' refusals are those recorded: 352 small models, one construct each, in four runtimes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from onnx import TensorProto, helper

from export_model.converters.consumers.unity.checker import check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS
from export_model.converters.consumers.unity.importing import refusal
from export_model.converters.consumers.unity.onnx_file import read_onnx_file
from tests.unity.conftest import document, lines
from tests.unity.policies import Draft

ROWS = lines("onnx_rules/onnx_rules.jsonl")
LATER = {row["id"]: row["results"] for row in lines("onnx_rules/inference_engine.jsonl")}
PARAMETERS = [pytest.param(row, id=row["id"]) for row in ROWS] or [pytest.param({}, id="shared-is-absent")]


@pytest.mark.corpus
@pytest.mark.parametrize("row", PARAMETERS)
def test_an_import_ends_as_recorded(row: dict[str, Any], unity_data: Path) -> None:
    file = read_onnx_file(unity_data / "onnx_rules" / row["file"])
    results = {**row["results"], **LATER[row["id"]]}
    for consumer in CONSUMERS.values():
        recorded, found = results[consumer.runtime]["import"], refusal(file, consumer)
        if recorded == "ok":
            assert found is None, consumer.name
        else:
            assert found is not None and found.exception == recorded["exception"], consumer.name
            assert recorded["message"].startswith(found.message.rstrip()), consumer.name


ORIGINALS = document("r3/cases/import_not_foreseen/originals.json")


@pytest.mark.corpus
@pytest.mark.parametrize("row", ORIGINALS, ids=lambda row: row.get("source", "shared-is-absent"))
def test_an_original_of_another_trainer_is_imported_or_refused_as_recorded(
    row: dict[str, Any], unity_data: Path
) -> None:
    """These 26 were foreseen otherwise once: weights in a file of their own, a rank that is lost, a computed B."""
    consumer = next(c for c in CONSUMERS.values() if c.runtime == row["runtime"])
    found = refusal(read_onnx_file(unity_data.parent / row["source"]), consumer)
    recorded = row["import_error"]
    assert (None if found is None else f"{found.exception}: {found.message.strip()}") == recorded


@pytest.mark.corpus
def test_as_many_originals_of_other_trainers_are_imported_as_were(unity_data: Path) -> None:
    """With the 26 above in their places, the other 217 of 243 answers are the recorded ones as well."""
    recorded = json.loads((unity_data / "r3/cases/import_not_foreseen/counts.json").read_text())["by_runtime"]
    files = [read_onnx_file(path) for path in sorted((unity_data.parent / "foreign").glob("*.onnx"))]
    for consumer in (c for c in CONSUMERS.values() if c.runtime in recorded):
        imported = sum(refusal(file, consumer) is None for file in files)
        assert {"files": len(files), "imported": imported} == recorded[consumer.runtime], consumer.name


@pytest.mark.parametrize(("runtime", "refused"), [("R22", True), ("R23", False)])
def test_an_operator_that_one_runtime_lacks_is_refused_by_that_one(runtime: str, refused: bool, tmp_path: Path) -> None:
    nodes = [helper.make_node("Mish", ["obs_0"], ["mish"]), helper.make_node("Abs", ["mish"], ["left_out"])]
    file = read_onnx_file(Draft(extra=nodes, opset=18).write(tmp_path))
    assert (refusal(file, CONSUMERS[runtime]) is not None) == refused


def test_what_is_read_wrongly_without_an_error_is_told(tmp_path: Path) -> None:
    draft = Draft(
        extra=[
            helper.make_node("Cast", ["obs_0"], ["whole"], to=TensorProto.INT64),
            helper.make_node("Cast", ["whole"], ["floored"], to=TensorProto.FLOAT),
        ]
    )
    path = draft.write(tmp_path)
    barracuda, sentis = (check_file(path, CONSUMERS[name]) for name in ("R20", "R22"))
    assert barracuda.accepted["stochastic"] and sentis.accepted["stochastic"]
    assert [f.message.split(":")[0] for f in barracuda.misread] == ["Cast gives other numbers, without an error"]
    assert sentis.misread == ()


def test_all_that_is_refused_is_told_and_not_only_the_first(tmp_path: Path) -> None:
    nodes = [helper.make_node(op, ["obs_0"], [f"y{op}"]) for op in ("Softsign", "HardSwish")]
    verdict = check_file(Draft(extra=nodes, opset=14).write(tmp_path), CONSUMERS["R20"])
    assert verdict.refused is not None and "Unknown type Softsign" in verdict.refused.message
    assert {f.message.split()[0] for f in verdict.misread} == {"Softsign", "HardSwish"}
