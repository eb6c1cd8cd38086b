"""``--math own``: as exact as it says, and the same bits in every compiler and language."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.ops.loops.own_math import OWN
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.c import compiler
from export_model.converters.runtimes.csharp import tools
from export_model.converters.runtimes.javascript.node import node_executable
from export_model.exporter.export.pipeline import Exporter, ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.code import CodeOptions, code_options
from export_model.signatures.errors import UsageError
from fixtures import FIXTURES, path
from tests.bench.own_math import measure
from tests.programs.machines import MACHINES
from tests.programs.mains import MAINS, called

pytestmark = pytest.mark.xdist_group("programs")

OWN_MATH = CodeOptions(math="own")
ROOT = Path(__file__).resolve().parents[2]
SOURCES = {**{name: path(name) for name in FIXTURES}, "3DBall": ROOT / "fixtures/trained/3DBall"}
#: What a compiler is asked for: no optimisation, the usual one, and all that this processor can (fused products too).
FLAGS = ("-O0", "-O2", "-O3 -march=native -std=gnu99")


@pytest.mark.parametrize("function", OWN)
def test_no_function_is_farther_off_than_it_says(function: str, tmp_path: Path) -> None:
    """One of 4,999 floats beside the C library in double; ``python -m tests.bench.own_math`` takes them all."""
    if compiler() is None:
        pytest.skip("no C compiler is installed")
    most, where = measure(function, 4999, tmp_path)
    assert 0 < most <= OWN[function].ulps, where


def _compiled(policy: Policy, folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Who runs a policy's source code, and the commands that do."""
    for form in (f for f in WRITTEN.values() if f.program):
        form.artifact(policy, WriteOptions("{}", code=OWN_MATH)).write(folder)
        main, file = MAINS[form.key]
        (folder / file).write_text(main(called(policy)), "ascii")
    for each in filter(None, map(shutil.which, ("gcc", "clang"))):
        for flags in FLAGS:
            command = [each, "-Wall", "-Wextra", "-Wconversion", "-Werror", *flags.split(), "main.c", "-o", "main"]
            subprocess.run([*command, "-lm"], check=True, cwd=folder)
            yield f"{each} {flags}", [str(folder / "main")]
    for machine in (m for m in MACHINES if not m.missing()):
        yield machine.name, machine.build(folder)
    if (found := tools()) is not None:
        mcs, mono = found
        subprocess.run([mcs, "-langversion:7", "-out:main.exe", "main.cs", f"{policy.name}.cs"], check=True, cwd=folder)
        yield "mono", [mono, str(folder / "main.exe")]
    yield "node", [str(node_executable()), str(folder / "main.mjs")]


@pytest.mark.parametrize("name", SOURCES)
def test_bits_are_the_same_everywhere(name: str, tmp_path: Path) -> None:
    """Draws, decisions and memory over steps."""
    for i, policy in enumerate(read_source(SOURCES[name]).policies()):
        folder = tmp_path / str(i)
        folder.mkdir()
        said = {}
        for who, command in _compiled(policy, folder):
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            said[who] = done.stdout.split()
        first = next(iter(said.values()))
        assert len(set(first)) > 1
        assert {who for who, words in said.items() if words != first} == set()


def test_a_contract_says_it(tmp_path: Path) -> None:
    options = ExportOptions(tmp_path, ("c", "onnx"), verify="none", code=OWN_MATH)
    (result,) = export([path("continuous")], options)
    assert result.contract["tool"]["code"] == {"math": "own"}
    header = (result.folder / "continuous.h").read_text()
    assert '"code":{"math":"own"}' in header
    assert "FP_CONTRACT OFF" in header


def test_it_asks_for_source_code(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--math own does not go with --to onnx"):
        Exporter(ExportOptions(tmp_path, ("onnx",), code=OWN_MATH))
    with pytest.raises(UsageError, match="--math theirs"):
        code_options(math="theirs")
