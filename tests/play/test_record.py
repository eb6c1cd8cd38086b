"""What was played is kept in parity.json, and shown by verify, its reports and the card."""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.exporter.verify.plays import read_plays
from export_model.signatures.contract import PARITY
from export_model.signatures.errors import BundleError
from fixtures import trained
from tests.commands import export_model, is_refused
from tests.play.conftest import FEW
from tests.reports.validation import check_parity

ONE = ("--runtimes", "onnxruntime")


@pytest.fixture
def bundle(bundles: Path, tmp_path: Path) -> Path:
    shutil.copytree(bundles / "GridWorld", tmp_path / "GridWorld")
    return tmp_path / "GridWorld"


def parity(folder: Path) -> Any:
    data = (folder / PARITY).read_bytes()
    check_parity(data)
    return json.loads(data)


def test_play_writes_what_each_earned_into_parity_json_and_verify_and_the_card_show_it(bundle: Path) -> None:
    ran = export_model("play", bundle, "--env", "GridWorld", *ONE, "--episodes", FEW, "--json")
    assert ran.status == 0, ran.err
    (record,) = parity(bundle)["played"]
    own = ran.json["reference"]
    assert record["verdict"] == "EQUIVALENT" and record["sentence"] == ran.json["sentence"]
    assert record["reference"]["mean_return"] == own["mean_return"]
    low, high = record["reference"]["return_interval"]
    assert low < own["mean_return"] < high
    assert [p["name"] for p in record["players"]] == ["onnx in onnxruntime"]

    junit, page = bundle.parent / "parity.xml", bundle.parent / "parity.html"
    ran = export_model("verify", bundle, *ONE, "--junit", junit, "--html", page, "--markdown", "-")
    assert ran.status == 0, ran.err
    assert "| onnx in onnxruntime |" in ran.out and "EQUIVALENT, 1 of 1 agree" in ran.out
    suites = {s.get("name"): s for s in ET.parse(junit).getroot()}
    assert [c.get("name") for c in suites["GridWorld.play.GridWorld"].iter("testcase")] == ["returns"]
    assert "Returns in GridWorld" in page.read_text(encoding="utf-8")
    assert f"played in GridWorld: {record['sentence']}" in export_model("verify", bundle, *ONE).out.replace("\n", " ")
    (told,) = export_model("verify", bundle, *ONE, "--json").json["reports"]
    assert told["played"] == [record]

    assert export_model("card", bundle).status == 0
    text = (bundle / "README.md").read_text(encoding="utf-8")
    assert "## Returns in GridWorld" in text and f"{own['mean_return']:.4g} (" in text


def test_an_environment_is_kept_once_and_others_beside_it(bundle: Path) -> None:
    for seed in (1, 2):
        played = ("play", bundle, "--env", "GridWorld", *ONE, "--episodes", FEW, "--seed", seed)
        assert export_model(*played).status == 0
    content = parity(bundle)
    assert [r["seed"] for r in content["played"]] == [2]
    content["played"][0]["environment"] = "another"
    (bundle / PARITY).write_text(json.dumps(content))
    assert export_model(*played).status == 0
    assert [r["environment"] for r in parity(bundle)["played"]] == ["another", "GridWorld"]


def test_a_bundle_that_was_not_verified_keeps_the_replay(bundle: Path) -> None:
    (bundle / PARITY).unlink(missing_ok=True)
    assert export_model("play", bundle, "--env", "GridWorld", *ONE, "--episodes", FEW).status == 0
    content = parity(bundle)
    assert content["passed"] is True and "compared in the states that" in content["notes"][-1]


def test_files_of_others_are_not_kept(bundle: Path) -> None:
    before = (bundle / PARITY).read_bytes() if (bundle / PARITY).is_file() else None
    ran = export_model("play", bundle, bundle / "GridWorld.onnx", "--env", "GridWorld", *ONE, "--episodes", FEW)
    assert ran.status == 0, ran.err
    assert before == ((bundle / PARITY).read_bytes() if (bundle / PARITY).is_file() else None)


def test_an_export_that_plays_reports_it(tmp_path: Path) -> None:
    junit, page = tmp_path / "parity.xml", tmp_path / "parity.html"
    given = ("--verify", "onnxruntime", "--to", "bytes,onnx", "--env", "GridWorld", "--junit", junit, "--html", page)
    ran = export_model(trained.run_folder("GridWorld"), "-o", tmp_path / "out", *given, "--json")
    assert ran.status == 0, ran.err
    (record,) = parity(tmp_path / "out" / "GridWorld")["played"]
    assert record["sentence"] == ran.json["play"][0]["sentence"]
    assert "GridWorld.play.GridWorld" in {s.get("name") for s in ET.parse(junit).getroot()}
    source = page.read_text(encoding="utf-8")
    assert "Survival" in source and "Mean difference and its interval" in source


@pytest.mark.parametrize("content", ["[", "[]", '{"played": [{"environment": 1}]}', '{"played": 3}'])
def test_another_parity_json_is_refused_or_named(content: str, bundle: Path) -> None:
    (bundle / PARITY).write_text(content)
    is_refused(export_model("verify", bundle, *ONE), "cannot be read")
    if "played" not in content:  # what can be replaced is
        ran = export_model("play", bundle, "--env", "GridWorld", *ONE, "--episodes", FEW)
        assert ran.status == 0 and "not kept in parity.json" in ran.out.replace("\n", " ")
        assert (bundle / PARITY).read_text() == content


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=8),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(st.sampled_from(["environment", "verdict", "margin", "players", "reference"]), inner)
        ),
        max_leaves=12,
    )
)
def test_any_record_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: Any) -> None:
    folder = tmp_path_factory.mktemp("any")
    (folder / PARITY).write_text(json.dumps({"played": content}))
    try:
        read_plays(folder)
    except BundleError as error:
        assert "cannot be read" in error.message
