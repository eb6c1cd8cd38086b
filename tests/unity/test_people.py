"""What people are shown: the picture of Behavior Parameters, the pictures of the documentation, the agent in C#."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from export_model.converters.consumers.unity.checker import check_file
from export_model.converters.consumers.unity.consumers import CONSUMERS
from export_model.converters.consumers.unity.settings import Brain, sensors_of
from export_model.exporter.cli.app import app
from export_model.exporter.inspect.behavior_parameters import behavior_parameters
from export_model.exporter.snippets.contract import read_bundle
from export_model.exporter.snippets.registry import snippets
from export_model.signatures.errors import UsageError
from tests.commands import ROOT
from tests.unity.policies import Draft

SVG = "{http://www.w3.org/2000/svg}"
PICTURES = ROOT / "docs" / "pictures"


def texts(picture: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(picture).iter(f"{SVG}text")]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """3DBall, plain and for Unity 6."""
    folder = tmp_path_factory.mktemp("people")
    source = folder / "3DBall.bytes"
    source.write_bytes((ROOT / "fixtures/trained/3DBall/frozen_graph_def.pb").read_bytes())
    for place, options in (("plain", []), ("for_unity", ["--for", "unity6"])):
        ran = CliRunner().invoke(app, ["export", str(source), "-o", str(folder / place), "--verify", "none", *options])
        assert ran.exit_code == 0, ran.output
    return folder


def test_the_picture_has_the_fields_and_the_messages(tmp_path: Path) -> None:
    brain = Brain(0, (3, 2), 4, 2, sensors_of([[3, 20, 24], [8]]))
    verdict = check_file(Draft(types={"version_number": np.int64}).write(tmp_path), CONSUMERS["R20"], brain)
    shown = texts(behavior_parameters(verdict))
    for label, value in (
        ("Space Size", "4"),
        ("Stacked Vectors", "2"),
        ("Branch 1 Size", "2"),
        ("Model", "policy.onnx"),
    ):
        assert shown[shown.index(label) + 1] == value
    joined = " ".join(shown)
    assert "0 CameraSensor 3×20×24" in joined
    assert all(finding.message in joined for finding in verdict.modes["stochastic"].checks)


def test_a_message_cannot_break_the_picture(tmp_path: Path) -> None:
    draft = Draft(inputs={"<script>&": (1, ["N", 5])})
    shown = " ".join(texts(behavior_parameters(check_file(draft.write(tmp_path), CONSUMERS["R22"], Brain(2)))))
    assert "unexpected input named : <script>&" in shown


def test_svg_is_for_one_verdict(tmp_path: Path) -> None:
    path = Draft().write(tmp_path)
    ran = CliRunner().invoke(app, ["inspect", str(path), "--unity", "all", "--svg", str(tmp_path / "all.svg")])
    assert isinstance(ran.exception, UsageError)


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("behavior-parameters", "for_unity/3DBall/3DBall.onnx"),
        ("behavior-parameters-refused", "plain/3DBall/3DBall.onnx"),
    ],
)
def test_the_pictures_of_the_documentation_are_what_the_tool_draws(name: str, file: str, exported: Path) -> None:
    drawn = behavior_parameters(check_file(exported / file, CONSUMERS["R23"]))
    assert (PICTURES / f"{name}.svg").read_text(encoding="utf-8") == drawn


def test_the_agent_has_the_policys_numbers(exported: Path) -> None:
    (made,), _ = snippets(read_bundle(exported / "for_unity" / "3DBall"), "agent")
    assert "public class Agent3DBall : Agent" in made.code
    assert "Space Size 8" in made.code and "Continuous Actions 2, Discrete Branches 0" in made.code
    assert "new float[8]" in made.code and "continuous[1] = 0f;" in made.code
    assert made.code.count("{") == made.code.count("}")
    assert not re.search(r"\$\w|WriteDiscreteActionMask", made.code)
    page = (ROOT / "docs/tasks/unity-old-brain.md").read_text(encoding="utf-8")
    assert made.code.split("using ")[0] in page
