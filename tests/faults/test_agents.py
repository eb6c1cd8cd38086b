"""Faults in what callers of source code call, ``act``, ``act_all``, ``choose`` and constants: each is caught."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.verify.checks.agents import agents
from export_model.exporter.verify.findings import Finding
from export_model.exporter.verify.participants import policy_under_test
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.verification import verify
from export_model.signatures.code import CodeOptions
from export_model.signatures.contract import Contract, Origin
from fixtures import FOLDER, path
from tests.exporting import verify_bundle
from tests.hostile.zoo_bundles import rehashed
from tests.programs.test_programs import need

pytestmark = pytest.mark.xdist_group("programs")

SOURCES = {
    **{name: path(name) for name in ("continuous", "recurrent", "discrete", "sampled", "visual")},
    "lstm": FOLDER / "torch_checkpoint" / "ppo_0_22_lstm.pt",
    "hybrid": FOLDER / "torch_checkpoint" / "ppo_0_24_hybrid.onnx",
    "drawn": FOLDER / "torch_checkpoint" / "ppo_1_1_discrete.onnx",
    "sb3": FOLDER / "sb3" / "sb3_stochastic.onnx",
}
EXTENSIONS = {"c": ".h", "csharp": ".cs", "js": ".mjs"}
FILES = {"c": "c", "csharp": "csharp", "js": "node"}

Plant = Callable[[str], str]


def swap(pattern: str, by: str) -> Plant:
    """Replace what a pattern finds, and be sure that it finds something."""

    def plant(text: str) -> str:
        changed, count = re.subn(pattern, by, text, flags=re.DOTALL)
        assert count, pattern
        return changed

    return plant


AGAIN = "does not go as it did"
_LEAST = (r"if \(best < drawn\)", "if (i == 0 || drawn < best)")
_SHARED = (
    r"(    public readonly float\[\] recurrent_in = )(new float\[\d+\])",
    r"    static readonly float[] _shared = \2;\n\1_shared",
)
_GLOBAL = (r"(this\.recurrent_in = )(new Float32Array\(\d+\))", r"\1(globalThis.shared ??= \2)")
_ON = (r"(memory->stream =) seed", r"static uint64_t n;\n    \1 seed + n++")
#: (format, policy, what is wrong, how, the word of a finding or its output)
FAULTS: list[tuple[str, str, str, Plant, str]] = [
    ("c", "continuous", "no noise", swap(r"(_normal\(memory, memory->epsilon), \d+\)", r"\1, 0)"), "epsilon"),
    ("c", "sb3", "twice the noise", swap(r"(out\[i\] = )", r"\g<1>2.0f * "), "epsilon"),
    ("c", "hybrid", "noise a seventh too wide", swap(r"(out\[i\] = )", r"\g<1>1.15f * "), "epsilon"),
    ("c", "visual", "one draw for all numbers", swap(r"(out\[i\] = )", r"out[i] = i ? out[0] : "), "epsilon"),
    ("c", "lstm", "one memory for all agents", swap(r"&memory\[i\], &output", "&memory[0], &output"), "recurrent_out"),
    ("c", "continuous", "one input for all", swap(r"_act\(&input\[i\]", "_act(&input[0]"), "deterministic_action"),
    ("c", "recurrent", "the last does not act", swap(r"i < agents; i", "i < agents - 1; i"), "deterministic_action"),
    ("c", "recurrent", "reset keeps the state", swap(r"    memset\(memory, 0, sizeof \*memory\);\n", ""), "self test"),
    ("c", "continuous", "draws go on", swap(*_ON), AGAIN),
    ("c", "sampled", "all seeds alike", swap(r"(memory->stream = )seed;", r"(void)seed;\n    \g<1>1;"), "draw alike"),
    ("c", "discrete", "the least likely class", swap(*_LEAST), "choose"),
    ("c", "discrete", "the likeliest", swap(r"(float drawn = )[^;]*;", r"\1row[i] + 0.0f * u;"), "choose"),
    ("c", "hybrid", "a forbidden class", swap(r"(action\[branch\] = )i;", r"\1(i + 1) % sizes[branch];"), "choose"),
    ("c", "recurrent", "branches exchanged", swap(r"_BRANCHES \{3, 2\}", "_BRANCHES {2, 3}"), "branch 1"),
    ("c", "drawn", "no masks in act", swap(r"none \? 1 : masks\[i\]", "1 + 0 * none"), "action"),
    ("csharp", "continuous", "no noise", swap(r"        _Normal\(this\.\w+\);\n", ""), "epsilon"),
    ("csharp", "lstm", "one memory for all agents", swap(*_SHARED), "recurrent_out"),
    ("csharp", "recurrent", "the likeliest", swap(r"(drawn = )[^;]*;", r"\1this.action[start + i] + 0 * u;"), "choose"),
    ("csharp", "recurrent", "branches exchanged", swap(r"\{ 3, 2 \};(?=\s+// What)", "{ 2, 3 };"), "branch 1"),
    ("csharp", "continuous", "draws go on", swap(r"stream = seed;", "stream += seed;"), AGAIN),
    ("js", "sb3", "twice the noise", swap(r"(out\[i\] = )", r"\g<1>2 * "), "epsilon"),
    ("js", "hybrid", "no noise", swap(r"        this\._normal\(this\.epsilon\);\n", ""), "epsilon"),
    ("js", "lstm", "one memory for all agents", swap(*_GLOBAL), "recurrent_out"),
    ("js", "discrete", "the least likely class", swap(*_LEAST), "choose"),
    ("js", "drawn", "all seeds alike", swap(r"BigInt\.asUintN\(64, BigInt\(seed\)\)", "1n"), "draw alike"),
    ("js", "recurrent", "branches exchanged", swap(r'"branches": \[3, 2\]', '"branches": [2, 3]'), "branch 1"),
]  # fmt: skip


def written(policy: Policy, key: str, folder: Path, code: CodeOptions | None = None) -> Path:
    """A policy as source code in a folder; the file."""
    code = code or CodeOptions()
    tool = {"name": "export-model", "version": "test", "code": code.to_dict()}
    contract = Contract(policy.name, policy.signature, Origin("test", "0" * 64), policy.source, tool)
    artifact = WRITTEN[key].artifact(policy, WriteOptions(contract.compact(), code=code))
    artifact.write(folder)
    return folder / artifact.main


def judged(policy: Policy, key: str, file: Path, scratch: Path, processes: RuntimePool) -> list[Finding]:
    """What the check of agents finds."""
    tested = policy_under_test(policy, {key: file}, scratch, sizes={})
    session = Session([FILES[key]], available_runtimes(), processes)
    return list(verify(tested, session, checks=(agents,)).comparisons)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: " ".join(fault[:3]))
def test_a_fault_is_caught(fault: tuple[str, str, str, Plant, str], tmp_path: Path, processes: RuntimePool) -> None:
    key, name, _, plant, word = fault
    need(WRITTEN[key])
    (policy,) = read_source(SOURCES[name]).policies()
    file = written(policy, key, tmp_path)
    file.write_text(plant(file.read_text()))
    failures = [c for c in judged(policy, key, file, tmp_path / "scratch", processes) if not c.passed]
    assert failures, "PASSED"
    assert {c.format for c in failures} == {key}
    assert any(word in f"{c.output} {c.reason}" for c in failures), [c.sentence() for c in failures]


@pytest.mark.parametrize("key", EXTENSIONS)
def test_the_planted_ones_pass_as_they_are(key: str, tmp_path: Path, processes: RuntimePool) -> None:
    """No alarm, with noise, state and draws; a guard counts as the contract says."""
    need(WRITTEN[key])
    for name, source in SOURCES.items():
        (policy,) = read_source(source).policies()
        code = (
            CodeOptions(guard=1.0)
            if name == "continuous"
            else CodeOptions(weights="file" if name == "lstm" else "source")
        )
        file = written(policy, key, tmp_path / name, code)
        found = judged(policy, key, file, tmp_path / f"{name} scratch", processes)
        assert {c.kind for c in found} >= {"acting"}, name
        assert [c.sentence() for c in found if not c.passed] == [], name


@pytest.mark.parametrize("key", EXTENSIONS)
def test_verify_says_which_agent(key: str, tmp_path: Path) -> None:
    """By the command that users give, with renewed hashes."""
    runtime = need(WRITTEN[key])
    (result,) = export([path("recurrent")], ExportOptions(tmp_path, ("bytes", key), verify="none"))
    file = result.folder / f"recurrent{EXTENSIONS[key]}"
    plant = swap(*_LEAST)  # of two classes at a time the less likely, nearly always
    file.write_text(plant(file.read_text()))
    rehashed(result.folder)
    report = verify_bundle(result.folder, runtimes=runtime)
    assert report.passed is False
    (failure,) = report.failures
    assert (failure.format, failure.output, failure.kind) == (key, "choose", "draws")
    assert re.fullmatch(r"act, step \d of 4, agent [123]", failure.worst_input or "")
