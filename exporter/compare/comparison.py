"""``export-model compare``: artefacts that any tool made, held against a reference.

Both sides are read as policies, by the rules of ``export``. A candidate whose own names, batch and memories are those
of the reference is fed as it is, in every runtime of its format (``Candidate``), as far as a file that anyone may have
made is given to one; any other answers for the policy that was read (``ReadCandidate``), tensor by tensor by its role.
What it lacks or has too much is a failure.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.compiler.passes.noise import has_seeds
from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.files.children.process import LoadedModel, RunFailedError
from export_model.converters.files.folders import scratch_folder, size_of
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.interfaces.differences import interface_differences
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool, chosen_runtimes, unverified_error
from export_model.exporter.compare.explaining import Explaining
from export_model.exporter.compare.matching import AnyCandidate, Candidate, match_candidates
from export_model.exporter.compare.reading import ReadCandidate, read_participants
from export_model.exporter.compare.weights import compare_rounded, merge_reports, rounded_to
from export_model.exporter.export.sources import read_source
from export_model.exporter.remote.fetching import nearby
from export_model.exporter.verify.checks.size import check_budget
from export_model.exporter.verify.checks.stated import check_own
from export_model.exporter.verify.difference import compare
from export_model.exporter.verify.findings import Finding, stated_finding
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import (
    Failure,
    Feeds,
    Participant,
    PolicyUnderTest,
    Run,
    load_model,
    loading,
    policy_under_test,
    write_reference,
)
from export_model.exporter.verify.reference import random_outputs
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.tolerances import Tolerance, check_rules
from export_model.exporter.verify.verification import Judge, verify
from export_model.signatures.errors import UsageError, naming
from export_model.signatures.sampling import draw_cases

_LOG = logging.getLogger(__name__)
Progress = Callable[[str], None]


class CompareOptions(Struct, frozen=True, kw_only=True):
    """How to compare."""

    #: a name of the reference → what the candidates call it
    names: Mapping[str, str] = field(default_factory=dict)
    #: runtimes, seed, samples, tolerances
    judging: VerifyOptions = field(default_factory=VerifyOptions)
    #: how to read the reference (the flags ``--input``, ``--output``, ``--step``, …)
    understanding: CompileOptions | None = None
    read: ReadOptions | None = None
    #: how to read the candidates
    candidate_understanding: CompileOptions | None = None
    candidate_read: ReadOptions | None = None
    #: no error where none of the candidates' runtimes is installed
    allow_unverified: bool = False


def compare_artefacts(
    reference: Path | str,
    candidates: Path | str | Sequence[Path | str],
    options: CompareOptions | None = None,
    *,
    progress: Progress = _LOG.info,
    understood: Callable[[Policy], object] | None = None,
    pool: RuntimePool | None = None,
    judge: Judge | None = None,
) -> ParityReport:
    """Compare files that any tool made with a reference; every format of a candidate that is a bundle takes part.

    - ``progress``: called with each step; the default logs them.
    - ``understood``: called with the reference as it was understood, before anything runs.
    - ``judge``: what is made of the candidates' participants, in place of a verification that names what differs.

    Raises ExportModelError where a file cannot be read, UsageError where a name of ``names`` is none,
    RuntimeUnavailableError where no runtime could run any.
    """
    options = options or CompareOptions()
    judging = options.judging
    if judging.runtimes == "none":
        judging.check_unverified(("--max-size",))
    with ExitStack() as opened:
        given = [candidates] if isinstance(candidates, Path | str) else candidates
        reference = opened.enter_context(nearby(Path(reference)))
        near = [opened.enter_context(nearby(Path(path))) for path in given]
        model, policy = _reference(reference, options.understanding, options.read)
        if understood is not None:
            understood(policy)
        reads = options.candidate_read, options.candidate_understanding
        matched = match_candidates(policy, reference, near, options.names, *reads)
        used, known = chosen_runtimes(judging.runtimes, [form for m in matched for form in m.forms])
        _check_options(judging, policy, matched, used)
        running = opened.enter_context(RuntimePool()) if pool is None else pool
        session = Session(used, known, running, judging, progress)
        explaining = Explaining()
        judge = judge or partial(verify, checks=(explaining,))
        comparison = _Comparison(policy, model, session, judge, Path(opened.enter_context(scratch_folder())))
        report = comparison.report(matched, rounded_to(reference))
    report = report.with_findings(finding for m in matched for finding in _interface_findings(policy, m))
    notes = [note for m in matched for note in (*m.notes(policy, used), *_interface_notes(policy, m))]
    ran = any(isinstance(m, Candidate) or m.place(used)[0] is None for m in matched)
    report = replace(
        report,
        notes=(*report.notes, *notes, *explaining.notes),
        self_consistent=report.self_consistent and not ran,
        causes=tuple(explaining.causes),
    )
    if report.passed is None and not report.undecided and not (options.allow_unverified or judging.runtimes == "none"):
        raise unverified_error([form for m in matched for form in m.forms], used, known)
    return report


def _interface_findings(policy: Policy, candidate: AnyCandidate) -> Iterator[Finding]:
    """A finding for each figure or name that a candidate states otherwise than the reference."""
    if candidate.path.is_file():
        yield from check_own(candidate.label, candidate.forms[0], candidate.path)
    ours, theirs = policy.signature.interface, candidate.interface
    if ours is not None and theirs is not None:
        for text in interface_differences(ours, theirs, candidate.input_names):
            yield stated_finding(candidate.label, text)


def _interface_notes(policy: Policy, candidate: AnyCandidate) -> Iterator[str]:
    sides = {"the reference": policy.signature.interface, candidate.label: candidate.interface}
    stating = [name for name, interface in sides.items() if interface]
    if len(stating) == 1:
        yield f"{stating[0]} alone states an interface: units, scales and names were not compared"


class _Comparison(Struct, frozen=True):
    """A reference, the runtimes that candidates run in, and what is made of them."""

    policy: Policy
    model: SourceModel
    session: Session
    judge: Judge
    folder: Path

    def report(self, matched: Sequence[AnyCandidate], own: Storage | None) -> ParityReport:
        """Compare the candidates; those whose weights were rounded otherwise than the reference's (``own``) apart."""
        reference = write_reference(self.policy, self.folder)
        copies = [(m, _safe_copy(m, self.folder / str(number))) for number, m in enumerate(matched)]
        kept = [None if m.weights == own else m.weights for m in matched]
        reports = []
        for storage in dict.fromkeys(kept):
            chosen = [copy for copy, of in zip(copies, kept, strict=True) if of == storage]
            sizes = {m.label: size_of(m.path) for m, _ in chosen}
            tested = policy_under_test(
                self.policy,
                {},
                self.folder,
                sizes=sizes,
                reference=reference,
                source=self.model.original,
                seeded=self.model.seeded or has_seeds(self.model.graph),
            )
            compared = partial(self._compare, chosen)
            if storage is None:
                reports.append(compared(tested))
            else:
                reports.append(compare_rounded(tested, self.policy, storage, self.folder, compared, self.session))
        return merge_reports(reports)

    def _compare(self, candidates: Sequence[tuple[AnyCandidate, Path]], tested: PolicyUnderTest) -> ParityReport:
        def taking_part(numpy_model: LoadedModel, failure: Failure) -> Iterator[Participant]:
            for candidate, copy in candidates:
                if isinstance(candidate, Candidate):
                    yield from self._participants(candidate, copy, numpy_model, failure)
                else:
                    running = self.session.runtimes, self.session.pool
                    yield from read_participants(candidate, self.policy, *running, copy, failure)

        return self.judge(tested, self.session, taking_part)

    def _participants(
        self, candidate: Candidate, path: Path, numpy_model: LoadedModel, failure: Failure
    ) -> Iterator[Participant]:
        """The candidate in each runtime that runs its format; what does not load or fit goes to ``failure``."""
        chosen = [r for r in candidate.format.runtimes if r in self.session.runtimes and r != "numpy"]
        for runtime in chosen:
            again = loading(runtime, path, candidate.ports.options, partial(_run_renamed, candidate))
            for model, run in load_model(again, self.session.pool, partial(_not_loaded, candidate, failure, runtime)):
                blocked = any(p.blocking for p in candidate.problems)
                hints = {} if blocked else _same_numbers(candidate, self.policy, numpy_model, model)
                _misfits(candidate, failure, runtime, hints)
                if candidate.outputs and not blocked:
                    yield Participant(
                        format=":".join(
                            (candidate.format.key, *filter(None, [candidate.ports.options.get("signature")]))
                        ),
                        runtime=runtime,
                        run=run,
                        outputs=list(candidate.outputs),
                        model=model,
                        label=candidate.label,
                        drawn=candidate.drawn,
                        path=path,
                        fed=candidate.own_feeds,
                        called={**{n: p.name for n, p in candidate.inputs.items()}, **candidate.outputs},
                        again=again,
                    )


def _check_options(
    options: VerifyOptions, policy: Policy, matched: Sequence[AnyCandidate], runtimes: Sequence[str]
) -> None:
    """Raise UsageError where a budget or a tolerance is for something that takes no part."""
    check_budget(options.budget, {m.label: 0 for m in matched})
    outputs = {policy.name: [s.name for s in policy.signature.outputs]}
    check_rules(options.rules, outputs, {m.format.key: m.format.runtimes for m in matched}, runtimes)


def _reference(
    path: Path, understanding: CompileOptions | None, read: ReadOptions | None
) -> tuple[SourceModel, Policy]:
    source = read_source(path, read)
    found = list(source.compile_models(understanding))
    if len(found) > 1:
        raise UsageError(
            f"the reference holds {len(found)} policies",
            where=str(path),
            why=", ".join(p.name.removeprefix(f"{source.stem(m)}-") for m, p in found),
            fix="choose one with --brain, or give one model of it",
        )
    return found[0]


def _safe_copy(candidate: AnyCandidate, folder: Path) -> Path:
    """A copy of the candidate as far as a runtime may be given it: anyone may have made it. Raises ExportModelError.

    One that was read is run within its reader's own rules: for it the folder is empty.
    """
    if isinstance(candidate, ReadCandidate):
        folder.mkdir()
        return folder
    found, ports = candidate.format, candidate.ports
    folder.mkdir()
    if found.vetted is None:
        return ports.path
    fed = [p.name for p in candidate.inputs.values()]
    wanted = [str(ports.options["signature"])] if found.signatures else [*candidate.outputs.values(), *fed]
    with naming(ports.path):
        return found.vetted(ports.path, [*wanted, *candidate.constant], folder)


def _not_loaded(candidate: Candidate, failure: Failure, runtime: str, error: RunFailedError, output: str) -> None:
    failure(candidate.label, runtime, error, output)
    _misfits(candidate, failure, runtime, {})


def _misfits(candidate: Candidate, failure: Failure, runtime: str, hints: Mapping[str, str]) -> None:
    for problem in candidate.problems:
        failure(candidate.label, runtime, RunFailedError(problem.text + hints.get(problem.name, "")), problem.name)


def _same_numbers(candidate: Candidate, policy: Policy, numpy_model: LoadedModel, model: LoadedModel) -> dict[str, str]:
    """Missing output → a hint, where an output under another name has its numbers."""
    left = [p.name for p in candidate.ports.outputs if p.name not in candidate.outputs.values()]
    drawn = random_outputs(policy.graph, candidate.missing)
    wanted = [n for n in candidate.missing if n not in drawn]
    if not wanted or not left or candidate.ports.open:
        return {}
    case = draw_cases(policy.signature)[1]
    try:
        (answers,) = _run_renamed(replace(candidate, outputs={n: n for n in left}), model)([case.feeds], left)
    except RunFailedError:  # said where it is run for the comparison
        return {}
    expected = numpy_model.run(case.feeds, wanted)
    hints = {}
    for name in wanted:
        same = [o for o in left if compare(expected[name], answers[o], Tolerance(), narrowed=True).passed]
        if same:
            hints[name] = f"; the numbers of {same[0]!r} are the same: --map {name}={same[0]}"
    return hints


def _run_renamed(candidate: Candidate, model: LoadedModel) -> Run:

    def run(inputs: Sequence[Feeds], fetch: Sequence[str]) -> list[dict[str, np.ndarray]]:
        answers = model.run_all([candidate.own_feeds(feeds) for feeds in inputs], [candidate.outputs[n] for n in fetch])
        return [{n: answer[candidate.outputs[n]] for n in fetch} for answer in answers]

    return run
