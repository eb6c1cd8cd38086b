"""The way of a policy that architecture.md names, held against what runs."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import FrameType

import pytest

from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.pipeline import export
from tests.commands import PACKAGE, ROOT

PAGE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")
#: The paragraph: the files in their order, the rooms that they ask, the folders whose own files declare.
WALK = PAGE[PAGE.index("One policy's way") : PAGE.index("## The graph and its passes")]
MOST_FILES = 12
SOURCES = ["gym/Pendulum-v1.onnx", "sb3/sb3_discrete.onnx"]


def named(text: str, ending: str) -> list[str]:
    """The paths of a part of the page, from the top of the repository."""
    found = re.findall(rf"`([\w/]+{ending})`", text)
    return [p if p.startswith(("exporter/", "signatures/")) else f"converters/{p}" for p in found]


FILES = named(WALK.partition("All else")[0], r"\.py")
ROOMS, DECLARING = (tuple(named(part, "/")) for part in WALK.partition("All else")[2].split("in what declares"))


def files_run(source: Path, out: Path) -> list[str]:
    """The modules that a function of is called in while a policy is exported, in their order."""
    found: dict[str, None] = {}

    def note(frame: FrameType, event: str, argument: object) -> None:
        path = frame.f_code.co_filename
        if event == "call" and path.startswith(f"{PACKAGE}/"):
            found[path.removeprefix(f"{PACKAGE}/")] = None

    def run(folder: str) -> None:
        list(export([source], ExportOptions(out=out / folder, targets=["tfjs"], verify="none"), lambda _: None))

    run("imported")  # tables that are made when a module is imported are no step of a policy
    outer = sys.getprofile()
    sys.setprofile(note)
    try:
        run("followed")
    finally:
        sys.setprofile(outer)
    return [f for f in found if f.startswith(("signatures/", "converters/", "exporter/"))]


def is_asked(path: str) -> bool:
    """Whether a file is on the page's list, lies in one of its rooms, or declares."""
    declares = path.startswith("converters/") and path.endswith("/__init__.py")
    return path in FILES or path.startswith(ROOMS) or declares or f"{path.rpartition('/')[0]}/" in DECLARING


@pytest.mark.parametrize("name", SOURCES)
def test_a_reader_meets_what_runs(name: str, tmp_path: Path) -> None:
    run = files_run(ROOT / "fixtures" / name, tmp_path)
    assert [path for path in run if not is_asked(path)] == []
    assert [path for path in FILES if path not in run] == []
    assert len(run) > 60
    begun = [p for p in FILES if p.startswith("converters/") and "/bundle/" not in p]  # whose place is checked before
    assert [path for path in run if path in begun] == begun


def test_the_page_names_few_files() -> None:
    assert len(FILES) == len(set(FILES)) <= MOST_FILES
    assert all((ROOT / path).is_file() for path in FILES)
    assert all((ROOT / room).is_dir() for room in (*ROOMS, *DECLARING))
    assert not is_asked("converters/formats/keras/layers/core.py")
    assert not is_asked("converters/consumers/profiles.py")
