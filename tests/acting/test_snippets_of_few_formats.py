"""Snippets of bundles that lack formats, were changed, or keep the names of their trainer; and names in code."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.exporter.snippets.contract import class_name, identifier, read_bundle, wrap_items
from export_model.exporter.snippets.registry import snippets
from fixtures import path as fixture
from tests.commands import export_model as run
from tests.commands import is_refused
from tests.exporting import export_model


def test_what_a_bundle_has_not_is_left_out_or_refused(tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, to="bytes", verify="none")
    ran = run("snippets", result.folder)
    lines = {line.split()[0]: line for line in ran.out.splitlines()}
    assert lines["onnxruntime"].endswith("; needs onnx")
    assert lines["policy-ort"].endswith("; needs tfjs and onnx")
    assert "needs" not in lines["tensorflowsharp"]
    is_refused(
        run("snippets", result.folder, "--for", "onnxruntime"), "has no onnx, which --for onnxruntime needs", "fix"
    )
    is_refused(run("snippets", result.folder, "--for", "swift"), "unknown target", "onnxruntime")
    is_refused(run("snippets", tmp_path / "none"), "no such folder")


@pytest.mark.parametrize("policy", ["continuous", "recurrent"])
def test_the_snippet_for_litert_answers_what_onnxruntime_does(policy: str, tmp_path: Path) -> None:
    pytest.importorskip("ai_edge_litert")
    onnxruntime = pytest.importorskip("onnxruntime")
    (result,) = export_model(fixture(policy), tmp_path, to=["litert", "onnx"], verify="none")
    played: dict[str, Any] = {}
    exec(run("snippets", result.folder, "--for", "litert").out, played)
    said = played["outputs"]
    session = onnxruntime.InferenceSession(result.folder / f"{policy}.onnx")
    kinds = {"tensor(float)": np.float32, "tensor(int32)": np.int32}
    feeds = {i.name: played["feeds"][i.name].astype(kinds[i.type]) for i in session.get_inputs()}
    wanted = dict(zip([o.name for o in session.get_outputs()], session.run(None, feeds), strict=True))
    assert said.keys() == wanted.keys()
    for name, value in said.items():
        np.testing.assert_allclose(value, wanted[name], rtol=1e-5, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("to", ["c", "js", "c,js", "csharp", "litert", "nn", "onnx", "bytes"])
def test_the_next_line_leads_to_code_only_where_there_is_some(to: str, tmp_path: Path) -> None:
    ran = run(fixture("continuous"), "-o", tmp_path, "--to", to, "--verify", "numpy")
    line = ran.out.strip().splitlines()[-1]
    made, _ = snippets(read_bundle(tmp_path / "continuous"))
    calling = {s.target.name for s in made if not s.target.name.startswith("recorder")}
    assert ("export-model snippets" in line) is bool(calling) or "pip install" in line or "runtimes install" in line


def test_only_what_a_bundle_lacks_is_said_to_be_lacking(tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, to="onnx", verify="none")
    assert "policy.mjs with onnxruntime-web; needs tfjs\n" in run("snippets", result.folder).out


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
