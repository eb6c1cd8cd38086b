"""Source code driven as its callers do, by a program in this process: whatever it does otherwise is named."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.programs.members import header_of
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.agents import (
    AGENTS,
    CHOSEN,
    EVERY,
    SIZES,
    UNUSUAL,
    fields_of_agent,
    fields_with_size,
)
from export_model.exporter.verify.checks import agents as checked
from export_model.exporter.verify.checks.agents import agents
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import Participant, policy_under_test
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.verification import verify
from export_model.signatures.code import CodeOptions
from export_model.signatures.roles import Role
from tests.handmade import dense, node, placeholder
from tests.verify.judged import KNOWN, Model, Pool, compiled
from tests.verify.test_drawn import two_branches
from tests.verify.test_judge import branches, noisy, recurrent

Array = npt.NDArray[Any]
Arrays = Mapping[str, Array]
GUARD = 2.0


class Program:
    """Source code of a policy, as the kernels compute it; subclasses do something otherwise."""

    def __init__(self, policy: Policy) -> None:
        self.policy, self.graph = policy, runnable(policy.graph)
        self.header = header_of(policy.name, policy.signature, CodeOptions(outputs="all", guard=GUARD))
        self.samplers = [n for n in self.graph.nodes if n.op in ("RandomStandardNormal", "Multinomial")]
        self.state: Array | None = None
        self.rngs: list[np.random.Generator] = []

    def begin(self, seed: int) -> None:
        self.rngs = [np.random.default_rng(seed + i) for i in range(AGENTS)]
        self.state = None

    def normal(self, repeat: int, size: int) -> Array:
        """[repeat, agents, size]"""
        return np.stack([rng.standard_normal((repeat, size)) for rng in self.rngs], axis=1).astype(np.float32)

    def classes(self, log_probs: Array, count: int) -> Array:
        """[agents, count] by [agents, classes]."""
        odds = np.exp(log_probs.astype(np.float64) - log_probs.max(axis=1, keepdims=True))
        below = np.cumsum(odds / odds.sum(axis=1, keepdims=True), axis=1)[:, :-1]
        lots = np.stack([rng.random(count) for rng in self.rngs])
        return (lots[:, :, None] >= below[:, None, :]).sum(axis=2)

    def compute(self, feeds: Arrays, names: Sequence[str]) -> Arrays:
        return run_graph(self.graph, feeds, names)

    def keep(self, given: Array) -> Array:
        """What is fed in the next step."""
        return given

    def sizes(self) -> list[int]:
        known = self.policy.signature.branches
        return [*(f.size for f in fields_with_size(self.header)), *known, len(known)]

    def unusual(self, feeds: Arrays) -> list[int]:
        return [int((np.abs(feeds["state"][i] - 1) > GUARD * 2).sum()) for i in range(AGENTS)]

    def chosen(self, parts: Sequence[Array], count: int) -> Array:
        return np.stack([self.classes(part, count) for part in parts], axis=2)

    def run(self, feeds: Arrays, fetch: Sequence[str], drive: Mapping[str, Any] | None = None) -> dict[str, Array]:
        if drive is None:
            return dict(run_graph(self.graph, feeds, fetch))
        if drive["seed"] is not None:
            self.begin(drive["seed"])
        repeat, header = drive["repeat"], self.header
        fed = {n: np.tile(a, (repeat, *[1] * (a.ndim - 1))) for n, a in feeds.items()}
        drawn = {f.spec.name: self.normal(repeat, f.size) for f in header.noise}
        if header.state is not None:
            kept = np.zeros((AGENTS, header.state.size), np.float32) if self.state is None else self.state
            fed[header.state.spec.name] = np.tile(kept, (repeat, 1))
        fed |= {n: a.reshape(repeat * AGENTS, -1) for n, a in drawn.items()}
        for sampler in self.samplers:
            if sampler.op == "Multinomial":
                logits = run_graph(self.graph, feeds, [sampler.inputs[0]])[sampler.inputs[0]]
                fed[sampler.name] = self.classes(logits, repeat).T.reshape(-1, 1)
            else:
                fed[sampler.name] = self.normal(repeat, 2).reshape(-1, 2)
        outputs = [f.spec.name for f in fields_of_agent(header) if f.spec.name not in drawn]
        made = {n: a.reshape(repeat, AGENTS, -1) for n, a in self.compute(fed, outputs).items()} | drawn
        if header.next_state is not None:
            self.state = self.keep(made[header.next_state.spec.name][-1])
        answers = {n: a[-1] for n, a in made.items()} | {f"{EVERY}{n}": a for n, a in made.items()}
        field = header.choice_field(self.policy.signature.branches)
        edges = np.cumsum(self.policy.signature.branches)[:-1]
        scores = np.split(answers[field.spec.name], edges, axis=1) if field and drive["choose"] else []
        answers[CHOSEN] = self.chosen(scores, drive["choose"]) if scores else np.zeros((AGENTS, 0, 0))
        answers[SIZES], answers[UNUSUAL] = np.array(self.sizes()), np.array(self.unusual(feeds))
        return {n: answers[n] for n in fetch}

    def run_all(self, inputs: Sequence[Arrays], fetch: Sequence[str]) -> list[dict[str, Array]]:
        return [self.run(feeds, fetch) for feeds in inputs]


def masked() -> Policy:
    from tests.verify.test_inputs import masked as nodes

    return compiled(nodes())


def lifted() -> Policy:
    """The noise is an input."""
    nodes = [
        placeholder("vector_observation"),
        *dense("mean", "vector_observation", 3, 2),
        node("size", "Shape", "mean", T=np.float32, out_type=np.int32),
        node("random_normal/RandomStandardNormal", "RandomStandardNormal", "size", dtype=np.float32, T=np.int32),
        node("action", "Add", "mean", "random_normal/RandomStandardNormal", T=np.float32),
    ]
    return compiled(nodes, CompileOptions())


POLICIES: dict[str, Callable[[], Policy]] = {
    "lifted": lifted,
    "noisy": noisy,
    "recurrent": recurrent,
    "branches": lambda: branches(0.5),
    "drawn": two_branches,
    "masked": masked,
}


def judge_program(policy: Policy, folder: Path, program: type[Program] = Program) -> ParityReport:
    said = {"kind": "normal", "mean": [1.0], "std": [2.0]}
    inputs = tuple(replace(s, distribution=said) if s.role is Role.VECTOR else s for s in policy.signature.inputs)
    policy = replace(policy, signature=replace(policy.signature, inputs=inputs))
    tested = policy_under_test(policy, {}, folder, sizes={})
    contract = SimpleNamespace(
        name=policy.name, signature=policy.signature, tool={"code": {"outputs": "all", "guard": GUARD}}
    )
    made = program(policy)

    def participants(numpy: Model, failed: object) -> Iterator[Participant]:
        names = [s.name for s in policy.signature.outputs]
        yield Participant(
            format="c",
            runtime="c",
            run=made.run_all,
            outputs=names,
            model=made,
            path=tested.reference,  # type: ignore[arg-type]
        )

    session = Session(("numpy", "c"), KNOWN, Pool(), VerifyOptions(steps=4))  # type: ignore[arg-type]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checked, "contract_held", lambda path: contract)
        return verify(tested, session, participants, None, (agents,))  # type: ignore[arg-type]


def faults(report: ParityReport) -> set[tuple[str, str]]:
    return {(f.kind, f.output) for f in report.failures}


@pytest.mark.parametrize("name", POLICIES)
def test_a_program_that_does_as_it_should_passes(name: str, tmp_path: Path) -> None:
    report = judge_program(POLICIES[name](), tmp_path)
    assert not report.failures, [(f.kind, f.output, f.reason, f.worst_input) for f in report.failures]
    assert {f.kind for f in report.comparisons} <= {"acting", "draws"}
    judged = {f.output for f in report.comparisons}
    named = {s.name for s in POLICIES[name]().signature.outputs}
    assert judged & named == named or name in ("drawn", "noisy")
    assert (CHOSEN in judged) is (name in ("branches", "masked", "drawn"))


def otherwise(**methods: Any) -> type[Program]:
    return type("Otherwise", (Program,), methods)


def _computes(output: str, how: Callable[[Arrays, Array], Array]) -> type[Program]:
    def compute(self: Program, feeds: Arrays, names: Sequence[str]) -> Arrays:
        made = Program.compute(self, feeds, names)
        return {n: np.asarray(how(feeds, a), a.dtype) if n == output else a for n, a in made.items()}

    return otherwise(compute=compute)


# ------------------------------------------------------------------ numbers and memory


@pytest.mark.parametrize(
    "how",
    [
        lambda f, a: a * 0,
        lambda f, a: a + 5 * (f["state"][:, :1] > 0.2),
        lambda f, a: a + 1e-3,
        lambda f, a: np.where(np.arange(len(a))[:, None] % AGENTS == 2, a + 1, a),
    ],
)
@pytest.mark.parametrize(
    ("name", "output"), [("lifted", "action"), ("lifted", "deterministic_action"), ("recurrent", "action")]
)
def test_each_output_of_each_agent_is_compared(
    name: str, output: str, how: Callable[[Arrays, Array], Array], tmp_path: Path
) -> None:
    report = judge_program(POLICIES[name](), tmp_path, _computes(output, how))
    assert ("acting", output) in faults(report)
    assert all((f.worst_input or "").startswith("act, step ") for f in report.failures)


@pytest.mark.parametrize(
    "keep",
    [
        lambda self, given: given * 0,
        lambda self, given: given[:1].repeat(AGENTS, axis=0),
        lambda self, given: given[::-1],
        lambda self, given: given * 1.01,
    ],
)
def test_each_agent_has_a_memory_of_its_own(keep: Callable[[Program, Array], Array], tmp_path: Path) -> None:
    report = judge_program(recurrent(), tmp_path, otherwise(keep=keep))
    assert ("acting", "action") in faults(report)
    assert all(f.worst_input != "act, step 1 of 4" for f in report.failures)


# ------------------------------------------------------------------ draws


def _noise(how: Callable[[Array], Array]) -> type[Program]:
    return otherwise(normal=lambda self, repeat, size: how(Program.normal(self, repeat, size)))


NOISES: dict[str, Callable[[Array], Array]] = {
    "none": lambda a: a * 0,
    "twice": lambda a: 2 * a,
    "a seventh more": lambda a: 1.15 * a,
    "moved": lambda a: a + 0.6,
    "one for all agents": lambda a: a[:, :1].repeat(AGENTS, axis=1),
    "one for two numbers": lambda a: a[:, :, :1].repeat(2, axis=2),
    "one for two decisions": lambda a: a[::2].repeat(2, axis=0)[: len(a)],
    "NaN": lambda a: np.where(a > 3, np.nan, a),
}


@pytest.mark.parametrize("what", NOISES)
def test_noise_is_normal_for_each_agent_and_number(what: str, tmp_path: Path) -> None:
    report = judge_program(lifted(), tmp_path, _noise(NOISES[what]))
    found = faults(report)
    assert found and {kind for kind, _ in found if kind != "acting"} == {"draws"}, found


@pytest.mark.parametrize("what", ["none", "twice", "moved"])
def test_numbers_that_a_sampler_draws_are_as_the_reference_draws_them(what: str, tmp_path: Path) -> None:
    assert ("draws", "action") in faults(judge_program(noisy(), tmp_path, _noise(NOISES[what])))


@pytest.mark.parametrize("agent", range(AGENTS))
def test_each_agents_numbers_are_compared(agent: int, tmp_path: Path) -> None:
    moved = _noise(lambda a: a + (np.arange(AGENTS) == agent)[:, None].astype(np.float32))
    (fault,) = judge_program(noisy(), tmp_path, moved).failures
    assert (fault.kind, fault.output, fault.worst_input) == ("draws", "action", f"act, step 1 of 4, agent {agent + 1}")


CHOICES: dict[str, Callable[[Array], Array]] = {
    "the least likely": lambda p: -p,
    "all alike": lambda p: p * 0,
    "those of the first agent": lambda p: p[:1].repeat(AGENTS, axis=0),
    "hotter": lambda p: p / 1.5,
    "the best": lambda p: p * 1e3,
}


@pytest.mark.parametrize("what", CHOICES)
@pytest.mark.parametrize("name", ["branches", "masked", "drawn"])
def test_classes_are_chosen_by_their_odds(what: str, name: str, tmp_path: Path) -> None:
    def chosen(self: Program, parts: Sequence[Array], count: int) -> Array:
        return Program.chosen(self, [CHOICES[what](np.maximum(p, -30)) for p in parts], count)

    assert ("draws", CHOSEN) in faults(judge_program(POLICIES[name](), tmp_path, otherwise(chosen=chosen)))


@pytest.mark.parametrize("what", CHOICES)
def test_classes_that_act_draws_are_drawn_by_their_odds(what: str, tmp_path: Path) -> None:
    def classes(self: Program, log_probs: Array, count: int) -> Array:
        return Program.classes(self, CHOICES[what](log_probs), count)

    report = judge_program(two_branches(), tmp_path, otherwise(classes=classes))
    assert ("draws", "action") in faults(report)


@pytest.mark.parametrize(
    "exchanged", [lambda c: c[:, :, ::-1], lambda c: c + 1, lambda c: c[:1].repeat(AGENTS, axis=0)]
)
def test_each_branch_of_each_agent_is_chosen(exchanged: Callable[[Array], Array], tmp_path: Path) -> None:
    def chosen(self: Program, parts: Sequence[Array], count: int) -> Array:
        return exchanged(Program.chosen(self, parts, count))

    assert ("draws", CHOSEN) in faults(judge_program(branches(0.5), tmp_path, otherwise(chosen=chosen)))


# ------------------------------------------------------------------ beginnings and constants


@pytest.mark.parametrize("name", ["lifted", "noisy", "drawn"])
def test_an_episode_begins_with_its_seed(name: str, tmp_path: Path) -> None:
    count = iter(range(9))

    def begin(self: Program, seed: int) -> None:
        Program.begin(self, seed + 9 * next(count))

    (fault,) = judge_program(POLICIES[name](), tmp_path, otherwise(begin=begin)).failures
    assert fault.reason == checked.ANEW and fault.kind == "acting"


@pytest.mark.parametrize(
    ("name", "output"), [("lifted", None), ("noisy", "action"), ("drawn", "action"), ("branches", CHOSEN)]
)
def test_agents_draw_apart(name: str, output: str | None, tmp_path: Path) -> None:
    def begin(self: Program, seed: int) -> None:
        self.rngs, self.state = [np.random.default_rng(seed + i // 2) for i in range(AGENTS)], None

    report = judge_program(POLICIES[name](), tmp_path, otherwise(begin=begin))
    alike = {f.output for f in report.failures if f.reason == checked.ALIKE}
    wanted = {s.name for s in lifted().signature.noise} if output is None else {output}
    assert alike >= wanted or name == "noisy"


@pytest.mark.parametrize("place", range(6))
def test_the_sizes_that_a_file_states_are_right(place: int, tmp_path: Path) -> None:
    def sizes(self: Program) -> list[int]:
        return [n + (i == place) for i, n in enumerate(Program.sizes(self))]

    (fault,) = judge_program(branches(0.5), tmp_path, otherwise(sizes=sizes)).failures
    right = Program(branches(0.5)).sizes()[place]
    assert f" is {right + 1}, and there are {right}" in fault.reason and fault.kind == "acting"
    words = ["the size of state", "the size of action", "the size of deterministic_action"]
    words += ["the actions of branch 1", "the actions of branch 2", "branches"]
    assert words[place] in fault.reason


@pytest.mark.parametrize("how", [lambda n: n + 1, lambda n: 0 * n, lambda n: n[::-1]])
def test_unusual_numbers_are_counted_for_each_agent(how: Callable[[Array], Array], tmp_path: Path) -> None:
    def unusual(self: Program, feeds: Arrays) -> list[int]:
        return list(map(int, how(np.array(Program.unusual(self, feeds)))))

    (fault,) = judge_program(lifted(), tmp_path, otherwise(unusual=unusual)).failures
    assert "numbers of three agents unusual" in fault.reason
