"""A format with lowerings and two runtimes: how little of the house outside its own rooms names it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from tests.commands import ROOT

NAMES = re.compile(r"litert|tflite|openvino", re.IGNORECASE)
#: Where it is at home: its room, its runtimes' folders, the entries of the ops.
AT_HOME = (
    "converters/formats/litert/",
    "converters/runtimes/litert/",
    "converters/runtimes/openvino/",
    "converters/graph/ops/",
    "converters/consumers/robots/",  # PX4 is built with such a file, and asks what its operators are
)
#: Written by npm, and by the program that lists what npm installed.
WRITTEN_BY_TOOLS = ("package-lock.json", "installed.json")
CODE = {".py", ".mjs", ".js", ".json", ".toml", ".html", ".tmpl"}
#: What issue 22 allows: a registry's line each, an extra, an option's text, a page that loads LiteRT.js.
MOST = 60


def elsewhere(root: Path) -> Iterator[tuple[str, int]]:
    """(file, line) of every line of the product outside of its rooms that names LiteRT or OpenVINO."""
    files = [root / "Makefile", root / "pyproject.toml"]
    files += [p for room in ("signatures", "converters", "exporter") for p in sorted((root / room).rglob("*"))]
    for path in files:
        name = path.relative_to(root).as_posix()
        if name.startswith(AT_HOME) or "node_modules" in name or path.name in WRITTEN_BY_TOOLS:
            continue
        if path.is_file() and (path.suffix in CODE or path.name == "Makefile"):
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                if NAMES.search(line):
                    yield name, number


def test_few_lines_outside_its_rooms_name_it() -> None:
    found = list(elsewhere(ROOT))
    assert {"converters/formats/registry.py", "converters/runtimes/registry.py"} <= {name for name, _ in found}
    assert len(found) <= MOST, found


def test_a_line_elsewhere_would_be_found(tmp_path: Path) -> None:
    for name in (*(f"{home}a.py" for home in AT_HOME), "exporter/a.py", "exporter/package-lock.json", "Makefile"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x = 1\ny = 'tflite'\n")
    (tmp_path / "pyproject.toml").write_text("")
    assert list(elsewhere(tmp_path)) == [("Makefile", 2), ("exporter/a.py", 2)]
