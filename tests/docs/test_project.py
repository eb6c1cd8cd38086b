"""What pyproject.toml says of the project: authors, groups, versions and addresses, each from one place."""

from __future__ import annotations

import re
import runpy
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest

from tests.commands import ROOT
from tests.docs.blocks import blocks, name_of, pages

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
#: Words that somebody would have to replace before a line does what it says.
PLACEHOLDER = re.compile(r"\b(?:OWNER|YOUR[_A-Z]*|TODO|FIXME)\b|<[a-z-]+>")


def test_what_tests_and_documentation_need_is_no_part_of_the_package() -> None:
    groups = PROJECT["dependency-groups"]
    assert {"dev", "docs"} == set(groups)
    assert set(groups).isdisjoint(PROJECT["project"]["optional-dependencies"])


def test_make_install_takes_the_groups_by_any_pip_of_python_3_11(tmp_path: Path) -> None:
    """``pip install --group`` is younger than the pip of Python 3.11, so the Makefile writes them out."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (program,) = re.findall(r'\$\(BIN\)/python -c "(.*)" > \$\(VENV\)/groups.txt', makefile)
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [n for group in PROJECT["dependency-groups"].values() for n in group]
    (tmp_path / "groups.txt").write_text(done.stdout)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--no-index", "--dry-run"]
    subprocess.run([*pip, "--requirement", str(tmp_path / "groups.txt")], capture_output=True, check=True)


def test_the_authors_are_those_of_the_citation() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert [a["name"] for a in PROJECT["project"]["authors"]] == re.findall(
        r'^  - name: "(.*)"$', citation, re.MULTILINE
    )


def test_the_versions_of_python_and_the_system_are_those_that_ci_runs() -> None:
    """No classifier says more than was tested: no 'OS Independent', no version that no job has."""
    jobs = (ROOT / ".github/workflows/test.yml").read_text(encoding="utf-8")
    (matrix,) = re.findall(r"python: \[(.*)\]", jobs)
    classifiers = PROJECT["project"]["classifiers"]
    said = [c.rpartition(" :: ")[2] for c in classifiers if c.startswith("Programming Language :: Python ::")]
    assert said == re.findall(r"[\d.]+", matrix)
    assert [c for c in classifiers if c.startswith("Operating System")] == ["Operating System :: POSIX :: Linux"]


def test_every_address_of_the_project_follows_from_one(monkeypatch: pytest.MonkeyPatch) -> None:
    class Interface:
        """What hatchling gives a hook: the folder and the hook's own table."""

        def __init__(self, root: str, config: dict[str, str]) -> None:
            self.root, self.config = root, config

    stub = types.ModuleType("hatchling.metadata.plugin.interface")
    monkeypatch.setattr(stub, "MetadataHookInterface", Interface, raising=False)
    for name in ("hatchling", "hatchling.metadata", "hatchling.metadata.plugin", stub.__name__):
        monkeypatch.setitem(sys.modules, name, stub)
    hook = runpy.run_path(str(ROOT / ".ci/metadata.py"))["CustomMetadataHook"]
    repository = PROJECT["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
    found: dict[str, dict[str, str]] = {}
    hook(str(ROOT), {"repository": repository}).update(found)
    assert found["urls"]["Homepage"] == repository
    assert all(address.startswith(repository) for address in found["urls"].values())


@pytest.mark.parametrize("page", pages(), ids=name_of)
def test_no_line_has_to_be_filled_in_before_it_is_pasted(page: Path) -> None:
    lines = [(b.where, line) for b in blocks(page) if b.language == "sh" for line in b.text.splitlines()]
    assert not [f"{where}: {line}" for where, line in lines if PLACEHOLDER.search(line)]


def test_there_is_what_a_contributor_looks_for() -> None:
    for name in ("pull_request_template.md", "CODE_OF_CONDUCT.md", "ISSUE_TEMPLATE/policy.yml"):
        assert (ROOT / ".github" / name).stat().st_size > 200
