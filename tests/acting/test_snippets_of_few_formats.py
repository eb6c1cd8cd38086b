"""Snippets of bundles that lack formats, were changed, or keep the names of their trainer; and names in code."""

from __future__ import annotations

import re
from pathlib import Path

from exporter import export_model
from exporter.snippets.contract import class_name, identifier, read_bundle, wrap_items
from exporter.snippets.registry import snippets
from fixtures import path as fixture
from tests.commands import export_model as run
from tests.commands import is_refused


def test_what_a_bundle_has_not_is_left_out_or_refused(tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, to="bytes", verify="none")
    ran = run("snippets", result.folder)
    assert "left out: onnxruntime needs onnx, which this bundle lacks" in ran.out
    assert "left out: policy-ort needs tfjs and onnx" in ran.out
    assert "(--for tensorflowsharp)" in ran.out
    is_refused(
        run("snippets", result.folder, "--for", "onnxruntime"), "has no onnx, which --for onnxruntime needs", "fix"
    )
    is_refused(run("snippets", result.folder, "--for", "swift"), "unknown target", "onnxruntime")
    is_refused(run("snippets", tmp_path / "none"), "no such folder")


def test_only_what_a_bundle_lacks_is_said_to_be_lacking(tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, to="onnx", verify="none")
    assert "left out: policy-ort needs tfjs, which this bundle lacks" in run("snippets", result.folder).out


def test_a_recurrent_policy_with_the_nodes_of_its_trainer_runs_in_unity(tmp_path: Path) -> None:
    (result,) = export_model(fixture("recurrent"), tmp_path, names="source", to="bytes", verify="none")
    made, _ = snippets(read_bundle(result.folder), "internal-brain")
    assert "ML-Agents 0.5: Brain Type Internal" in made[0].code
    assert re.search(r"Recurrent Input Node Name +recurrent_in\n", made[0].code)


def test_a_changed_bundle_is_refused(tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, to="bytes", verify="none")
    with (result.folder / "continuous.bytes").open("ab") as file:
        file.write(b"x")
    is_refused(run("snippets", result.folder), "has been changed since it was exported")


def test_names_for_code() -> None:
    assert class_name("3DBall") == "Policy3DBall"
    assert class_name("own-names.v2") == "OwnNamesV2Policy"
    assert identifier("Brain/state") == "Brain_state"
    assert identifier("0") == "input_0"
    lines = wrap_items("state: numbers", [f"{i} {'x' * 20}" for i in range(12)])
    assert len(lines) > 1
    assert max(map(len, lines)) <= 102
