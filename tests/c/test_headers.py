"""Policies as C headers, compiled with all warnings as errors: they act as their sources do."""

from __future__ import annotations

import itertools
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.children import confinement
from export_model.converters.files.children.bounded import run_bounded
from export_model.converters.files.children.environment import readable_places
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.programs.members import answers, header_of
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.language import comment
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.types import FLOAT32, INT32
from export_model.converters.runtimes.c import COMPILERS, compiler
from export_model.converters.runtimes.c.child import FLAGS
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.errors import UnsupportedOpError
from fixtures import FIXTURES, path
from tests import known
from tests.conftest import Chosen
from tests.graph.harness import Runtimes, policy_of

pytestmark = pytest.mark.xdist_group("c")


@pytest.fixture(scope="module")
def here(processes: RuntimePool) -> RuntimePool:
    (found,) = (i for i in available_runtimes() if i.name == "c")
    if not found.installed:
        pytest.skip(f"no C compiler is installed: {found.how}")
    return processes


@pytest.mark.parametrize("name", FIXTURES)
def test_fixtures_agree(name: str, tmp_path: Path, here: RuntimePool) -> None:
    for result in export([path(name)], ExportOptions(tmp_path, ("bytes", "c"), verify=("c", "tensorflow")), pool=here):
        report = result.report
        assert report is not None
        assert report.original == "tensorflow"  # whose numbers are no reading of ours
        assert report.passed is True, "\n".join(failure_lines(report))
        compared = {c.output for c in report.comparisons if c.runtime == "c"}
        assert compared >= set(answers(result.policy.signature))


@pytest.mark.corpus
@pytest.mark.slow
@pytest.mark.parametrize("source", known.params(known.sources()))
def test_every_policy_acts_alike(source: Path, tmp_path: Path, here: RuntimePool, is_new: Chosen) -> None:
    policies = known.policies_or_skip(source)
    for policy in policies:
        WRITTEN["c"].artifact(policy, WriteOptions("{}"))  # none of them is refused
    if not is_new("c", policies):  # type: ignore[call-arg, arg-type]
        return
    for result in export([source], ExportOptions(tmp_path, ("c",), verify=("c",)), pool=here):
        assert result.report is not None
        assert result.report.passed is True, "\n".join(failure_lines(result.report))


#: Without those of a library.
PLAIN = tuple(f for f in FLAGS if f not in ("-shared", "-fPIC"))
SANITIZED = ("-std=c99", "-O1", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")


@pytest.mark.corpus
@pytest.mark.slow
@pytest.mark.parametrize("source", known.params(known.sources()))
def test_compilers_and_sanitizers_find_nothing(source: Path, tmp_path: Path, here: RuntimePool, is_new: Chosen) -> None:
    """No warning in any compiler that is here; and AddressSanitizer and UndefinedBehaviorSanitizer, with odd inputs."""
    policies = known.policies_or_skip(source)
    if not is_new("c-sanitizers", policies):  # type: ignore[call-arg, arg-type]
        return
    for policy in policies:
        artifact = WRITTEN["c"].artifact(policy, WriteOptions("{}"))
        artifact.write(tmp_path)
        header = header_of(policy.name, policy.signature)
        p, floats = header.prefix, [f for f in header.inputs if f.spec.dtype == "float32"]
        fill = "".join(f"for (int i = 0; i < {f.size}; i++) input.{f.name}[i] = odd[(i + row) % 5];" for f in floats)
        program = tmp_path / "main.c"
        program.write_text(
            f'#define {p.upper()}_IMPLEMENTATION\n#define {p.upper()}_SELFTEST\n#include "{artifact.main}"\n'
            f"#include <stdlib.h>\nint main(void)\n{{\n    {p}_memory *memory = malloc(sizeof *memory);\n"
            f"    {p}_input input = {{0}};\n    {p}_output output;\n"
            "    const float odd[5] = {NAN, INFINITY, -3e9f, 1e20f, 0.5f};\n"
            f"    int wrong = {p}_selftest(memory);\n    {p}_reset(memory, 1);\n"
            f"    for (int row = 0; row < 5; row++) {{ {fill} (void)odd; {p}_act(&input, memory, &output); }}\n"
            "    free(memory);\n    return wrong;\n}\n"
        )
        for each in filter(None, map(shutil.which, COMPILERS)):
            subprocess.run([each, *PLAIN, "-fsyntax-only", str(program)], check=True, cwd=tmp_path)
        command = [str(compiler()), *SANITIZED, "-o", str(tmp_path / "main"), str(program), "-lm"]
        subprocess.run(command, check=True, cwd=tmp_path)
        done = subprocess.run([str(tmp_path / "main")], check=False, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", FIXTURES)
def test_the_same_policy_gives_the_same_bytes(name: str) -> None:
    def written() -> list[bytes]:
        artefacts = [WRITTEN["c"].artifact(p, WriteOptions("{}")) for p in read_source(path(name)).policies()]
        return [data.to_bytes() for a in artefacts for data in a.files.values()]

    assert written() == written()


def test_an_op_of_unknown_length_is_refused_by_its_name() -> None:
    observed = Node("x", "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, 2))})
    policy = policy_of(Graph((observed, Node("where", "Where", ("x",)))), ["where"])
    with pytest.raises(UnsupportedOpError, match=r"'where' \(Where\) is not written as source code") as refusal:
        WRITTEN["c"].artifact(policy, WriteOptions("{}"))
    assert refusal.value.why == "how many places it finds is known only while it runs"


def test_more_rows_than_agents_are_refused_by_the_outputs_name() -> None:
    """A damaged shape made 839,523 golden rows of one agent's answer: 50 s, and 1.2 GB in ``inspect``."""
    observed = Node("x", "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, 3, 4))})
    nodes = (observed, Node("to", "Const", value=np.array([-1, 4], np.int32)), Node("rows", "Reshape", ("x", "to")))
    with pytest.raises(UnsupportedOpError, match=r"'y0' .* one agent gets 12 numbers of it"):
        WRITTEN["c"].artifact(policy_of(Graph(nodes), ["rows"]), WriteOptions("{}"))


@pytest.mark.parametrize("index", [-1, 0, 2, 3, 2**31 - 1, -(2**31)])
def test_an_index_outside_of_its_table_is_an_error(index: int, processes: RuntimePool, tmp_path: Path) -> None:
    """TensorFlow's on a processor; nothing is clamped."""
    table = np.arange(6, dtype=np.float32).reshape(3, 2)
    observed = Node("rows", "Placeholder", attrs={"dtype": INT32, "shape": TensorShape((None,))})
    nodes = (observed, Node("table", "Const", value=table), Node("row", "Gather", ("table", "rows")))
    policy, runtimes = policy_of(Graph(nodes), ["row"]), Runtimes(processes, tmp_path)
    feeds = {"rows": np.array([index], np.int32)}
    if 0 <= index < 3:
        for (found,) in (runtimes.program("c", policy, feeds), runtimes.tensorflow(policy.graph, feeds, ["row"])):
            assert np.array_equal(found, table[[index]])
        return
    with pytest.raises(RunFailedError, match="an index of 1 inputs lies outside of the table"):
        runtimes.program("c", policy, feeds)
    with pytest.raises(RunFailedError, match=rf"indices\[0\] = {index} is not in \[0, 3\)"):
        runtimes.tensorflow(policy.graph, feeds, ["row"])


def test_no_name_of_a_source_leaves_its_comment(tmp_path: Path, here: RuntimePool) -> None:
    """What stands behind a comment's end would be code of whoever made the policy."""
    pieces = ("*", "/", "\\", "\n", "??/", "\r", "#error left\n", "é", " ")
    names = ["".join(word) for length in (2, 3, 4) for word in itertools.product(pieces, repeat=length)]
    source = tmp_path / "names.c"
    source.write_text("".join(f"{comment(name)}\n" for name in names) + "int nothing;\n", "ascii")
    for each in filter(None, map(shutil.which, COMPILERS)):
        subprocess.run([each, "-std=c99", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", source], check=True)


# ------------------------------------------------------------------ as people call it


def printed(name: str, main: str, folder: Path) -> list[str]:
    """What a program that includes a fixture's header prints; every compiler that is here must take it."""
    (result,) = export([path(name)], ExportOptions(folder / "out", ("c",), verify="none"))
    source = folder / "main.c"
    text = f'#define {name.upper()}_IMPLEMENTATION\n#include "{name}.h"\n#include <stdio.h>\n{main}'
    source.write_text(text)
    compilers = [found for found in map(shutil.which, ("gcc", "clang")) if found]
    said = set()
    for each in compilers:
        command = [each, *PLAIN, "-I", str(result.folder), "-o", str(folder / "main"), str(source), "-lm"]
        subprocess.run(command, check=True)
        said.add(subprocess.run([str(folder / "main")], check=True, capture_output=True, text=True).stdout)
    (only,) = said
    return only.split()


def test_draws_are_those_of_the_seed(tmp_path: Path, here: RuntimePool) -> None:
    main = """
int main(void)
{
    static continuous_memory memory;
    continuous_input input = {{0}};
    continuous_output output;
    for (uint64_t seed = 0; seed < 6; seed++) {
        continuous_reset(&memory, seed / 2);
        continuous_act(&input, &memory, &output);
        printf("%.9g\\n", (double)memory.epsilon[0]);
    }
    return 0;
}
"""
    drawn = printed("continuous", main, tmp_path)
    assert drawn[0::2] == drawn[1::2]
    assert len(set(drawn)) == 3


def test_classes_are_drawn_by_their_probabilities(tmp_path: Path, here: RuntimePool) -> None:
    """4000 draws of the first branch: no class is farther off than five standard deviations."""
    main = """
int main(void)
{
    static discrete_memory memory;
    discrete_input input = {{0}, {0}};
    discrete_output output;
    int32_t action[8];
    int counts[8] = {0};
    for (int i = 0; i < (int)(sizeof input.action_masks / sizeof input.action_masks[0]); i++) input.action_masks[i] = 1;
    discrete_reset(&memory, 3);
    discrete_act(&input, &memory, &output);
    for (int i = 0; i < 4000; i++) {
        discrete_choose(&memory, &output, action);
        counts[action[0]]++;
    }
    for (int i = 0; i < 2; i++) printf("%d %.9g ", counts[i], (double)expf(output.action[i]));
    return 0;
}
"""
    numbers = [float(word) for word in printed("discrete", main, tmp_path)]
    for count, share in zip(numbers[0::2], numbers[1::2], strict=True):
        assert abs(count - 4000 * share) <= 5 * (4000 * share * (1 - share)) ** 0.5 + 1


@pytest.fixture
def readable(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a child that confined itself lets the processes read that it starts."""
    monkeypatch.setattr(confinement, "_readable", list(readable_places([sys.executable])))


@pytest.mark.usefixtures("readable")
def test_the_memory_of_a_compiler_is_bounded(tmp_path: Path) -> None:
    done = run_bounded([sys.executable, "-c", "x = bytearray(1 << 32)"], tmp_path, 1 << 30, 9)
    assert "MemoryError" in done.stderr


@pytest.mark.usefixtures("readable")
def test_the_time_of_a_compiler_is_bounded(tmp_path: Path, here: RuntimePool) -> None:
    """By a header whose macros become 2 to the 40 words."""
    doubled = "".join(f"#define A{i} A{i - 1} A{i - 1}\n" for i in range(1, 41))
    (tmp_path / "bomb.h").write_text(f"#define A0 0 +\n{doubled}int a = A40 0;\n")
    done = run_bounded([str(compiler()), "-fsyntax-only", "bomb.h"], tmp_path, 1 << 32, 1)
    assert done.returncode != 0
    assert "CPU time limit exceeded" in done.stderr or "Killed" in done.stderr
