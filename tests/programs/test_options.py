"""``--weights file``, ``--dtype float16``, ``--quantize int8``, ``--outputs all`` and ``--guard`` of source code."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from msgspec.structs import replace

from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.formats.format import Format, WriteOptions
from export_model.converters.formats.programs.artifact import can_confine, vetted
from export_model.converters.formats.programs.members import answers
from export_model.converters.formats.programs.weights import weights_name
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.c import compiler
from export_model.converters.runtimes.csharp import tools
from export_model.converters.runtimes.javascript.node import node_executable
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import Exporter, ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.code import CodeOptions, code_options
from export_model.signatures.errors import DamagedFileError, UsageError
from fixtures import path
from tests.exporting import verify_bundle
from tests.programs.mains import MAINS
from tests.programs.test_programs import PROGRAMS, need

pytestmark = pytest.mark.xdist_group("programs")

each_program = pytest.mark.parametrize("form", PROGRAMS, ids=lambda form: form.key)
EVERYTHING = CodeOptions(math="own", weights="file", outputs="all")
PLAIN = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror")


def build(form: Format, main: str, folder: Path) -> list[str]:
    """The command that runs a program around a policy's source code, which lies in the folder."""
    need(form)
    file = folder / MAINS[form.key][1]
    file.write_text(main, "ascii")
    if form.key == "c":
        for each in filter(None, map(shutil.which, ("clang", "gcc"))):
            subprocess.run([each, *PLAIN, "-I.", "-o", "main", file.name, "-lm"], check=True, cwd=folder)
        return [str(folder / "main")]
    if form.key == "csharp":
        mcs, mono = tools() or ("", "")
        sources = [p.name for p in folder.glob("*.cs")]
        subprocess.run([mcs, "-langversion:7", "-out:main.exe", *sources], check=True, cwd=folder)
        return [mono, str(folder / "main.exe")]
    return [str(node_executable()), str(file)]


def said(command: list[str], folder: Path) -> list[str]:
    """What a program prints."""
    return subprocess.run(command, check=True, capture_output=True, text=True, cwd=folder).stdout.split()


def policy_named(name: str) -> Policy:
    return read_source(path(name)).policies()[0]


# ------------------------------------------------------------------ as their sources do


@each_program
@pytest.mark.parametrize("weights", ["float32", "float16", "int8"])
@pytest.mark.parametrize("name", ["continuous", "recurrent", "visual"])
def test_policies_agree(name: str, weights: Storage, form: Format, tmp_path: Path, processes: RuntimePool) -> None:
    """All options at once, held to TensorFlow; rounded weights are judged by their decisions, as in other formats."""
    runtime = need(form)
    runtimes = (runtime, "tensorflow")
    options = ExportOptions(tmp_path, ("bytes", form.key), verify=runtimes, weights=weights, code=EVERYTHING)
    (result,) = export([path(name)], options, pool=processes)
    report = result.report
    assert report is not None
    assert report.passed is True, "\n".join(failure_lines(report))
    compared = {c.output for c in report.comparisons if c.runtime == runtime}
    everything = {s.name for s in result.policy.signature.outputs}
    assert compared >= everything > set(answers(result.policy.signature))
    assert result.contract["tool"]["code"] == {"math": "own", "weights": "file", "outputs": "all"}
    assert weights_name(name) in json.loads((result.folder / "policy.json").read_text())["files"]
    if not can_confine():
        return
    again = verify_bundle(result.folder, runtimes=runtime)
    assert again.passed is True, "\n".join(failure_lines(again))
    assert {c.output for c in again.comparisons if c.runtime == runtime} >= everything


# ------------------------------------------------------------------ other weights

LOADS = {
    "c": """
#define CONTINUOUS_IMPLEMENTATION
#include "continuous.h"
#include <stdio.h>
static uint32_t words[1 << 16];
int main(void)
{
    static continuous_memory memory;
    static continuous_input input;
    continuous_output output;
    static const char *const files[] = {FILES};
    unsigned char *const bytes = (unsigned char *)words;
    printf("%d\\n", continuous_act(&input, &memory, &output) == 2 ? 0 : 1);
    for (int i = 0; i < 4; i++) {
        FILE *const file = fopen(files[i], "rb");
        const size_t size = fread(bytes, 1, sizeof words, file);
        fclose(file);
        const int loaded = continuous_load(&memory, bytes, size) == 0;
        continuous_reset(&memory, 1); /* which keeps the weights */
        printf("%d\\n", loaded && continuous_act(&input, &memory, &output) == 0 ? 1 : 0);
    }
    printf("%d\\n", continuous_load(&memory, bytes + 1, continuous_weights_size) == 0 ? 1 : 0);
    return 0;
}
""",
    "csharp": """
static class Program
{
    static int Try(System.Action action)
    {
        try { action(); return 1; }
        catch (System.IO.InvalidDataException) { return 0; }
        catch (System.InvalidOperationException) { return 0; }
    }
    static void Main()
    {
        System.Console.WriteLine(Try(() => new Policies.Continuous().Act()));
        foreach (var name in new[] {FILES})
            System.Console.WriteLine(Try(() => Policies.Continuous.Load(System.IO.File.OpenRead(name))));
        System.Console.WriteLine(0);
    }
}
""",
    "js": """
import { readFileSync } from "node:fs";
import { Continuous, load } from "./continuous.mjs";
function attempt(action) {
    try { action(); return 1; } catch (error) { return 0; }
}
console.log(attempt(() => new Continuous().act()));
for (const name of [FILES]) console.log(attempt(() => load(readFileSync(name))));
console.log(0);
""",
}


@each_program
def test_other_weights_are_refused(form: Format, tmp_path: Path) -> None:
    """None at all, too few bytes, too many, one bit that fell over, in C not aligned; and the right ones are taken."""
    options = ExportOptions(tmp_path, (form.key,), verify="none", code=CodeOptions(weights="file"))
    (result,) = export([path("continuous")], options)
    here = result.folder
    right = (here / weights_name("continuous")).read_bytes()
    flipped = bytearray(right)
    flipped[len(right) // 2] ^= 4
    files = {"right": right, "short": right[:-1], "long": right + b"\0", "flipped": bytes(flipped)}
    for name, content in files.items():
        (here / name).write_bytes(content)
    main = LOADS[form.key].replace("FILES", ", ".join(f'"{name}"' for name in files))
    assert said(build(form, main, here), here) == ["0", "1", "0", "0", "0", "0"]


# ------------------------------------------------------------------ unusual observations

GUARDS = {
    "c": """
#define CONTINUOUS_IMPLEMENTATION
#include "continuous.h"
#include <stdio.h>
int main(void)
{
    static const float rows[][continuous_size_state] = {ROWS};
    continuous_input input;
    for (int row = 0; row < 4; row++) {
        memcpy(input.state, rows[row], sizeof input.state);
        printf("%d\\n", continuous_unusual(&input));
    }
    printf("%d %d\\n", (int)continuous_size_action, (int)continuous_size_epsilon);
    return 0;
}
""",
    "csharp": """
static class Program
{
    const float NAN = float.NaN;
    static void Main()
    {
        var agent = new Policies.Continuous();
        foreach (var row in new float[][] {ROWS}) {
            System.Array.Copy(row, agent.state, Policies.Continuous.Sizes.state);
            System.Console.WriteLine(agent.Unusual());
        }
        System.Console.WriteLine(Policies.Continuous.Sizes.action + " " + Policies.Continuous.Sizes.epsilon);
    }
}
""",
    "js": """
import { Continuous, ports } from "./continuous.mjs";
const agent = new Continuous();
const NAN = NaN;
for (const row of [ROWS]) {
    agent.state.set(row);
    console.log(agent.unusual());
}
console.log(ports.outputs.action[2][1], ports.inputs.epsilon[2][1]);
""",
}


@each_program
def test_unusual_observations_are_counted(form: Format, tmp_path: Path) -> None:
    """By the contract's normaliser: at its mean, just inside of 5 deviations, two numbers just outside, no number."""
    (result,) = export(
        [path("continuous")], ExportOptions(tmp_path, (form.key,), verify="none", code=CodeOptions(guard=5.0))
    )
    (state,) = (s for s in result.policy.signature.inputs if s.name == "state")
    assert state.distribution is not None
    mean, std = state.distribution["mean"], state.distribution["std"]
    inside = [m + 4.99 * s * (-1) ** i for i, (m, s) in enumerate(zip(mean, std, strict=True))]
    outside = [m + (5.01 * s if i in (2, 7) else 0) for i, (m, s) in enumerate(zip(mean, std, strict=True))]
    suffix, (left, right) = ("", "[]") if form.key == "js" else ("f", "{}")
    words = [", ".join(f"{x:.9g}{suffix}" for x in row) for row in (mean, inside, outside)]
    words.append(words[0].rpartition(",")[0] + ", NAN")
    rows = ", ".join(f"{'new float[] ' if form.key == 'csharp' else ''}{left}{row}{right}" for row in words)
    assert said(build(form, GUARDS[form.key].replace("ROWS", rows), result.folder), result.folder) == [
        *("0", "0", "2", "1"),
        *("2", "2"),
    ]


def test_verify_misses_the_file_of_weights(tmp_path: Path) -> None:
    """A candidate without it is damaged, and named."""
    options = ExportOptions(tmp_path, ("c",), verify="none", code=CodeOptions(weights="file"))
    (result,) = export([path("continuous")], options)
    (result.folder / weights_name("continuous")).unlink()
    if not can_confine():
        pytest.skip("nothing confines a program on this system")
    (tmp_path / "copy").mkdir()
    with pytest.raises(DamagedFileError, match=r"continuous\.weights\.bin is missing"):
        vetted(result.folder / "continuous.h", [], tmp_path / "copy")


def test_a_guard_needs_a_normaliser(tmp_path: Path) -> None:
    options = ExportOptions(tmp_path, ("c",), verify="none", code=CodeOptions(guard=6.0))
    with pytest.raises(UsageError, match="--guard 6: visual has no normaliser"):
        list(export([path("visual")], options))


@pytest.mark.parametrize(
    ("said_so", "message"),
    [
        ({"weights": "cloud"}, "--weights cloud"),
        ({"outputs": "critic"}, "--outputs critic"),
        ({"guard": 0.0}, "--guard 0"),
        ({"guard": float("nan")}, "--guard nan"),
    ],
)
def test_what_nobody_knows_is_refused(said_so: dict[str, str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        code_options(**said_so)  # type: ignore[arg-type]


@pytest.mark.parametrize("code", [CodeOptions(weights="file"), CodeOptions(outputs="all"), CodeOptions(guard=6.0)])
def test_options_ask_for_source_code(code: CodeOptions, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not go with --to onnx"):
        Exporter(ExportOptions(tmp_path, ("onnx",), code=code))


def test_a_header_with_all_options_is_cpp_too(tmp_path: Path) -> None:
    if shutil.which("g++") is None or compiler() is None:
        pytest.skip("no C++ compiler is installed")
    code = replace(EVERYTHING, guard=4.0)
    WRITTEN["c"].artifact(policy_named("continuous"), WriteOptions("{}", weights="int8", code=code)).write(tmp_path)
    (tmp_path / "main.cpp").write_text('#define CONTINUOUS_IMPLEMENTATION\n#include "continuous.h"\n')
    command = ["g++", "-std=c++11", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", "main.cpp"]
    subprocess.run(command, check=True, cwd=tmp_path)
