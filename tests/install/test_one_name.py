"""Nothing is installed and imported but ``export_model``, whoever else has packages of our folders' names."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from fixtures import path
from tests.commands import PACKAGE, ROOT, python
from tests.install.conftest import succeeded

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("install")]

FOLDERS = ("exporter", "converters", "signatures")
#: What another's package of such a name says when it is imported.
THEIRS = "raise ImportError('somebody else was imported')\n"
PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"
[project]
name = "{name}"
version = "1"
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Python that finds this environment's dependencies behind its own packages, three of which have our names."""
    home, sources = tmp_path_factory.mktemp("environment"), tmp_path_factory.mktemp("sources")
    succeeded([getattr(sys, "_base_executable", sys.executable), "-m", "venv", str(home)])
    ask = "import sysconfig; print(sysconfig.get_path('purelib'))"
    installed = Path(succeeded([str(home / "bin/python"), "-c", ask]).strip())
    # The .pth files of a folder that a .pth file names are not read, so the checkout stays out.
    numpy = "import numpy, pathlib; print(pathlib.Path(numpy.__file__).parents[1])"
    (installed / "dependencies.pth").write_text(succeeded([sys.executable, "-c", numpy]))
    for name in FOLDERS:
        package = sources / name / name
        package.mkdir(parents=True)
        (package / "__init__.py").write_text(THEIRS)
        (package.parent / "pyproject.toml").write_text(PROJECT.format(name=name))
    succeeded([*pip(home), "install", "--quiet", *(str(sources / name) for name in FOLDERS)])
    return home


def pip(home: Path) -> list[str]:
    return [str(home / "bin/python"), "-m", "pip"]


def run(home: Path, folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "COVERAGE_PROCESS_START")
    own = {k: v for k, v in os.environ.items() if k not in hidden}
    program = [str(home / "bin" / command[0]), *command[1:]]
    return subprocess.run(program, cwd=folder, env=own, capture_output=True, encoding="utf-8", check=False)


def works(home: Path, folder: Path) -> None:
    """Export and compare in a child process, in a folder that has packages of the three names as well."""
    for name in FOLDERS:
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(THEIRS)
    source = str(path("continuous"))
    for program in (("export-model",), ("python", "-m", "export_model")):
        done = run(home, folder, *program, source, "-o", program[0], "--to", "onnx", "--verify", "onnxruntime")
        assert (done.returncode, "PASSED" in done.stdout) == (0, True), done.stdout + done.stderr
    done = run(home, folder, "python", "-c", f"import export_model; print(export_model.inspect({source!r}).policies)")
    assert done.returncode == 0, done.stderr


def test_it_works_beside_packages_of_our_names_and_leaves_them_whole(
    environment: Path, wheel: Path, tmp_path: Path
) -> None:
    theirs = {p: p.read_bytes() for p in environment.rglob("*") if p.is_file() and p.parent.name in FOLDERS}
    assert {p.parent.name for p in theirs} == set(FOLDERS)
    succeeded([*pip(environment), "install", "--quiet", "--no-deps", str(wheel)])
    works(environment, tmp_path)
    succeeded([*pip(environment), "uninstall", "--quiet", "--yes", "export-model"])
    assert {p: p.read_bytes() for p in theirs} == theirs
    assert not [*environment.rglob("export_model*")]


def test_it_works_in_place(environment: Path, tmp_path: Path) -> None:
    succeeded([*pip(environment), "install", "--quiet", "--no-deps", "--editable", str(ROOT)])
    works(environment, tmp_path)
    done = run(environment, tmp_path, "python", "-P", "-c", "import export_model; print(export_model.__file__)")
    assert done.stdout.strip() == str(PACKAGE / "__init__.py")
    succeeded([*pip(environment), "uninstall", "--quiet", "--yes", "export-model"])


def test_the_sdist_makes_the_same_wheel(environment: Path, wheel: Path, tmp_path: Path) -> None:
    succeeded([*pip(environment), "install", "--quiet", "hatchling"])
    python = str(environment / "bin/python")
    succeeded([python, "-m", "hatchling", "build", "--target", "sdist", "--directory", str(tmp_path)], cwd=ROOT)
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        assert not [member.name for member in archive if not member.isfile()], "a link leads nowhere on Windows"
    succeeded([*pip(environment), "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(sdist)])
    (made,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(made) as one, zipfile.ZipFile(wheel) as other:
        assert {i.filename: i.CRC for i in one.infolist()} == {i.filename: i.CRC for i in other.infolist()}


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_is_no_second_name(name: str) -> None:
    """With the top of the checkout on the path, as ``python -m pytest`` has it."""
    said = python("-c", f"import sys; sys.path.insert(0, {str(ROOT)!r}); import {name}").err
    assert f"ImportError: import it as export_model.{name}" in said
