"""Bundles that were made for a consumer: the export and ``verify`` ask that consumer's own checkers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from export_model.converters.consumers.profiles import profile
from export_model.exporter.verify.checks.consumer import consumers
from export_model.exporter.verify.options import VerifyOptions
from export_model.signatures.errors import UsageError
from fixtures import path as fixture
from tests.exporting import export_model, verify_bundle


@pytest.mark.parametrize(
    ("name", "releases"),
    [("unity6", {"R22", "R23", "R23-2.4"}), ("barracuda-3", {"R20"}), ("barracuda-1.4", {"R20", "2.0.1"})],
)
def test_a_bundle_that_was_made_for_a_consumer_is_held_to_its_checkers(
    name: str, releases: set[str], tmp_path: Path
) -> None:
    (result,) = export_model(fixture("recurrent"), tmp_path, for_=name, verify="numpy")
    assert result.contract["tool"]["profile"] == name
    for report in (result.report, verify_bundle(result.folder)):
        assert report is not None
        asked = [c for c in report.comparisons if c.kind in ("accepted", "played")]
        assert {c.runtime for c in asked} == releases
        assert all(c.passed for c in asked), [c.reason for c in asked]
        wanted = profile(name)
        assert {c.runtime for c in asked if c.kind == "accepted"} == set(wanted.checkers)
        assert {c.runtime for c in asked if c.kind == "played"} == set(wanted.players)
        assert all("played by our model" in p.worst_text for p in report.pairs if p.runtime in wanted.players)
        assert all("checked" in p.worst_text for p in report.pairs if p.runtime in wanted.checkers)
        assert report.passed is not False


def test_it_is_held_against_a_source_whose_name_is_none_of_a_file(tmp_path: Path) -> None:
    source = tmp_path / "owner+repository__policy.bytes"
    source.write_bytes(fixture("recurrent").read_bytes())
    (result,) = export_model(source, tmp_path / "out", for_="barracuda-3", verify="numpy")
    report = verify_bundle(result.folder, source=source, runtimes="numpy", allow_unverified=True)
    assert report.passed is not False and report.policy == "owner-repository__policy"


def test_what_the_consumer_refuses_is_a_finding_in_its_words(tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, to="onnx", verify="none")
    found = list(consumers("unity6", {"onnx": result.folder / "continuous.onnx"}))
    assert [c.runtime for c in found if c.kind == "accepted"] == ["R22", "R23", "R23-2.4"]
    assert not any(c.passed for c in found if c.kind == "accepted")
    assert all(c.reason for c in found)
    assert found[0].sentence().startswith("onnx is not accepted by R22: ")
    assert json.dumps(found[0].to_dict())


def test_a_bundle_for_everyone_asks_nobody(tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, to="onnx", verify="numpy")
    assert result.report is not None
    assert not [c for c in result.report.comparisons if c.kind == "accepted"]
    assert "profile" not in result.contract["tool"]


@pytest.mark.parametrize(
    "asked",
    [{"runtimes": "onnxruntime"}, {"options": VerifyOptions(golden=Path("x.npz"))}],
)
def test_what_its_checkers_cannot_answer_is_not_promised(asked: dict[str, Any], tmp_path: Path) -> None:
    (result,) = export_model(fixture("recurrent"), tmp_path, for_="unity6", verify="none")
    with pytest.raises(UsageError, match="checkers alone"):
        verify_bundle(result.folder, **asked)


@pytest.mark.parametrize("asked", [{"to": "bytes,saved_model,tfjs,onnx"}, {"opset": 15}])
def test_what_the_consumer_decides_is_not_asked_in_vain(asked: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not go with --for unity6"):
        export_model(fixture("continuous"), tmp_path, for_="unity6", verify="none", **asked)
    assert not any(tmp_path.iterdir())
