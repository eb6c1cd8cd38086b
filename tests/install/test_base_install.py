"""What ``pip install export-model`` gives, without extras: a fresh environment with the wheel and nothing else."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from export_model.converters.formats.registry import DEFAULTS
from export_model.exporter import __version__
from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path
from tests.commands import PACKAGE, ROOT
from tests.install.conftest import succeeded

# One group: the environment is made once, whatever the number of test processes.
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("install")]

#: The checkout's folders of what is installed below ``export_model``, and the package's own modules.
PLACES = ("exporter", "converters", "signatures", PACKAGE.relative_to(ROOT))
#: Suffixes of what is in the packages beside modules: pages, scripts, schemas, templates of snippets.
DATA = {".css", ".html", ".json", ".mjs", ".mts", ".svg", ".tmpl", ".typed"}
#: The trained policies that come along, for ``export-model demo``.
DEMO = {
    f"export_model/exporter/demo/{name}"
    for name in (
        *("3DBall.bytes", "Hallway.bytes", "GridWorld.bytes", "Tennis.bytes", "3DBall.pt"),
        *("sb3_discrete.onnx", "torch_actor.onnx", "torch_actor.onnx.data"),
    )
}
#: What the packages of a base install may take together, in 10^6 bytes.
LARGEST = 156
COMPILERS = [
    *(["c"] if any(map(shutil.which, ("gcc", "clang"))) else []),
    *(["csharp"] if all(map(shutil.which, ("mcs", "mono"))) else []),
    *(["node"] if shutil.which("node") else []),
]
#: Python's own, in every environment that has pip.
NOT_OURS = {"pip", "setuptools"}


@dataclass(frozen=True)
class Installed:
    """A virtual environment with the base install."""

    home: Path
    packages: Path
    scratch: Path

    @property
    def scripts(self) -> Path:
        return self.home / ("Scripts" if sys.platform == "win32" else "bin")

    def run(self, program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a program of the environment, away from the checkout and with an empty cache."""
        hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV", "EXPORT_MODEL_JS", "COVERAGE_PROCESS_START")
        own = {k: v for k, v in os.environ.items() if k not in hidden}
        # Runtimes that this user has in the cache would be found otherwise.
        cache = {k: str(self.scratch / "cache") for k in ("HOME", "XDG_CACHE_HOME", "LOCALAPPDATA", "USERPROFILE")}
        return subprocess.run(
            [str(self.scripts / program), *arguments],
            cwd=self.scratch,
            env={**own, **cache},
            capture_output=True,
            encoding="utf-8",
        )

    def export(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return self.run("export-model", str(path("continuous")), "-o", "out", *arguments)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installed]:
    home, scratch = tmp_path_factory.mktemp("base") / "venv", tmp_path_factory.mktemp("scratch")
    succeeded([getattr(sys, "_base_executable", sys.executable), "-m", "venv", str(home)])
    python = str(Installed(home, home, scratch).scripts / "python")
    packages = succeeded([python, "-c", "import sysconfig; print(sysconfig.get_paths()['purelib'])"])
    succeeded([python, "-m", "pip", "install", "--quiet", str(wheel)])
    yield Installed(home, Path(packages.strip()), scratch)


# ------------------------------------------------------------------ the wheel


def test_the_wheel_has_the_packages_with_their_data_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = archive.read(next(n for n in names if n.endswith(".dist-info/METADATA"))).decode()
    assert {n.split("/")[0] for n in names} == {"export_model", f"export_model-{__version__}.dist-info"}
    data = {in_wheel(p) for t in PLACES for p in files(t, "*") if p.suffix in DATA}
    ours, theirs = "export_model/exporter", "export_model/converters"
    js, templates = f"{theirs}/runtimes/javascript/js", f"{ours}/snippets/templates"
    assert data >= {f"{js}/package.json", f"{js}/package-lock.json", f"{js}/runner.mjs", f"{js}/browser.mjs"}
    assert data >= {f"{ours}/serve/page/index.html", f"{ours}/reports/parity.schema.json"}
    assert data >= {f"{templates}/agent.cs.tmpl", f"{theirs}/formats/tfjs/js/policy.mjs"}
    assert {n for n in names if Path(n).suffix in DATA} == data
    strays = [
        n
        for n in names
        if "node_modules" in n or "__pycache__" in n or "/test" in n or (n.endswith(".bytes") and n not in DEMO)
    ]
    assert not strays
    with zipfile.ZipFile(wheel) as archive:
        assert sum(archive.getinfo(name).compress_size for name in DEMO) <= 80_000
    code = {in_wheel(p) for t in PLACES for p in files(t, "*.py")}
    assert {n for n in names if n.endswith(".py")} == code
    required = [line for line in metadata.splitlines() if line.startswith("Requires-Dist:") and "extra ==" not in line]
    names_required = sorted(re.split(r"[<>=!~;]", line.split()[1])[0] for line in required)
    assert names_required == ["click", "msgspec", "numpy", "onnx", "protobuf"]
    assert any(n.endswith("/licenses/LICENSE") for n in names)
    shown = metadata.partition("\n\n")[2]
    targets = re.findall(r"\]\(([^)]+)\)", shown)
    assert len(targets) == len(re.findall(r"\]\(([^)]+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))) > 10
    assert [t for t in targets if not t.startswith(("https://", "#"))] == []  # a page elsewhere has no files beside it
    assert "/raw/HEAD/docs/pictures/" in shown and "<!-- test" not in shown
    assert len(re.findall(r"^Project-URL: ", metadata, re.MULTILINE)) == 5


def in_wheel(file: Path) -> str:
    """Where a file of the checkout lies in the wheel."""
    return f"export_model/{file.relative_to(PACKAGE if file.is_relative_to(PACKAGE) else ROOT).as_posix()}"


def files(place: Path | str, pattern: str) -> Iterator[Path]:
    return (p for p in (ROOT / place).rglob(pattern) if "node_modules" not in p.parts)


# ------------------------------------------------------------------ the environment


def on_disk(file: Path) -> int:
    """What ``du`` counts: whole blocks, where the system tells them."""
    status = file.stat()
    return int(getattr(status, "st_blocks", 0)) * 512 or status.st_size


def test_it_is_small(installed: Installed) -> None:
    sizes: dict[str, int] = {}
    for file in installed.packages.rglob("*"):
        if file.is_file() and not file.is_symlink():
            top = file.relative_to(installed.packages).parts[0]
            sizes[top] = sizes.get(top, 0) + on_disk(file)
    total = sum(sizes.values()) / 1e6
    without = sum(size for top, size in sizes.items() if top.split("-")[0] not in NOT_OURS) / 1e6
    largest = ", ".join(f"{top} {size / 1e6:.1f}" for top, size in sorted(sizes.items(), key=lambda e: -e[1])[:6])
    print(f"\nbase install: {total:.1f} MB in site-packages, {without:.1f} MB without pip ({largest})")
    assert total < LARGEST


def test_its_requirements_fit_together(installed: Installed) -> None:
    done = installed.run("python", "-m", "pip", "check")
    assert done.returncode == 0, done.stdout


def test_four_formats_are_written(installed: Installed) -> None:
    done = installed.export("--verify", "none", "--json")
    assert done.returncode == 0, done.stderr
    (result,) = json.loads(done.stdout)["policies"]
    assert set(result["sizes"]) == set(DEFAULTS)
    folder = installed.scratch / "out" / "continuous"
    for file in ("continuous.bytes", "continuous.onnx", "saved_model/saved_model.pb", "tfjs/model.json"):
        assert (folder / file).stat().st_size


def test_it_writes_the_same_bytes_as_this_checkout(installed: Installed, tmp_path: Path) -> None:
    tell = "import importlib.metadata as m; print(*map(m.version, ['numpy', 'onnx', 'protobuf']))"
    there, here = installed.run("python", "-c", tell).stdout, succeeded([sys.executable, "-c", tell])
    if there != here:
        pytest.skip(f"numpy, onnx and protobuf are {there.strip()} there and {here.strip()} here")
    assert installed.export("--verify", "none").returncode == 0
    (ours,) = export([path("continuous")], ExportOptions(tmp_path, verify="none"))
    theirs = installed.scratch / "out" / "continuous"
    for file in (p for p in ours.folder.rglob("*") if p.is_file()):
        name = file.relative_to(ours.folder)
        assert (theirs / name).read_bytes() == file.read_bytes(), name


def test_the_runtimes_are_listed_with_what_installs_them(installed: Installed) -> None:
    done = installed.run("export-model", "runtimes", "--json")
    assert done.returncode == 0, done.stderr
    found = {r["name"]: r for r in json.loads(done.stdout)["runtimes"]}
    assert [name for name, r in found.items() if r["installed"]] == ["numpy", *COMPILERS]
    assert "export-model[tensorflow]" in found["tensorflow"]["install"]
    assert "export-model[onnxruntime]" in found["onnxruntime"]["install"]
    assert "export-model runtimes install tfjs" in found["tfjs-cpu"]["install"]
    table = installed.run("export-model", "runtimes")
    assert table.returncode == 0
    assert "pip install 'export-model[tensorflow]'" in table.stdout


def test_full_verification_is_refused(installed: Installed) -> None:
    before = sorted(installed.scratch.rglob("*"))
    done = installed.run("export-model", str(path("discrete")), "-o", "out", "--verify", "full")
    assert done.returncode == 3
    assert "is not installed" in done.stderr
    assert "pip install" in done.stderr
    assert sorted(installed.scratch.rglob("*")) == before


def test_what_can_be_verified_alone_is_called_not_verified(installed: Installed) -> None:
    done = installed.export("--verify", "auto")
    assert done.returncode == 0, done.stderr
    assert "NOT VERIFIED" in done.stdout
    assert "pip install" in done.stdout


def test_the_demo_has_everything_with_it(installed: Installed) -> None:
    done = installed.run("export-model", "demo", "--no-open")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("$ export-model demo/3DBall.bytes -o demo --html demo/parity.html\n")
    *_, verdict, note, step = done.stdout.splitlines()
    assert verdict == "NOT VERIFIED: no independent runtime ran"
    assert note.startswith("note: Unity")
    assert step.startswith("next: pip install 'export-model[onnxruntime]'")
    assert {"3DBall", "3DBall.bytes", "parity.html"} == {p.name for p in (installed.scratch / "demo").iterdir()}


def test_a_module_starts_it_too(installed: Installed) -> None:
    done = installed.run("python", "-m", "export_model", "--version")
    assert (done.returncode, done.stdout.splitlines()[0].split()[-1]) == (0, __version__)


# ------------------------------------------------------------------ types

PROGRAM = """
from pathlib import Path
import numpy as np
import export_model

names: list[str] = [p.policy.name for p in export_model.inspect("3DBall.bytes").policies]
read = export_model.ReadOptions(brain="Ball", inputs={"epsilon": "noise"})
verify = export_model.VerifyOptions(runtimes=["onnxruntime"], samples=1)
(result,) = export_model.export(Path("3DBall.bytes"), "out", to="onnx,bytes", read=read, verify=verify, strict=False)
passed: bool | None = export_model.verify(result.folder, verify="numpy").passed
shape: tuple[int, ...] = export_model.load("out/3DBall").decide(np.zeros(8)).action.shape
fault: type[export_model.ExportModelError] = export_model.ParityError
reveal_type(export_model.compare("3DBall.bytes", "theirs.onnx"))
reveal_type(result.sizes)
export_model.export("3DBall.bytes", write=export_model.WriteOptions(opset="15"))
"""


def test_the_public_module_is_found_and_shows_its_names_alone(installed: Installed) -> None:
    say = "import sys, export_model; print(*dir(export_model)); print({'numpy', 'click', 'onnx'} & {*sys.modules})"
    done = installed.run("python", "-c", say)
    assert done.returncode == 0, done.stderr
    names, heavy = done.stdout.splitlines()
    assert {"export", "load", "inspect", "verify", "compare", "ReadOptions"} <= set(names.split())
    assert len(names.split()) <= 30
    assert heavy == "set()"


def test_a_program_that_uses_it_is_checked_by_mypy(installed: Installed) -> None:
    """The wheel's own types: what is right passes strictly, what is wrong is found."""
    (installed.scratch / "program.py").write_text(PROGRAM)
    python = str(installed.scripts / "python")
    mypy = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--python-executable",
        python,
        "--cache-dir",
        "mypy",
        "program.py",
    ]
    hidden = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MYPYPATH")}
    done = subprocess.run(mypy, cwd=installed.scratch, env=hidden, capture_output=True, encoding="utf-8", check=False)
    errors = [line for line in done.stdout.splitlines() if "error:" in line]
    assert len(errors) == 1, done.stdout
    assert "program.py:15" in errors[0] and "opset" in errors[0]
    assert "ParityReport" in done.stdout
    assert "Mapping[str, int]" in done.stdout
