"""What patterns, folders and lists stand for."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from export_model.converters.formats.source import ReadOptions
from export_model.exporter.fleet.sources import PassedOver, is_many, sources_in
from export_model.signatures.errors import ExportModelError
from fixtures import path as fixture
from tests.commands import ROOT


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Models in folders, one of them called as nothing, beside what is no model; and a run's folder."""
    for target in ("runs/a/one.bytes", "runs/a/two.bytes", "runs/b/model.weights"):
        (tmp_path / target).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(fixture("continuous"), tmp_path / target)
    (tmp_path / "runs/b/notes.md").write_text("# what we tried\n")
    (tmp_path / "runs/.cache").mkdir()
    shutil.copy(fixture("continuous"), tmp_path / "runs/.cache/policy.bytes")
    shutil.copytree(ROOT / "fixtures/trained/3DBall", tmp_path / "runs/ball/3DBall")
    monkeypatch.chdir(tmp_path)
    return tmp_path


FLAT = ["runs/a/one.bytes", "runs/a/two.bytes", "runs/b/model.weights"]


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("runs", [*FLAT, "runs/ball"]),
        ("runs/**/*.bytes", [*FLAT[:2]]),
        ("runs/*", [*FLAT, "runs/ball"]),
        ("runs/[ab]/*", FLAT),
    ],
)
def test_a_folder_and_a_pattern_stand_for_the_models_in_them(given: str, found: list[str], place: Path) -> None:
    assert is_many([Path(given)])
    assert sorted(map(str, sources_in([Path(given)], Path("out")))) == sorted(found)


def test_a_list_has_a_path_a_line(place: Path) -> None:
    (place / "more.txt").write_text("# the good ones\nruns/b\n\nruns/a/one.bytes  \nruns/a/one.bytes\n")
    assert is_many([Path("more.txt")])
    assert [str(p) for p in sources_in([Path("more.txt")], Path("out"))] == [FLAT[2], FLAT[0]]


def test_what_was_written_before_is_no_source(place: Path) -> None:
    shutil.copytree(place / "runs/a", place / "runs/out")
    for given in ("runs", "runs/**/*.bytes"):
        assert not [p for p in sources_in([Path(given)], Path("runs/out")) if "out" in p.parts]


def test_a_file_and_a_run_are_one_source(place: Path) -> None:
    assert not is_many([Path(FLAT[0]), Path("runs/ball"), Path("gone.onnx")])
    assert sources_in([Path("gone.onnx")], Path("out")) == [Path("gone.onnx")]  # which its reader refuses


def test_files_in_a_folder_are_one_source_each(place: Path) -> None:
    """And so are those in its folders; a second form of one is named, not exported."""
    shutil.copytree(place / "runs/b", place / "runs/a/deeper")
    shutil.copy(fixture("continuous"), place / "runs/a/two.pb")
    assert is_many([Path("runs/a")])
    passed_over = PassedOver()
    found = sources_in([Path("runs/a")], Path("out"), passed_over)
    assert found == [Path("runs/a/one.bytes"), Path("runs/a/two.bytes"), Path("runs/a/deeper/model.weights")]
    assert passed_over == PassedOver([], [Path("runs/a/two.pb")])


def test_a_run_with_a_folder_for_each_behavior_is_one_source(place: Path) -> None:
    """Its final exports lie beside the folders (ML-Agents 0.6 and later)."""
    shutil.copytree(place / "runs/ball/3DBall", place / "runs/a/one")
    assert not is_many([Path("runs/a")])
    assert sources_in([Path("runs/a")], Path("out")) == [Path("runs/a")]


def test_a_folder_of_which_a_step_is_asked_is_one_source(place: Path) -> None:
    assert not is_many([Path("runs/a")], ReadOptions(step=5))
    assert sources_in([Path("runs/a")], Path("out"), read=ReadOptions(step=5)) == [Path("runs/a")]


@pytest.mark.parametrize(("given", "words"), [("*.onnx", "matches no model"), ("empty", "no model found in")])
def test_what_stands_for_nothing_is_refused(given: str, words: str, place: Path) -> None:
    (place / "empty").mkdir()
    with pytest.raises(ExportModelError, match=words):
        sources_in([Path(given)], Path("out"))


def test_a_txt_is_a_list_by_its_content(place: Path) -> None:
    """A model under that name is a model, and prose, requirements or names of classes are no list."""
    shutil.copy(fixture("continuous"), place / "model.txt")
    (place / "notes.txt").write_text("We trained it twice.\nThe second run was better, see below.\n")
    (place / "requirements.txt").write_text("numpy==2.1\ntorch>=2.0\n")
    (place / "classes.txt").write_text("left\nright\n")
    (place / "graph.txt").write_text('node {\n  name: "state"\n  op: "Placeholder"\n}\n')
    for name in ("model.txt", "notes.txt", "requirements.txt", "classes.txt", "graph.txt"):
        assert not is_many([Path(name)])
        assert sources_in([Path(name)], Path("out")) == [Path(name)]  # which its reader takes or refuses
    for text in (
        f"{FLAT[0]}\nsome words\n",
        "runs/*\n",
        "gone.onnx\nruns/gone\n",
        "https://x.invalid/a.onnx\n",
        "# none\n",
    ):
        (place / "more.txt").write_text(text)
        assert is_many([Path("more.txt")]), text


def test_a_list_may_name_a_model_that_is_called_txt(place: Path) -> None:
    shutil.copy(fixture("continuous"), place / "model.txt")
    (place / "more.txt").write_text("model.txt\n")
    assert sources_in([Path("more.txt")], Path("out")) == [Path("model.txt")]
    (place / "more.txt").write_text("more.txt\n")
    with pytest.raises(ExportModelError, match="names another list"):
        sources_in([Path("more.txt")], Path("out"))


@pytest.mark.parametrize("given", [".", "m*.bytes", "**/*.bytes"])
def test_numbers_are_in_their_order(given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ["m1.bytes", "m2.bytes", "m10.bytes", "m10a.bytes"]
    for name in reversed(names):
        shutil.copy(fixture("continuous"), tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert [p.name for p in sources_in([Path(given)], tmp_path / "out")] == names
