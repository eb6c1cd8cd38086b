"""The top level of the repository is fixed: what a test or a tool left there is not committed."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from tests.commands import ROOT

FOLDERS = {".ci", ".github", "converters", "docs", "exporter", "fixtures", "signatures", "tests"}
FILES = {
    *(".gitignore", ".pre-commit-hooks.yaml", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE"),
    *("Makefile", "README.md", "SECURITY.md", "action.yml", "constraints.txt", "pyproject.toml"),
}


def test_nothing_else_is_committed_at_the_top() -> None:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("this is no checkout of git: what is committed is not known")
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, encoding="utf-8", check=True).stdout
    assert {line.split("/")[0] for line in tracked.splitlines()} == FOLDERS | FILES
