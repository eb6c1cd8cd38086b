"""``export-model skill``: the page for coding agents says what this program does, and its recipes run."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from export_model.exporter import __version__
from export_model.exporter.cli.app import app
from export_model.exporter.cli.skill import RECIPES, SCHEMAS, STATUSES
from tests.commands import export_model

PAGE = export_model("skill").out


def test_it_is_a_skill_file_of_this_version() -> None:
    name, described = re.fullmatch(r"---\nname: (\S+)\ndescription: (.+)\n---\n.*", PAGE, re.DOTALL).groups()  # type: ignore[union-attr]
    assert name == "export-model" and 50 < len(described) < 1024
    assert f"# export-model {__version__}" in PAGE
    assert len(PAGE.splitlines()) <= 150


def test_every_command_and_status_is_named() -> None:
    assert re.findall(r"^- `(\S+)[^`]*`: .+", PAGE.partition("## Commands")[2].partition("## JSON")[0], re.M) == sorted(
        app.commands
    )
    assert [n for n, _ in STATUSES] == [0, 1, 2, 3]


@pytest.mark.runtimes
def test_the_recipes_run_in_order_and_print_the_fields(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert export_model("demo", "--files").status == 0
    fields = re.search(r"parity.json in a bundle: (.*)", PAGE)
    assert fields is not None
    named = {f.split(" ")[0] for f in re.sub(r"\([^)]*\)", "", fields[1]).split(", ")}
    for _, typed in RECIPES:
        words = typed.split()
        ran = export_model(
            *words, *([] if words[0] in ("inspect", "snippets") else ["--verify", "onnxruntime,tensorflow"])
        )
        assert ran.status == 0, (typed, ran.err)
        if "--json" in words and words[0] != "inspect":
            report = ran.json["reports"][0] if "reports" in ran.json else ran.json["policies"][0]["parity"]
            assert named <= set(report), typed


def test_errors_are_json_too() -> None:
    ran = export_model("inspect", "nothing.onnx", "--json")
    assert ran.status == 2 and json.loads(ran.out)["fix"]


def test_the_schemas_are_those_that_there_are() -> None:
    assert {Path(file).name for file, _ in SCHEMAS.values()} == {
        "parity.schema.json",
        "log.schema.json",
        "play.schema.json",
    }
