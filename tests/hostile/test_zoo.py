"""A stranger's file can do nothing but be converted: every case under every command that takes it."""

from __future__ import annotations

import contextlib
import resource
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from export_model.converters.runtimes.pool import RuntimePool
from tests.commands import Ran, export_model
from tests.handmade import continuous_policy, graph_bytes
from tests.hostile.zoo import CASES

pytestmark = [pytest.mark.xdist_group("hostile")]
#: Seconds of computing, and bytes of memory over the file's size.
SECONDS, MEMORY = 20.0, 1 << 30


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of a policy like those of the zoo, and its source."""
    folder = tmp_path_factory.mktemp("good")
    (folder / "policy.bytes").write_bytes(graph_bytes(continuous_policy()))
    assert export_model(folder / "policy.bytes", "-o", folder, "--verify", "none").status == 0
    return folder


@pytest.fixture
def runtimes(pool: RuntimePool, monkeypatch: pytest.MonkeyPatch) -> RuntimePool:
    for module in (
        "export_model.exporter.export.again",
        "export_model.exporter.compare.comparison",
        "export_model.converters.runtimes.pool",
    ):
        monkeypatch.setattr(f"{module}.RuntimePool", lambda: contextlib.nullcontext(pool))
    return pool


def commands(kind: str, given: Path, good: Path, out: Path) -> Iterator[tuple[str, ...]]:
    """The commands that take a case."""
    every = ("--verify", "tensorflow,onnxruntime,tfjs-cpu")
    runtimes = ("--runtimes", "tensorflow,onnxruntime,tfjs-cpu")
    if kind == "source":
        yield "inspect", str(given)
        yield str(given), "-o", str(out / "none"), "--verify", "none"
        yield str(given), "-o", str(out / "all"), *every
        yield "compare", str(given), str(good / "policy"), *runtimes
    elif kind == "candidate":
        yield "compare", str(good / "policy.bytes"), str(given), *runtimes
    else:
        yield "inspect", str(given)
        yield "verify", str(given), *runtimes
        yield "compare", str(good / "policy.bytes"), str(given), *runtimes
        yield "snippets", str(given)
        yield "serve", str(given), "-o", str(out / "site")
        yield str(given), "-o", str(out / "again"), "--verify", "none"


def files(folder: Path) -> dict[str, bytes | None]:
    """What lies in a folder, contents too where it is a file."""
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() and not p.is_symlink() else None
        for p in sorted(folder.rglob("*"))
    }


@pytest.mark.parametrize("name", CASES)
def test_it_is_refused_or_harmless(name: str, tmp_path: Path, good: Path, runtimes: RuntimePool) -> None:
    case = CASES[name]
    folder, out, marker = tmp_path / "given", tmp_path / "out", tmp_path / "marker"
    if case.kind == "bundle":
        shutil.copytree(good / "policy", folder)
    else:
        folder.mkdir()
    given = case.make(folder, marker)
    before = files(folder)
    size = sum(len(data or b"") for data in before.values())
    for command in commands(case.kind, given, good, out):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        begun = time.process_time()
        ran = export_model(*command)
        assert not [p for p in tmp_path.iterdir() if p.name.startswith("marker")], f"{command} ran what the file says"
        assert time.process_time() - begun < SECONDS
        assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) << 10 < MEMORY + size
        clean(ran)
        assert files(folder) == before, command
        assert {p.name for p in tmp_path.iterdir()} <= {"given", "out"}


def clean(ran: Ran) -> None:
    """A status of the table, and no traceback; an error says what to do."""
    assert ran.status in (0, 1, 2, 3)
    assert "Traceback" not in ran.err + ran.out
    assert "did not expect" not in ran.err
    if ran.status == 2:
        assert ran.err.strip()
