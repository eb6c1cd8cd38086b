"""Run a policy's formats in their runtimes, and have every check compare each with the reference."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import closing

from msgspec.structs import replace

from export_model.converters.files.children.process import LoadedModel, RunFailedError
from export_model.converters.runtimes.pool import BY_NAME, INDEPENDENT
from export_model.exporter.verify.asked import Inputs
from export_model.exporter.verify.checks.agents import agents
from export_model.exporter.verify.checks.baked import check_baked
from export_model.exporter.verify.checks.consumer import consumers
from export_model.exporter.verify.checks.draws import draws
from export_model.exporter.verify.checks.finite import check_defined
from export_model.exporter.verify.checks.numbers import check_recording, numbers
from export_model.exporter.verify.checks.rollout import rollout
from export_model.exporter.verify.checks.size import check_budget, sizes
from export_model.exporter.verify.checks.stated import check_stated
from export_model.exporter.verify.findings import Finding, failure, undecided_finding, undecided_reference
from export_model.exporter.verify.participants import (
    Failure,
    Participant,
    PolicyUnderTest,
    in_order,
    needed_runtimes,
    participants_of,
    unfit_reason,
)
from export_model.exporter.verify.reference import Reference
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.trial import Trial
from export_model.exporter.verify.verdict import NOT_ASKED, key_of, required_reason

#: Who takes part beside the reference: given the numpy reference and where failures go.
Participants = Callable[[LoadedModel, Failure], Iterable[Participant]]
#: What is made of participants: ``verify``, or something with its first parameters.
Judge = Callable[[PolicyUnderTest, Session, Participants | None], ParityReport]
Check = Callable[[Trial, Participant], Iterator[Finding]]
#: What each participant is put through, one after the other.
CHECKS: tuple[Check, ...] = (numbers, rollout, draws, agents)


def verify(
    tested: PolicyUnderTest,
    session: Session,
    participants: Participants | None = None,
    inputs: Callable[[Reference], Inputs] | None = None,
    checks: Sequence[Check] = CHECKS,
) -> ParityReport:
    """The report on one policy. A runtime that fails is a finding, not an exception.

    ``participants`` says who takes part, given the numpy reference; without it, the policy's artefacts do. ``inputs``
    gives what is asked in place of inputs that are drawn, ``checks`` what each participant is put through. Raises
    UsageError, before anything runs, where an option does not fit the policy.
    """
    check_budget(session.options.budget, tested.sizes)
    trial = Trial(tested, session.pool, session.options)
    reference, findings, notes = "none", list[Finding](), list[str]()
    if session.runtimes:
        session.progress(f"{tested.name}: starting the runtimes, running the source")
        session.pool.start(needed_runtimes(tested, session.runtimes))
        with Reference(tested, session.runtimes, session.pool, session.options.seed) as answering, closing(trial):
            reference = answering.name
            findings += _findings(trial, answering, session, participants, inputs, checks)
        notes = trial.notes()
    findings += check_stated(tested.files, tested.signature)
    findings += consumers(tested.profile, tested.files, memory=tested.signature.memory is not None)
    return _report(trial, reference, session, in_order(findings, tested), notes)


def _findings(
    trial: Trial,
    reference: Reference,
    session: Session,
    participants: Participants | None,
    inputs: Callable[[Reference], Inputs] | None,
    checks: Sequence[Check],
) -> list[Finding]:
    findings: list[Finding] = [*reference.failures]
    try:
        if inputs is not None:
            trial.replace_inputs(inputs(reference))
        trial.ask(reference)
    except RunFailedError as error:
        return [
            *findings,
            undecided_reference("reference" if reference.original is None else "source", reference.runtime, error),
        ]
    findings += check_recording(trial)
    findings += check_defined(trial)
    findings += check_baked(trial)

    def add_failure(kind: str, runtime: str, error: RunFailedError, output: str) -> None:
        findings.append(failure(kind, runtime, error, output))

    taking_part: Iterable[Participant]
    if participants is None:
        taking_part = participants_of(trial.tested, session.runtimes, trial.pool, reference, add_failure)
    else:
        taking_part = participants(reference.model, add_failure)
    for participant in taking_part:
        session.progress(f"{trial.tested.name}: {participant.name} in {participant.runtime}")
        try:
            for check in checks:
                made = list(check(trial, participant))
                findings += [*made, *_unproven(made)]
        except RunFailedError as error:
            add_failure(participant.name, participant.runtime, error, "*")
        finally:
            trial.bisector.close()
    return findings


def _unproven(findings: Sequence[Finding]) -> Iterator[Finding]:
    """Findings of outputs that passed though NaN or infinity stands beside a number: they are not verified."""
    for found in findings:
        for each in (f for f in found.forgiven if found.passed and f.excuse.unproven):
            reason = f"NaN or infinity beside a number in {each.elements:,} of {found.elements:,} elements of "
            reason += f"{found.output}, at far inputs: {each.excuse.title}"
            yield undecided_finding(found.format, found.runtime, found.output, reason)


def _report(
    trial: Trial,
    reference: str,
    session: Session,
    findings: Sequence[Finding],
    notes: Sequence[str],
) -> ParityReport:
    tested, options = trial.tested, session.options
    versions = trial.pool.versions()
    tried = {f.runtime for f in findings}  # one that died has no version any more, but it ran
    states: dict[str, dict[str, str | None]] = {}
    for info in session.known:
        unfit = unfit_reason(info.name, tested)
        ran = info.name in session.runtimes and (info.name in versions or info.name in tried) and not unfit
        reason = None if ran else NOT_ASKED if info.installed else f"not installed; {info.how}"
        if unfit and info.name in session.runtimes:
            reason = unfit
        states[info.name] = {
            "version": versions.get(info.name, info.version),
            "status": "ran" if ran else "not run",
            "reason": reason,
        }
    # A recording held against the source says nothing of what was written.
    independent = any(f.runtime in INDEPENDENT and f.format not in ("golden", "source") for f in findings)
    findings = [*findings, *sizes(options.budget, tested.sizes)]
    open_ = any(not f.passed and not f.disagrees for f in findings)
    passed = False if any(f.disagrees for f in findings) else True if independent and not open_ else None
    report = ParityReport(
        policy=tested.name,
        passed=passed,
        seed=options.seed,
        samples=options.samples,
        reference=reference,
        runtimes=states,
        comparisons=tuple(findings),
        sizes=tested.sizes,
        notes=(*tested.signature.notes, *notes),
        self_consistent=not _may_run(tested, session.runtimes) and not tested.runs_elsewhere,
        original=reference.removeprefix("source/") if reference.startswith("source/") else None,
    )
    return _with_required(report, options.require)


def _may_run(tested: PolicyUnderTest, runtimes: Collection[str]) -> bool:
    """Whether a runtime that is asked for, or that a word takes, runs the source by itself."""
    runtime = None if tested.source is None else tested.source.runtime
    return runtime is not None and (runtime in runtimes or runtime not in BY_NAME)


def _with_required(report: ParityReport, wanted: Collection[str]) -> ParityReport:
    """Return the report with a finding for each format that was required (``--require``) and that nothing checked."""
    missing = [k for k in report.unchecked if "all" in wanted or key_of(k) in wanted]
    missing += [k for k in wanted if k != "all" and k not in map(key_of, report.sizes)]
    if not missing:
        return report
    reason = required_reason(report, missing)
    found = tuple(undecided_finding(kind, "none", "*", reason) for kind in missing)
    passed = report.passed if report.passed is False else None
    return replace(report, passed=passed, comparisons=(*report.comparisons, *found))
