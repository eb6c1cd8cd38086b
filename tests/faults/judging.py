"""Faults planted into what an export really writes, and what export, verify and compare say of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.consumers.named_files import answered_outputs
from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.format import Artifact, Format, WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import node_of
from export_model.converters.graph.ops.samplers import SAMPLERS, reseed
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare.comparison import CompareOptions, compare_artefacts
from export_model.exporter.export import again, job
from export_model.exporter.export.job import Job
from export_model.exporter.export.names import Names
from export_model.exporter.export.pipeline import Exporter
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.report import ParityReport
from export_model.signatures.errors import ExportModelError, UnsupportedOpError
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_typical
from tests.faults.edits import ONE_MEMORY, Edit, edits
from tests.faults.families import Member
from tests.faults.plants import OF_ROWS, plants

#: Rows that tell whether a fault changes anything.
ROWS = 4096
WAYS = ("export", "verify", "compare")


@dataclass(frozen=True)
class Fault:
    """One fault of one member: of its graph, or of the file that is written."""

    kind: str
    tensor: str = ""
    policy: Policy | None = None
    edit: Edit | None = None


@dataclass
class Outcome:
    """What came of a fault, whether its place was named, and in which words.

    ``verdict``: caught, missed, no effect, too small to be seen, cannot be written; without a fault passed or caught.
    """

    family: str
    member: str
    kind: str
    tensor: str
    way: str
    verdict: str
    located: bool = False
    says: str = ""

    def __str__(self) -> str:
        return f"{self.verdict} by {self.way}: {self.member}: {self.kind} at {self.tensor or 'the file'}: {self.says}"


@dataclass
class Subject:
    """A member, compiled once: its faults, and what is said of each."""

    member: Member
    folder: Path
    pool: RuntimePool
    source: Path = field(init=False)
    job: Job = field(init=False)

    def __post_init__(self) -> None:
        self.source = self.member.source(self.folder)
        self._exporters = {v: Exporter(self.member.options(self.folder / "out", verified=v)) for v in (True, False)}
        (self.job, *others) = self._exporters[True].compile_source(self.source, Names(), lambda text: None)
        brain = self.job.policy.name.rpartition("-")[2] if others else None
        self._reading = replace(self.member.more.get("compile", CompileOptions()), brain=brain)

    def faults(self) -> Iterator[Fault]:
        """Every fault that it can have; of a graph, a function that makes it, so that few are made."""
        answered = answered_outputs(WRITTEN[self.member.form], self.job.policy.signature, self.job.code)
        alone = WRITTEN[self.member.form].program  # each agent is computed by itself
        for plant in (p for p in plants(self.job.policy, answered) if not alone or p.kind not in OF_ROWS):
            try:
                made = plant.plant()
            except ExportModelError:  # a shape that is not known: another tensor has the fault
                continue
            yield Fault(plant.kind, plant.tensor, policy=made)
        how = WriteOptions(self.job.policy.name, checked=False)
        with nullcontext(WRITTEN[self.member.form]) as form:
            if form.program or form.key == "onnx":
                written = form.artifact(self.job.policy, replace(how, contract="{}"))
                found = edits(form.key, written.files[written.main].to_bytes())
                recurrent = self.job.policy.signature.memory is not None
                yield from (Fault(k, edit=e) for k, e in found if recurrent or k != ONE_MEMORY)

    def judge(self, fault: Fault | None, way: str) -> Outcome:
        """What is said of a fault, of none where it is None."""
        kind, tensor = ("no fault", "") if fault is None else (fault.kind, fault.tensor)
        outcome = Outcome(self.member.family, self.member.label, kind, tensor, way, "caught")
        try:
            report = self._report(fault, way)
        except UnsupportedOpError as error:  # the format cannot have this fault
            outcome.verdict, outcome.says = "cannot be written", error.what
            return outcome
        except ExportModelError as error:
            outcome.says = f"{error.what}: {error.why}"
            return outcome
        if report.passed is False:
            outcome.located = fault is not None and self._is_located(report, fault)
            outcome.says = "; ".join(dict.fromkeys(f"{f.kind} {f.output}" for f in report.failures))
        elif fault is not None and (none := self._unseen(fault)):
            outcome.verdict = none
        else:
            outcome.verdict, outcome.says = "passed" if fault is None else "missed", report.verdict
        return outcome

    def ways(self) -> Sequence[str]:
        """How it can be judged: what a baked action is beside its source's is no question for ``compare``."""
        return WAYS[:2] if "bake" in self.member.more else WAYS

    def _report(self, fault: Fault | None, way: str) -> ParityReport:
        exporter = self._exporters[way == "export"]
        with planted(self.member.form, fault):
            (result,) = exporter.write_jobs([self.job], self.pool, lambda text: None)
        if result.report is not None:
            return result.report
        judges = self.member.judges
        if way == "verify":
            with mock.patch.object(again, "RuntimePool", lambda: nullcontext(self.pool)):
                return again.verify_folder(
                    result.folder, source=self.source, runtimes=judges, options=VerifyOptions(), allow_unverified=True
                )
        file = result.folder / WRITTEN[self.member.form].main_of(result.policy.name)
        judging = VerifyOptions(runtimes=judges)
        options = CompareOptions(
            judging=judging, understanding=self._reading, read=self.member.read, allow_unverified=True
        )
        return compare_artefacts(self.source, [file], options, pool=self.pool)

    def _is_located(self, report: ParityReport, fault: Fault) -> bool:
        """Whether a finding names the tensor or one that reads it, or says in words what is wrong with the output.

        Of a file's text: whether it names the function, or the entry of the metadata.
        """
        if fault.edit is not None:
            name = fault.kind.removeprefix("metadata: ").partition(" ")[0].rstrip(":")
            return any(name in f"{f.output} {f.worst_input} {f.reason}" for f in report.failures)
        graph = self.job.policy.graph
        near = {fault.tensor, *(n.name for n in graph.nodes if fault.tensor in map(node_of, n.inputs))}
        outputs = {o for o, t in self.job.policy.fetches.items() if node_of(t) in near}
        return any(
            (f.bisection is not None and f.bisection.tensor in near) or (f.output in outputs and bool(f.reason))
            for f in report.failures
        )

    def _unseen(self, fault: Fault) -> str:
        """Why a fault need not be seen; empty where it must be.

        No number beyond the tolerance and no decision is another on inputs of the policy's own; or, in a file that is
        not cut, only draws of classes are, by less than docs/agreement.md says is seen.
        """
        policy, other, signature = self.job.policy, fault.policy, self.job.policy.signature
        if other is None:  # among one class there is no choice
            return "no effect" if fault.kind.startswith("choose") and max(signature.branches) == 1 else ""
        draws = [n.name for n in policy.graph.nodes if n.op == "Multinomial"]
        fetches = [*policy.fetches.values(), *draws]
        drawn = policy.graph.descendants([n.name for n in policy.graph.nodes if n.op in SAMPLERS])
        changed, shares = set[str](), dict[str, list[tuple[np.ndarray, np.ndarray]]]()
        for number, case in enumerate(draw_typical(signature, seed=99, count=max(1, ROWS // 259))):
            feeds, rng = dict(case.feeds), np.random.default_rng(number)
            for spec in signature.inputs:
                if spec.role is Role.MASKS and number % 2:
                    feeds[spec.name] = _some_forbidden(rng, feeds[spec.name], signature.branches)
            fed = {policy.feeds[n]: a for n, a in feeds.items() if n in policy.feeds}
            made = []
            for each in (policy, other):
                reseed(number)
                odds = {n: each.graph[n].inputs[0] for n in draws}
                found = run_graph(each.graph, fed, [*fetches, *odds.values()])
                made.append(found | {f"odds of {n}": _softmax(found[o]) for n, o in odds.items()})
            changed |= {n for n in fetches if _differ(made[0][n], made[1][n])}
            for name in draws:
                shares.setdefault(name, []).append((made[0][f"odds of {name}"], made[1][f"odds of {name}"]))
        if not changed:
            return "no effect"
        apart = WRITTEN[self.member.form].program and all(node_of(n) in drawn for n in changed)
        return "too small to be seen" if apart and draws and not any(map(_is_seen, shares.values())) else ""


def _softmax(scores: np.ndarray) -> np.ndarray:
    wide = np.exp(scores.astype(np.float64) - scores.max(axis=-1, keepdims=True))
    return np.asarray(wide / wide.sum(axis=-1, keepdims=True))


def _is_seen(odds: Sequence[tuple[np.ndarray, np.ndarray]]) -> bool:
    """Whether a class's share is off by what is stated: 0.04 of one half, and as many deviations of any other."""
    one, other = (np.concatenate(each) for each in zip(*odds, strict=True))
    share = one.mean(axis=0)
    return bool((np.abs(one - other).mean(axis=0) > 0.08 * np.sqrt(share * (1 - share))).any())


def _some_forbidden(rng: np.random.Generator, masks: np.ndarray, branches: Sequence[int]) -> np.ndarray:
    """Masks that forbid a class of each branch of more than one."""
    made, start = masks.copy(), 0
    for size in branches:
        if size > 1:
            made[np.arange(len(made)), start + rng.integers(0, size, len(made))] = 0
        start += size
    return made


def _differ(one: np.ndarray, other: np.ndarray) -> bool:
    if one.shape != other.shape or one.dtype.kind != "f":
        return not np.array_equal(one, other)
    with np.errstate(invalid="ignore"):
        near = np.isclose(other, one, rtol=1e-5, atol=1e-5, equal_nan=True)
    return not bool(near.all())


@contextmanager
def planted(form: str, fault: Fault | None) -> Iterator[None]:
    """Have a format's artefacts written with the fault."""
    right = job._artifact

    def spoilt(kind: Format, policy: Policy, how: WriteOptions) -> Artifact:
        if fault is None or kind.key != form:
            return right(kind, policy, how)
        made = right(kind, policy, how)
        if fault.policy is not None:
            wrong = right(kind, replace(policy, graph=fault.policy.graph), how)
            if all(wrong.files[p].to_bytes() == made.files[p].to_bytes() for p in made.files):
                raise UnsupportedOpError("the file has nothing of it")
            return wrong
        assert fault.edit is not None
        content = made.files[made.main].to_bytes()
        changed = fault.edit(content)
        assert changed != content, "the fault is not in the file"
        return replace(made, files={**made.files, made.main: Pieces(changed)})

    with mock.patch.object(job, "_artifact", spoilt):
        yield
