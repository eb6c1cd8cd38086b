"""A policy may call its inputs as programs call anything of theirs: it still compiles, and computes the same."""

from __future__ import annotations

import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.formats.format import Format, WriteOptions
from export_model.converters.formats.programs.members import header_of
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import FLOAT32
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.signatures.code import CodeOptions
from export_model.signatures.errors import UnsupportedOpError
from fixtures import FIXTURES, path
from tests.comparing import compare_artefacts
from tests.graph.harness import Runtimes, policy_of
from tests.programs.mains import MAINS, called
from tests.programs.test_options import build, said
from tests.programs.test_programs import PROGRAMS, need

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("programs")]

each_program = pytest.mark.parametrize("form", PROGRAMS, ids=lambda form: form.key)
CODES = (CodeOptions(), CodeOptions(math="own"), CodeOptions(weights="file", outputs="all"))
#: Ops that bring functions along, on numbers that all inputs add up to.
_UNARY = ("Erf", "Expm1", "Log1p", "Exp", "Tanh", "Sin", "Abs", "Round", "Floor", "Elu", "Softmax")
_BINARY = ("Maximum", "Minimum", "FloorMod", "Pow")


def policy_with(names: list[str]) -> Policy:
    """A policy with an input of each name: functions of their mean, weights, draws."""
    inputs = [Node(n, "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, 16))}) for n in names]
    nodes, level = list(inputs), [n.name for n in inputs]
    while len(level) > 1:
        pairs = [level[i : i + 2] for i in range(0, len(level), 2)]
        made = [Node(f"_{len(nodes) + i}", "Add", tuple(p)) for i, p in enumerate(pairs) if len(p) == 2]
        nodes += made
        level = [n.name for n in made] + [p[0] for p in pairs if len(p) == 1]
    weights = np.linspace(-1, 1, 16 * 16, dtype=np.float32).reshape(16, 16)
    nodes += [
        Node("_of", "Const", value=np.array(1 / len(names), np.float32)),
        Node("_mean", "Mul", (level[0], "_of")),
        Node("_weights", "Const", value=weights),
        Node("_product", "MatMul", ("_mean", "_weights"), {"transpose_a": False, "transpose_b": False}),
        Node("_half", "Const", value=np.array(0.5, np.float32)),
        *(Node(f"_{op}", op, ("_product",)) for op in _UNARY if op != "Log1p"),
        Node("_Log1p", "Log1p", ("_Abs",)),
        *(Node(f"_{op}", op, ("_Abs", "_half")) for op in _BINARY),
    ]
    return policy_of(Graph(tuple(nodes)), [f"_{op}" for op in (*_UNARY, *_BINARY)])


def texts(policy: Policy, form: Format) -> list[str]:
    made = []
    for code in CODES:
        (first, *_) = form.artifact(policy, WriteOptions("{}", code=code)).files.values()
        made.append(first.to_bytes().decode())
    return made


@cache
def words() -> tuple[str, ...]:
    """Every word that a program of any language is made of."""
    policies = [p for name in FIXTURES for p in read_source(path(name)).policies()]
    found = set[str]()
    for form in PROGRAMS:
        for policy in (*policies, policy_with(["one", "two"])):
            for text in texts(policy, form):
                code = re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL)
                found |= set(re.findall(r"(?<![\w.])[A-Za-z]\w*", code))
    return tuple(sorted(w for w in found if not re.fullmatch(r"y\d+", w)))  # outputs of policy_with


def test_words_are_those_of_programs() -> None:
    assert {"for", "Math", "NAN", "Compute", "act", "at", "sum0", "System", "memset", "prototype"} - set(words()) == {
        "prototype"
    }


@pytest.mark.parametrize("code", CODES, ids=("plain", "own mathematics", "weights in a file"))
@each_program
def test_inputs_called_as_a_program_calls_something(
    form: Format, code: CodeOptions, tmp_path: Path, processes: RuntimePool
) -> None:
    runtimes = Runtimes(processes, tmp_path)
    runtimes.need(form.runtimes[0])
    names = list(words())
    policy = policy_with(names)
    random = np.random.default_rng(7)
    feeds = {n: random.normal(size=(1, 16)).astype(np.float32) for n in names}
    fetches = [policy.fetches[s.name] for s in policy.signature.outputs]
    expected = run_graph(policy.graph, feeds, fetches)
    found = runtimes.program(form.key, policy, feeds, code)
    for fetch, one in zip(fetches, found, strict=True):
        np.testing.assert_allclose(one, expected[fetch], rtol=2e-5, atol=2e-5, err_msg=fetch)


@pytest.mark.parametrize("name", ["act", "reset", "math", "float32Array", "exp", "block", "sizes", "bigInt", "int"])
@each_program
def test_policies_called_as_a_program_calls_something(form: Format, name: str, tmp_path: Path) -> None:
    """Draws, the state and the guard included. A header is compiled as the page says, with its folder as one of -I."""
    (policy,) = read_source(path("recurrent")).policies()
    named, expected, here = replace(policy, name=name), tmp_path / "expected", tmp_path / "found"
    if form.key == "c" and name == "math":
        with pytest.raises(UnsupportedOpError, match=r"a header cannot be called math\.h"):
            form.artifact(named, WriteOptions("{}"))
        return
    form.artifact(policy, WriteOptions("{}")).write(expected)
    form.artifact(named, WriteOptions("{}")).write(here)
    main = MAINS[form.key][0]
    wanted = said(build(form, main(called(policy)), expected), expected)
    assert said(build(form, main(called(named)), here), here) == wanted


def test_no_policy_takes_the_place_of_a_header() -> None:
    """Any header that is included, by programs or by others, is refused by name."""
    gcc = shutil.which("gcc") or pytest.skip("gcc is not installed")
    text = "".join(
        f"#include <{name}.h>\n" for name in ("stddef", "stdint", "float", "math", "string", "stdio", "stdlib")
    )
    command = [str(gcc), "-M", "-xc", "-"]
    made = subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout
    included = {Path(word).stem for word in made.split() if re.fullmatch(r"/usr/(lib/gcc/.*/|)include/[^/]*\.h", word)}
    assert {"math", "string", "features", "stdio"} <= included
    (policy,) = read_source(path("recurrent")).policies()
    for name in sorted({*included, "Math", "string", "float"}):
        with pytest.raises(UnsupportedOpError, match="a header cannot be called"):
            WRITTEN["c"].artifact(replace(policy, name=name), WriteOptions("{}"))


def test_a_header_is_judged_under_its_own_name(tmp_path: Path, processes: RuntimePool) -> None:
    """One that another tool has renamed does not compile, and was called right."""
    need(WRITTEN["c"])
    (result,) = export([path("continuous")], ExportOptions(tmp_path, ("bytes", "c"), verify="none"))
    text = (result.folder / "continuous.h").read_text()
    other = tmp_path / "math.h"
    other.write_text(text.replace("continuous_", "math_").replace("CONTINUOUS_", "MATH_"))
    report = compare_artefacts(result.folder / "continuous.bytes", other, pool=processes)
    assert report.passed is False
    assert "CompileError" in report.failures[0].reason


def test_no_macro_of_the_headers_is_a_member() -> None:
    """What gcc defines in the headers that a program includes, or anywhere; those that take arguments do no harm."""
    gcc = shutil.which("gcc") or pytest.skip("gcc is not installed")
    headers = ("stddef", "stdint", "float", "math", "string")
    text = "".join(f"#include <{h}.h>\n" for h in headers)
    made = subprocess.run([str(gcc), "-dM", "-E", "-"], input=text, capture_output=True, text=True, check=True).stdout
    macros = re.findall(r"^#define ([A-Za-z]\w*)(?![\w(])", made, re.MULTILINE)
    assert {"NAN", "FLT_MAX", "NULL", "linux"} <= set(macros)
    names = sorted({m for m in macros if not m.endswith("_")})
    header = header_of("p", policy_with(names).signature)
    assert not {f.name for f in header.inputs} & set(macros)
