"""C that a compiler makes vectors of: whatever its usual flags, the same numbers, and no loop over a row is scalar."""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from export_model.converters.formats.programs.members import header_of
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.code import CodeOptions
from fixtures import path
from tests.bench.robot_networks import NETWORKS

pytestmark = pytest.mark.xdist_group("programs")

FLAGS = ("-O0", "-O2", "-O3", "-Os", "-O2 -ffast-math")
_MAIN = """
#define {upper}_IMPLEMENTATION
#define {upper}_SELFTEST
#include "{name}.h"
static {p}_memory memory;
int main(void) {{ return {p}_selftest(&memory); }}
"""


def _written(source: Path, out: Path, code: CodeOptions | None = None) -> tuple[Path, str]:
    """The header of a policy, with a program beside it; its prefix."""
    (result,) = export([source], ExportOptions(out, ("c",), verify="none", code=code or CodeOptions()))
    name = result.policy.name
    p = header_of(name, result.policy.signature).prefix
    (result.folder / "main.c").write_text(_MAIN.format(p=p, upper=p.upper(), name=name))
    return result.folder / f"{name}.h", p


def _saved(name: str, folder: Path) -> Path:
    model = folder / f"{name}.onnx"
    next(n for n in NETWORKS if n.name == name).save(model)
    return model


@pytest.mark.parametrize("compiler", ["gcc", "clang"])
@pytest.mark.parametrize("name", ["tanh64", "history"])
def test_golden_numbers_hold_with_usual_flags(name: str, compiler: str, tmp_path: Path) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    header, _ = _written(_saved(name, tmp_path), tmp_path / "out")
    for flags in FLAGS:
        command = [compiler, "-std=c99", *flags.split(), "-o", "main", "main.c", "-lm"]
        subprocess.run(command, check=True, cwd=header.parent)
        assert subprocess.run([str(header.parent / "main")]).returncode == 0, flags


@pytest.mark.parametrize("weights", ["source", "file"])
def test_gcc_makes_vectors_of_every_row(weights: str, tmp_path: Path) -> None:
    """Products and tanh of rows, as -O2 allows: no branch, no doubt about what overlaps."""
    gcc = shutil.which("gcc")
    version = 0 if gcc is None else int(subprocess.check_output([gcc, "-dumpversion"], text=True).split(".")[0])
    if version < 12:
        pytest.skip("gcc 12, the first whose -O2 makes vectors, is not installed")
    header, _ = _written(_saved("tanh64", tmp_path), tmp_path / "out", CodeOptions(weights=weights))
    command = [str(gcc), "-O2", "-fopt-info-vec", "-c", "main.c", "-o", "main.o"]
    said = subprocess.run(command, check=True, cwd=header.parent, capture_output=True, text=True).stderr
    found = {int(n) for n in re.findall(rf"{header.name}:(\d+):\d+: optimized: loop vectorized", said)}
    lines = header.read_text().splitlines()
    rows = {
        n
        for n, (line, inner) in enumerate(itertools.pairwise(lines), 1)
        if re.search(r"for \(int \w = 0; \w < 64; \w\+\+\) \{", line) and ("tanhf(" in inner or inner.endswith("]"))
    }
    assert len(rows) >= 4
    assert rows <= found


def test_padding_is_asked_for_outside_of_the_channels(tmp_path: Path) -> None:
    header, _ = _written(_saved("history", tmp_path), tmp_path / "out")
    text = header.read_text()
    assert re.search(r"if \(.* < .*\) \{\n +(for|\{|const float x)", text)
    assert " ? t_" not in text


def test_constants_of_a_policy_leave_no_options_behind(tmp_path: Path) -> None:
    """What gcc is told of the header is taken back at its end."""
    header, _ = _written(path("continuous"), tmp_path)
    text = header.read_text()
    assert text.count("#pragma GCC push_options") == text.count("#pragma GCC pop_options") == 1
