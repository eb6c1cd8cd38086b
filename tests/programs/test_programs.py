"""Policies as source code in C# and JavaScript, as C in tests/c: they act as their sources do."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.format import Format, WriteOptions
from export_model.converters.formats.programs import plan
from export_model.converters.formats.programs.members import answers
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.program import program_of
from export_model.converters.graph.types import INT32
from export_model.converters.runtimes.c import compiler
from export_model.converters.runtimes.csharp import tools
from export_model.converters.runtimes.javascript.node import node_executable
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.inspect.inspection import inspect_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.code import CodeOptions
from export_model.signatures.errors import UnsupportedOpError
from fixtures import FIXTURES, path
from tests import known
from tests.conftest import Chosen
from tests.graph.harness import Runtimes, policy_of
from tests.handmade import constant, dense, graph_bytes, node, placeholder

pytestmark = pytest.mark.xdist_group("programs")

PROGRAMS = [form for form in WRITTEN.values() if form.program]
#: C has tests of its own.
OTHERS = [form for form in PROGRAMS if form.key != "c"]
each_program = pytest.mark.parametrize("form", OTHERS, ids=lambda form: form.key)


def need(form: Format) -> str:
    """The runtime that judges a format; skips, with how to install it, where it is not here."""
    (runtime,) = form.runtimes
    (found,) = (i for i in available_runtimes() if i.name == runtime)
    if not found.installed:
        pytest.skip(f"{runtime} is not installed: {found.how}")
    return runtime


@each_program
@pytest.mark.parametrize("name", FIXTURES)
def test_fixtures_agree(name: str, form: Format, tmp_path: Path, processes: RuntimePool) -> None:
    runtime = need(form)
    options = ExportOptions(tmp_path, ("bytes", form.key), verify=(runtime, "tensorflow"))
    for result in export([path(name)], options, pool=processes):
        report = result.report
        assert report is not None
        assert report.original == "tensorflow"  # whose numbers are no reading of ours
        assert report.passed is True, "\n".join(failure_lines(report))
        compared = {c.output for c in report.comparisons if c.runtime == runtime}
        assert compared >= set(answers(result.policy.signature))


def test_a_policy_is_planned_once_for_all_languages(monkeypatch: pytest.MonkeyPatch) -> None:
    alone = [form.artifact(read_source(path("recurrent")).policies()[0], WriteOptions("{}")) for form in PROGRAMS]
    planned = []
    monkeypatch.setattr(plan, "program_of", lambda *given: (planned.append(given), program_of(*given))[1])
    (found,) = inspect_source(path("recurrent")).policies
    assert len(planned) == 1
    beside = [form.artifact(found.policy, WriteOptions("{}")) for form in PROGRAMS]
    contents = [[{n: p.to_bytes() for n, p in made.files.items()} for made in each] for each in (alone, beside)]
    assert contents[0] == contents[1] and len(planned) == 1
    for other in (WriteOptions("[]"), WriteOptions("{}", code=CodeOptions(math="own"))):
        PROGRAMS[0].artifact(found.policy, other)
    assert len(planned) == 3


@pytest.mark.corpus
@pytest.mark.slow
@each_program
@pytest.mark.parametrize("source", known.params(known.sources()))
def test_every_policy_acts_alike(
    source: Path, form: Format, tmp_path: Path, processes: RuntimePool, is_new: Chosen
) -> None:
    runtime = need(form)
    policies = known.policies_or_skip(source)
    for policy in policies:
        form.artifact(policy, WriteOptions("{}"))  # none of them is refused
    if not is_new(form.key, policies):  # type: ignore[call-arg, arg-type]
        return
    for result in export([source], ExportOptions(tmp_path, (form.key,), verify=(runtime,)), pool=processes):
        assert result.report is not None
        assert result.report.passed is True, "\n".join(failure_lines(result.report))


@each_program
@pytest.mark.parametrize("name", FIXTURES)
def test_the_same_policy_gives_the_same_bytes(name: str, form: Format) -> None:
    def write() -> list[bytes]:
        artefacts = [form.artifact(p, WriteOptions("{}")) for p in read_source(path(name)).policies()]
        return [data.to_bytes() for a in artefacts for data in a.files.values()]

    assert write() == write()


@each_program
@pytest.mark.parametrize("index", [-1, 0, 2, 3, 2**31 - 1, -(2**31)])
def test_an_index_outside_of_its_table_is_an_error(
    index: int, form: Format, processes: RuntimePool, tmp_path: Path
) -> None:
    need(form)
    table = np.arange(6, dtype=np.float32).reshape(3, 2)
    observed = Node("rows", "Placeholder", attrs={"dtype": INT32, "shape": TensorShape((None,))})
    nodes = (observed, Node("table", "Const", value=table), Node("row", "Gather", ("table", "rows")))
    policy, runtimes = policy_of(Graph(nodes), ["row"]), Runtimes(processes, tmp_path)
    feeds = {"rows": np.array([index], np.int32)}
    if 0 <= index < 3:
        (found,) = runtimes.program(form.key, policy, feeds)
        assert np.array_equal(found, table[[index]])
        return
    with pytest.raises(RunFailedError) as caught:
        runtimes.program(form.key, policy, feeds)
    assert "lies outside of" in f"{caught.value}{caught.value.said}"  # a program's own words are kept apart


# ------------------------------------------------------------------ as people call it

SEED, STEPS = 2**40 + 7, 5
MAINS = {
    "c": """
#define CONTINUOUS_IMPLEMENTATION
#include "continuous.h"
#include <stdio.h>
int main(void)
{
    static continuous_memory memory;
    continuous_input input = {{0.25f}};
    continuous_output output;
    continuous_reset(&memory, SEED);
    for (int i = 0; i < STEPS; i++) {
        continuous_act(&input, &memory, &output);
        printf("%.9g %.9g\\n", (double)memory.epsilon[0], (double)output.action[0]);
    }
    return 0;
}
""",
    "csharp": """
static class Program
{
    static void Main()
    {
        var agent = new Policies.Continuous(SEED);
        agent.state[0] = 0.25f;
        for (int i = 0; i < STEPS; i++) {
            agent.Act();
            var as_is = System.Globalization.CultureInfo.InvariantCulture;
            System.Console.WriteLine(agent.epsilon[0].ToString("R", as_is));
            System.Console.WriteLine(agent.action[0].ToString("R", as_is));
        }
        long before = System.GC.CollectionCount(0);
        for (int i = 0; i < 20000; i++) agent.Act();
        System.Console.WriteLine(System.GC.CollectionCount(0) - before);
    }
}
""",
    "js": """
import { Continuous } from "./continuous.mjs";
const agent = new Continuous(SEED);
agent.state[0] = 0.25;
for (let i = 0; i < STEPS; i++) {
    agent.act();
    console.log(agent.epsilon[0], agent.action[0]);
}
""",
}


def printed(form: Format, folder: Path) -> list[float]:
    """What a program prints that is written around a fixture."""
    need(form)
    (result,) = export([path("continuous")], ExportOptions(folder / "out", (form.key,), verify="none"))
    here, text = result.folder, MAINS[form.key].replace("SEED", str(SEED)).replace("STEPS", str(STEPS))
    main = here / {"c": "main.c", "csharp": "main.cs", "js": "main.mjs"}[form.key]
    main.write_text(text)
    if form.key == "c":
        subprocess.run([str(compiler()), "-std=c99", "-o", "main", "main.c", "-lm"], check=True, cwd=here)
        command = [str(here / "main")]
    elif form.key == "csharp":
        mcs, mono = tools() or ("", "")
        subprocess.run([mcs, "-langversion:7", "-out:main.exe", "main.cs", "continuous.cs"], check=True, cwd=here)
        command = [mono, str(here / "main.exe")]
    else:
        command = [str(node_executable()), str(main)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return [float(word) for word in said.split()]


@each_program
def test_the_same_seed_draws_the_same_in_every_language(form: Format, tmp_path: Path) -> None:
    """The stream is the same; what the functions of each library make of it, to the rounding of float32."""
    expected = printed(WRITTEN["c"], tmp_path / "c")
    found = printed(form, tmp_path / form.key)[: 2 * STEPS]
    assert len(set(expected[::2])) == STEPS
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-6)


def test_csharp_allocates_nothing_for_a_decision(tmp_path: Path) -> None:
    """20,000 decisions, and not one collection of the youngest generation."""
    assert printed(WRITTEN["csharp"], tmp_path)[-1] == 0


@pytest.mark.parametrize("form", PROGRAMS, ids=lambda form: form.key)
def test_an_input_without_elements_is_refused_by_name(form: Format, tmp_path: Path) -> None:
    """It came from a damaged model.json, and the self test was made of it all the same."""
    nodes = [
        placeholder("vector_observation"),
        placeholder("prev_action", (None, 0), np.int32),
        node("numbers", "Cast", "prev_action", DstT=np.float32),
        constant("axis", 1),
        node("seen", "ConcatV2", "vector_observation", "numbers", "axis"),
        *dense("action", "seen", 3, 2),
    ]
    source = tmp_path / "empty.bytes"
    source.write_bytes(graph_bytes(nodes))
    (policy,) = read_source(source).policies()
    with pytest.raises(UnsupportedOpError, match=r"'prev_action' \(prev_action\) .* it has the shape \[None, 0\]"):
        form.artifact(policy, WriteOptions("{}"))
