"""What a program's members are before anything is written into them, and what the file says of each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.converters.formats.format import Format, WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.signatures.roles import Role
from fixtures import FOLDER, path
from tests.programs.mains import Called, called
from tests.programs.test_options import build, said
from tests.programs.test_programs import PROGRAMS

pytestmark = pytest.mark.xdist_group("programs")

CHECKPOINTS = ("poca_0_26_discrete", "ppo_0_24_hybrid", "ppo_0_22_discrete", "ppo_1_1_hybrid_lstm")
#: Of every family of ML-Agents that masks: log-probabilities, drawn in the graph, with memory, hybrid.
MASKED = (
    *(path(name) for name in ("discrete", "recurrent", "sampled")),
    *(FOLDER / "torch_checkpoint" / f"{name}.onnx" for name in CHECKPOINTS),
)

_C = """static void run_{p}(void)
{{
    static {p}_memory memory;
    static {p}_input input;
    static {p}_output output;
    {p}_reset(&memory, 1);
    {p}_act(&input, &memory, &output);
    for (int i = 0; i < {n}; i++) printf("%.9g\\n", (double)output.{scores}[i]);
    for (int i = 0; i < {first}; i++) input.{masks}[i] = i == 0;
    {p}_act(&input, &memory, &output);
    for (int i = 0; i < {n}; i++) printf("%.9g\\n", (double)output.{scores}[i]);
}}
"""
_CSHARP = """        {{
            var agent = new Policies.{p}(1);
            agent.Act();
            for (int i = 0; i < {n}; i++) System.Console.WriteLine(agent.{scores}[i].ToString("R"));
            for (int i = 0; i < {first}; i++) agent.{masks}[i] = i == 0 ? 1 : 0;
            agent.Act();
            for (int i = 0; i < {n}; i++) System.Console.WriteLine(agent.{scores}[i].ToString("R"));
        }}
"""
_JS = """{{
    const {{ default: Policy }} = await import("./{name}.mjs");
    const agent = new Policy(1);
    agent.act();
    for (let i = 0; i < {n}; i++) console.log(agent.{scores}[i]);
    for (let i = 0; i < {first}; i++) agent.{masks}[i] = i === 0 ? 1 : 0;
    agent.act();
    for (let i = 0; i < {n}; i++) console.log(agent.{scores}[i]);
}}
"""


def program(form: Format, policies: list[Called]) -> str:
    """Print the scores of each policy's untouched input, and of one whose first branch allows its first action."""
    parts, text = list[str](), {"c": _C, "csharp": _CSHARP, "js": _JS}[form.key]
    for name, header, *_ in policies:
        (masks,) = (f for f in header.inputs if f.spec.role is Role.MASKS)
        scores = next(f for f in header.outputs if f.spec.role is Role.LOG_PROBS)
        p, first = header.class_name if form.key == "csharp" else header.prefix, BRANCHES[name][0]
        parts.append(text.format(p=p, name=name, n=scores.size, scores=scores.name, masks=masks.name, first=first))
    if form.key == "js":
        return "".join(parts)
    if form.key == "csharp":
        return f"static class Program\n{{\n    static void Main()\n    {{\n{''.join(parts)}    }}\n}}\n"
    heads = [f'#define {c.header.prefix.upper()}_IMPLEMENTATION\n#include "{c.name}.h"\n' for c in policies]
    runs = "".join(f" run_{c.header.prefix}();" for c in policies)
    return f"{''.join(heads)}#include <stdio.h>\n{''.join(parts)}int main(void) {{{runs} return 0; }}\n"


BRANCHES: dict[str, tuple[int, ...]] = {}


def expected(policy: Policy) -> list[float]:
    """The scores by the kernels: nothing forbidden, then all but the first action of the first branch."""
    found, feeds = list[float](), dict[str, np.ndarray]()
    scores = next(s.name for s in policy.signature.outputs if s.role is Role.LOG_PROBS)
    for first in (True, False):
        for spec in policy.signature.inputs:
            shape = [n or 1 for n in spec.shape]
            if spec.role is Role.MEMORY_IN and not first:
                feeds[spec.name] = feeds[f"next {spec.name}"]
                continue
            feeds[spec.name] = np.zeros(shape, spec.dtype)
            if spec.role is Role.MASKS:
                feeds[spec.name][:] = 1
                if not first:
                    feeds[spec.name][0, 1 : policy.signature.branches[0]] = 0
        names = [scores, *([policy.signature.recurrence[1]] if policy.signature.recurrence else [])]
        fed = {policy.feeds[n]: a for n, a in feeds.items() if n in policy.feeds}
        made = run_graph(policy.graph, fed, [policy.fetches[n] for n in names])
        found += np.ravel(made[policy.fetches[scores]]).tolist()
        if policy.signature.recurrence:
            feeds[f"next {policy.signature.recurrence[0]}"] = made[policy.fetches[names[1]]]
    return found


@pytest.mark.parametrize("form", PROGRAMS, ids=lambda form: form.key)
def test_all_is_allowed_until_something_is_forbidden(form: Format, tmp_path: Path) -> None:
    """An input of zeros forbade every action of every branch, and one of these was drawn."""
    policies = [read_source(each).policies()[0] for each in MASKED]
    for policy in policies:
        BRANCHES[policy.name] = tuple(policy.signature.branches)
        form.artifact(policy, WriteOptions("{}")).write(tmp_path)
    text = program(form, [called(policy) for policy in policies])
    found = [float(x) for x in said(build(form, text, tmp_path), tmp_path)]
    wanted = [x for policy in policies for x in expected(policy)]
    assert len(found) == len(wanted)
    np.testing.assert_allclose(np.exp(found), np.exp(wanted), atol=1e-5)


@pytest.mark.parametrize("form", PROGRAMS, ids=lambda form: form.key)
def test_every_member_says_what_it_is(form: Format) -> None:
    """Masks, the previous action, the source's own name, whatever that is."""
    (policy,) = read_source(path("recurrent")).policies()
    named = [
        replace(s, source="vector_observation:0") if s.role is Role.VECTOR else replace(s, source="a*/b\\\n:0")
        for s in policy.signature.inputs
    ]
    policy = replace(policy, signature=replace(policy.signature, inputs=tuple(named)))
    (text,) = (p.to_bytes().decode() for p in form.artifact(policy, WriteOptions("{}")).files.values())
    assert "vector_observation, 6; in the source vector_observation" in text
    assert "masks, 5; 1: allowed, 0: forbidden; in the source a* /b__" in text
    assert "the caller copies here what was done, after each decision" in text
    assert "NaN is not looked for" in text
    (sampled,) = read_source(path("sampled")).policies()
    (text,) = (p.to_bytes().decode() for p in form.artifact(sampled, WriteOptions("{}")).files.values())
    assert "drawing by the agent's stream" in text and "zeros: without chance" not in text


def test_csharp_says_who_copies_the_previous_action() -> None:
    (policy,) = read_source(path("recurrent")).policies()
    (text,) = (p.to_bytes().decode() for p in WRITTEN["csharp"].artifact(policy, WriteOptions("{}")).files.values())
    assert (
        "/// <remarks>It does not change prev_action: copy there what was done.</remarks>\n    public void Act()"
        in text
    )
