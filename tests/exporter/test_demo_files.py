"""``export-model demo --files``: what the pages of the documentation begin with."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from exporter.demo.files import FILES
from tests.commands import export_model, files_in, is_refused


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_each_file_is_a_policy_that_is_read(there: Path) -> None:
    ran = export_model("demo", "--files")
    assert (ran.status, ran.err) == (0, "")
    assert [line.split()[0] for line in ran.out.splitlines()] == [*FILES, "next:"]
    assert {f for f in files_in(there) if (there / f).is_file()} == set(FILES)
    kinds = {}
    for name in FILES:
        (policy,) = export_model("inspect", name, "--json").json["policies"]
        kinds[name] = policy["name"], bool(policy["memory"])
    assert [kinds[name][0] for name in FILES] == ["3DBall", "3DBall", "3DBall", "Hallway", "3DBall", "Hallway"]
    assert [name for name, (_, memory) in kinds.items() if memory] == [n for n in FILES if "Hallway" in n]
    names = [p["name"] for p in export_model("inspect", "results/first_run", "--json").json["policies"]]
    assert names == ["3DBall", "Hallway"]


def test_it_may_be_run_again_and_overwrites_nothing_else(there: Path) -> None:
    assert export_model("demo", "--files").status == export_model("demo", "--files").status == 0
    (there / "3DBall.nn").write_text("mine")
    (there / "3DBall.bytes").unlink()
    is_refused(export_model("demo", "--files"), "3DBall.nn is another file", "-o names another folder")
    assert (there / "3DBall.nn").read_text() == "mine"
    assert not (there / "3DBall.bytes").exists()  # refused before anything is written
    assert export_model("demo", "--files", "-o", "new").status == 0
    assert {f for f in files_in(there / "new") if (there / "new" / f).is_file()} == set(FILES)


@pytest.mark.skipif(os.name != "posix", reason="links are POSIX's")
@pytest.mark.parametrize("name", ["3DBall.bytes", "results", "results/first_run"])
def test_no_link_is_written_through(name: str, there: Path) -> None:
    kept = there / "kept"
    (there / "out" / name).parent.mkdir(parents=True)
    (there / "out" / name).symlink_to(kept)
    kept.write_text("kept") if name.endswith(".bytes") else kept.mkdir()
    is_refused(export_model("demo", "--files", "-o", "out"), "is another file")
    assert kept.read_text() == "kept" if kept.is_file() else not list(kept.iterdir())
