"""A stranger's folder may already hold the one that is written to: links, pipes and devices under the names of ours."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from export_model.converters.formats.tensorboard import FILE_NAME
from export_model.exporter.fleet import ledger
from fixtures import path as fixture
from tests.commands import export_model

pytestmark = pytest.mark.skipif(os.name != "posix", reason="links, pipes and devices are POSIX's")
SOURCES = (fixture("continuous"), fixture("sampled"))
ODD = {
    "link": lambda place, kept: place.symlink_to(kept),
    "pipe": lambda place, kept: os.mkfifo(place),
    "device": lambda place, kept: place.symlink_to("/dev/zero"),
}


def listed(folder: Path) -> Path:
    """Several sources are noted in a file of the folder that they are written to."""
    (folder / "list.txt").write_text("\n".join(map(str, SOURCES)))
    return folder / "list.txt"


@pytest.mark.parametrize("kind", ODD)
@pytest.mark.parametrize("name", [".exported.jsonl", "continuous", "3DBall.bytes", "parity.html"])
def test_nothing_is_written_through_it(kind: str, name: str, tmp_path: Path) -> None:
    kept, out = tmp_path / "kept", tmp_path / "out"
    kept.write_text("kept")
    out.mkdir()
    ODD[kind](out / name, kept)
    demo = name in ("3DBall.bytes", "parity.html")
    command = ("demo", "--no-open") if demo else (listed(tmp_path), "--to", "bytes", "--verify", "none")
    ran = export_model(*command, "-o", out)
    assert ran.status == 2
    assert "Traceback" not in ran.err
    assert kept.read_text() == "kept"


@pytest.mark.parametrize("linked", ["continuous", f"continuous/{FILE_NAME}"])
def test_a_graph_for_tensorboard_is_not_written_through_a_link(linked: str, tmp_path: Path) -> None:
    kept, logs = tmp_path / "kept", tmp_path / "logs"
    place = logs / linked
    place.parent.mkdir(parents=True)
    if linked.endswith(FILE_NAME):
        kept.write_text("kept")
    else:
        kept.mkdir()
    place.symlink_to(kept)
    ran = export_model("inspect", fixture("continuous"), "--logdir", logs)
    assert ran.status == 2
    assert f"{place}: is a link" in ran.err
    assert kept.read_text() == "kept" if kept.is_file() else not list(kept.iterdir())


@pytest.mark.parametrize("files", [{"/dev/zero": [0, 0, "-"]}, {"pipe": [0, 0, "-"]}])
def test_a_ledger_names_no_device(files: dict[str, object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that a stranger wrote: what it names is read again where its time is another."""
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("out").mkdir()
    monkeypatch.setattr(ledger, "_key", lambda options, runtimes: "guessed")
    lines = [
        {"source": str(p), "options": "guessed", "seen": None, "files": files, "policies": {p.stem: "-"}}
        for p in SOURCES
    ]
    Path("out", ".exported.jsonl").write_text("\n".join(map(json.dumps, lines)))
    Path("out/continuous").mkdir()
    os.mkfifo("out/continuous/policy.json")
    ran = export_model(listed(tmp_path), "-o", "out", "--to", "bytes", "--verify", "none")
    assert ran.status == 2
    assert "continuous: already exists" in ran.err
    assert Path("out/sampled/policy.json").is_file()
