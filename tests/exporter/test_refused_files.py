"""Damaged files among others: each is refused by name, and the rest is done; nothing is skipped in silence."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from export_model.exporter.fleet.sources import sources_in
from export_model.signatures.errors import RefusedError
from fixtures import path as fixture
from tests import exporting
from tests.commands import export_model

PLAIN = ("--to", "onnx", "--verify", "none")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of policies of which one is cut off, as a run leaves it."""
    monkeypatch.chdir(tmp_path)
    place = tmp_path / "g"
    place.mkdir()
    shutil.copy(fixture("continuous"), place / "good.bytes")
    (place / "cut.bytes").write_bytes(fixture("discrete").read_bytes()[:3000])
    return place


@pytest.mark.parametrize("many", [(), ("--jobs", "1")], ids=["alone", "fleet"])
def test_a_damaged_file_refuses_itself_and_not_its_folder(many: tuple[str, ...], folder: Path) -> None:
    ran = export_model("g", "-o", "out", *many, *PLAIN)
    assert ran.status == 2
    assert "cut.bytes" in ran.err
    assert sorted(p.name for p in Path("out").iterdir() if p.is_dir()) == ["good"]
    told = export_model("g", "-o", "again", *many, *PLAIN, "--json")
    assert told.status == 2
    assert [p["name"] for p in told.json["policies"]] == ["good"]
    assert [e["error"] for e in told.json["refused"]] == ["DamagedFileError"]
    assert "cut.bytes" in told.json["refused"][0]["where"]


def test_python_raises_when_the_rest_is_written(folder: Path) -> None:
    with pytest.raises(RefusedError) as caught:
        exporting.export_model(folder, folder.parent / "out", to=["onnx"], verify="none")
    assert "cut.bytes" in str(caught.value)
    assert (folder.parent / "out/good/policy.json").is_file()


def test_a_model_that_cannot_be_understood_refuses_itself(folder: Path) -> None:
    (folder / "cut.bytes").unlink()
    from tests.handmade import graph_bytes, node

    nothing = graph_bytes([node("x", "Placeholder"), node("y", "Identity", "x")])
    (folder / "strange.bytes").write_bytes(nothing)
    ran = export_model("g", "-o", "out", *PLAIN)
    assert (ran.status, sorted(p.name for p in Path("out").iterdir() if p.is_dir())) == (2, ["good"])
    assert "error: " in ran.err


def test_inspect_shows_the_others(folder: Path) -> None:
    ran = export_model("inspect", "g")
    assert ran.status == 2
    assert "policy good" in ran.out
    assert "cut.bytes" in ran.err
    assert [e["error"] for e in export_model("inspect", "g", "--json").json["refused"]] == ["DamagedFileError"]


def test_where_all_are_damaged_all_are_named(folder: Path) -> None:
    (folder / "good.bytes").write_bytes(b"\x0a\xff")
    ran = export_model("g", "-o", "out", *PLAIN)
    assert ran.status == 2
    assert "cut.bytes" in ran.err
    assert "good.bytes" in ran.err
    assert "the others were" not in ran.err
    assert not [p for p in folder.parent.glob("out/*") if p.is_dir()]


@pytest.mark.parametrize("pattern", ["g/*", "g/*.onnx", "**/*.onnx", "g"])
@pytest.mark.parametrize("content", [b"junkjunk\n", os.urandom(400), b""], ids=["text", "noise", "nothing"])
def test_what_is_called_a_model_and_is_none_is_refused_by_name(pattern: str, content: bytes, folder: Path) -> None:
    (folder / "cut.bytes").unlink()
    (folder / "junk.onnx").write_bytes(content)
    ran = export_model(pattern, "-o", "out", *PLAIN)
    assert ran.status == 2
    assert "junk.onnx" in ran.err
    assert Path("out/good").is_dir() is (pattern in ("g", "g/*"))


def test_what_else_a_pattern_matches_is_named(folder: Path) -> None:
    (folder / "cut.bytes").unlink()
    (folder / "README.md").write_text("# notes\n")
    ran = export_model("g/*", "-o", "out", *PLAIN)
    assert ran.status == 0
    assert "a file that is not a model: g/README.md" in ran.err
    refused = export_model("g/*.md", "-o", "out", *PLAIN)
    assert refused.status == 2
    assert "g/README.md" in refused.err


def test_what_tensorflow_puts_beside_a_model_is_no_source(tmp_path: Path) -> None:
    made = exporting.export_model(fixture("continuous"), tmp_path / "made", to=["saved_model"], verify="none")
    saved = made[0].folder / "saved_model"
    for name in ("fingerprint.pb", "keras_metadata.pb"):
        (saved / name).write_bytes(b"\x08\x01")
    found = sources_in([tmp_path / "made/**/*.pb"], tmp_path / "out")
    assert [p.name for p in found] == ["saved_model.pb"]


def test_a_changed_bundle_does_not_keep_the_others_from_being_verified(tmp_path: Path) -> None:
    for name in ("continuous", "discrete", "visual"):
        exporting.export_model(fixture(name), tmp_path / "out", to=["bytes", "onnx"], verify="none")
    (tmp_path / "out/continuous/continuous.onnx").write_bytes(b"other")
    (tmp_path / "out/visual/parity.json").write_text("{}")
    (tmp_path / "out/visual/policy.json").unlink()
    (tmp_path / "out/.left/").mkdir()
    (tmp_path / "out/.left/parity.json").write_text("{}")
    shutil.copytree(tmp_path / "out/discrete", tmp_path / "out/more/discrete")
    ran = export_model("verify", tmp_path / "out", "--runtimes", "onnxruntime", "--junit", tmp_path / "j.xml")
    assert "also holds folders that are not bundles: more (it holds some)" in ran.err
    assert ran.status == 2
    assert "continuous.onnx" in ran.err
    assert "visual" in ran.err
    assert ran.out.splitlines()[-1].endswith("; 2 REFUSED")
    assert 'name="discrete.onnx"' in (tmp_path / "j.xml").read_text()
    told = export_model("verify", tmp_path / "out", "--runtimes", "onnxruntime", "--json").json
    assert [r["policy"] for r in told["reports"]] == ["discrete"]
    assert len(told["refused"]) == 2
