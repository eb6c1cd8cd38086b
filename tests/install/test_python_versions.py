"""The Pythons that pyproject.toml promises are those that CI checks."""

from __future__ import annotations

import re
import tomllib

from tests.commands import ROOT


def test_ci_checks_every_python_that_is_promised() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    promised = [c.rpartition(" ")[2] for c in project["classifiers"] if re.search(r":: 3\.\d+$", c)]
    workflow = (ROOT / ".github" / "workflows" / "test.yml").read_text()
    (matrix,) = re.findall(r"matrix: \{ python: \[(.*)\] \}", workflow)
    assert re.findall(r'"([^"]+)"', matrix) == promised
    assert len(promised) > 1
    assert "make check PYTHON=python" in workflow
    tested, most = f"Python {promised[0]} to {promised[-1]}", project["requires-python"].partition("<")[2]
    assert f"You need {tested}" in (ROOT / "CONTRIBUTING.md").read_text()
    newest = f"3.{int(most.removeprefix('3.')) - 1}"
    assert f"{tested} with `venv`" in (readme := (ROOT / "README.md").read_text())
    assert newest == promised[-1] or f"pip installs it on {newest}, too" in readme
