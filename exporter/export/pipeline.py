"""The main job: sources in, verified bundles out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.files.fetch import path_text
from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.bundle import bundle
from export_model.converters.formats.format import Artifact, Format
from export_model.converters.formats.registry import DEFAULTS, WRITTEN, format_for_writing
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.job import (
    Job,
    artefacts_of,
    bake,
    check_bake,
    check_batch,
    check_code,
    check_opset,
    check_weights,
    fix_batch,
    own_in,
    sizes_unrounded,
    smaller,
    under_test,
)
from export_model.exporter.export.labels import check_labels, read_labels, with_labels
from export_model.exporter.export.names import Names, Naming
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.sources import Source, read_source
from export_model.exporter.remote.fetching import name_address, nearby
from export_model.exporter.remote.filesystem import remote
from export_model.exporter.remote.sending import check_free, check_sendable, landing
from export_model.exporter.tables import count_text
from export_model.exporter.verify.checks.size import check_budget
from export_model.exporter.verify.tolerances import check_rules
from export_model.signatures.contract import PARITY, Contract, safe_name
from export_model.signatures.errors import (
    ExportModelError,
    RefusedError,
    UsageError,
)
from export_model.signatures.fields import printable

if TYPE_CHECKING:
    from export_model.converters.consumers.profile import Profile
    from export_model.converters.runtimes.pool import RuntimePool
    from export_model.converters.runtimes.registry import RuntimeInfo
    from export_model.exporter.verify.report import ParityReport
else:
    ParityReport = Any  # help() evaluates the annotations of a Struct

Progress = Callable[[str], None]


class ExportResult(Struct, frozen=True):
    """One policy, written: its bundle (``<policy>.failed`` where the formats disagree), contract and report."""

    policy: Policy
    folder: Path
    agreed: Contract
    sizes: Mapping[str, int]
    report: ParityReport | None
    #: why it has another name than its source's, where it has
    renamed: str | None = None
    #: the formats that nobody asked for and that cannot hold it, and why
    left_out: tuple[str, ...] = ()
    #: what the formats would take with weights in float32, where these are kept in less
    whole_sizes: Mapping[str, int] = field(default_factory=dict)

    def __repr__(self) -> str:
        verdict = "not verified"
        if self.report is not None and self.report.passed is not None:
            from export_model.exporter.verify.verdict import checked_formats, formats_of

            count = f"{len(checked_formats(self.report))} of {count_text(len(formats_of(self.report)), 'format')}"
            verdict = f"{self.report.verdict} ({count})"
        return f"<ExportResult {self.policy.name!r} {verdict}: {', '.join(self.sizes)} in {path_text(self.folder)!r}>"

    def _repr_html_(self) -> str:
        from export_model.exporter.markup import notebook

        return notebook(repr(self)) if self.report is None else notebook(repr(self)) + self.report._repr_html_()

    @property
    def contract(self) -> Mapping[str, Any]:
        """What every artefact embeds: policy.json without the hashes of the files."""
        return self.agreed.to_dict()

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of the policy."""
        return (*self.policy.signature.notes, *([] if self.renamed is None else [self.renamed]), *self.left_out)

    def to_dict(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "name": self.policy.name,
            "folder": path_text(self.folder),
            "passed": self.passed,
            "sizes": dict(self.sizes),
            **({"whole_sizes": dict(self.whole_sizes)} if self.whole_sizes else {}),
            "parity": None if self.report is None else self.report.to_dict(),
        }

    @property
    def passed(self) -> bool | None:
        """Whether the formats agree; None where no independent runtime ran."""
        return None if self.report is None else self.report.passed


class Exporter:
    """Exports sources, one at a time, with options that were checked when it was made: what they choose is kept.

    Raises UsageError and RuntimeUnavailableError where the options cannot be had.
    """

    def __init__(self, options: ExportOptions) -> None:
        self.options = options
        wanted = None if options.profile is None else consumer(options.profile)
        self._formats = _formats(options, wanted)
        if not self._formats:
            raise UsageError("--to names no format", fix=f"the formats are {', '.join(WRITTEN)}")
        check_weights(options, self._formats)
        check_batch(options, self._formats)
        check_code(options, self._formats)
        check_opset(options, self._formats)
        check_bake(options)
        self._profile = wanted
        #: None where the writers of its formats give a policy the consumer's names
        self._dress = None if wanted is None or self._formats[0].key in wanted.own_names else wanted.dress
        self.runtimes: tuple[str, ...] = ()
        self._known: list[RuntimeInfo] = []
        if options.verify != "none":
            from export_model.converters.runtimes.pool import (
                chosen_runtimes,  # a cold start without verification needs none of it
            )

            self.runtimes, self._known = chosen_runtimes(options.verify, self._formats)
        _check_parity(options, self._formats)
        check_sendable(options.out)
        #: takes bundles that are staged and puts them in their places later (fleet/batch.py): stage, folder, place
        self.hold: Callable[[contextlib.ExitStack, Path, Path], None] | None = None
        self._labels = read_labels(options.labels)
        self._labelled_by = printable(Path(options.labels).name) if isinstance(options.labels, Path | str) else "labels"

    def check(self, paths: Sequence[Path | str | Source], progress: Progress) -> None:
        """Raise UsageError where names in ``--labels`` or ``--tolerances`` are nobody's.

        All sources are compiled ahead for it, where there are such names. What cannot be compiled is left to
        ``export``.
        """
        rules = self.options.parity.rules if self.runtimes else ()
        if not rules and "policies" not in (self._labels or {}):
            return
        names, outputs = Names(), dict[str, list[str]]()
        for path in paths:
            with contextlib.suppress(ExportModelError), near(path) as here:
                for job in self.compile_source(here, names, progress, path, []):
                    outputs[job.policy.name] = [s.name for s in job.policy.signature.outputs]
        check_rules(rules, outputs, {f.key: f.runtimes for f in self._formats}, self.runtimes)
        check_labels(self._labels, list(outputs))

    def compile_source(
        self,
        path: Path | str | Source,
        names: Naming,
        progress: Progress,
        given: Path | str | Source | None = None,
        refused: list[ExportModelError] | None = None,
    ) -> list[Job]:
        """The policies of a source, under the names that they will have.

        ``given`` is what it was called where it is another's copy. Raises ExportModelError; with ``refused``, which
        gets the errors, only where all of a folder is refused.
        """
        options, dress = self.options, self._dress
        progress(f"reading {path.path if isinstance(path, Source) else path}")
        source = path if isinstance(path, Source) else read_source(path, options.read, refused)
        progress(f"compiling {source.path}")
        if refused is None:
            found = list(source.compile_models(options.compile))
        else:
            found = source.compiled_or_refused(options.compile, refused)
            if isinstance(given, Path | str) and (address := remote(Path(given))) is not None:
                for error in refused:
                    name_address(error, source.path, address)
        if options.name is not None:
            if len(found) > 1:
                raise UsageError("--name goes with a single policy", fix="choose one with --brain, or leave --name out")
            found = [(model, replace(policy, name=options.name)) for model, policy in found]
        jobs = []
        origin = Path(given) if isinstance(given, Path | str) else source.path
        called = names.claim(origin, [safe_name(policy.name) for _, policy in found])
        for (model, policy), (name, note) in zip(found, called, strict=True):
            own = replace(policy, name=name)
            dressed = with_labels(own if dress is None else dress(own), self._labels, self._labelled_by)
            job = Job(source, model, dressed, self._profile, None if dress is None else own, note, code=options.code)
            job = job if options.bake is None else bake(job, options.bake)
            if options.batch is not None:
                job = fix_batch(job, options.batch, self._formats)
            elif self._profile is not None and self._profile.batch is not None:
                job = fix_batch(job, self._profile.batch, self._formats, f"--for {self._profile.name}")
            jobs.append(job if options.weights == "float32" else smaller(job, options.weights))
        return jobs

    def write_jobs(self, jobs: Sequence[Job], pool: RuntimePool | None, progress: Progress) -> Iterator[ExportResult]:
        """Write and verify the policies of a source, in the processes of ``pool`` where any runtime was chosen.

        Raises ExportModelError, before the first is written if it can.
        """
        for job in jobs:
            check_free(self.options.out, job.policy.name)
        progress(f"writing {', '.join(job.policy.name for job in jobs)}")
        made = [(j, *artefacts_of(j, self._formats, self.options)) for j in jobs]
        for number, (job, contract, artifacts, notes) in enumerate(made, 1):
            result = self._verify_job(job, contract, artifacts, pool, numbered_progress(progress, number, len(made)))
            yield replace(result, left_out=notes)

    def _verify_job(
        self, job: Job, contract: Contract, artifacts: Sequence[Artifact], pool: RuntimePool | None, progress: Progress
    ) -> ExportResult:
        """The bundle of a policy, verified and put in its place."""
        options, policy = self.options, job.policy
        whole_sizes = sizes_unrounded(job, [a.format for a in artifacts], options)
        with (
            contextlib.ExitStack() as staging,
            scratch_folder() if self.runtimes else nullcontext(Path()) as folder,
        ):
            out, put = staging.enter_context(landing(options.out))
            stage = staging.enter_context(bundle.stage_bundle(out / policy.name, contract, artifacts))
            report = None
            if self.runtimes:
                from export_model.exporter.verify.session import Session
                from export_model.exporter.verify.verification import verify

                assert pool is not None, "runtimes run in processes"
                tested = under_test(job, stage, artifacts, folder)
                session = Session(self.runtimes, self._known, pool, options.parity, progress)
                beside = replace(session, options=replace(options.parity, rules=(), golden=None, budget={}, require=()))
                report = verify(tested, session)
                if job.own is not None and not job.bake:
                    under = own_in(job, self._formats, folder / "own")
                    other = verify(under, beside)
                    report = join_reports(report, other)
                if job.whole is not None:
                    from export_model.exporter.verify.checks.decisions import decisions

                    whole = under_test(replace(job, policy=job.whole, whole=None), stage, (), folder / "whole")
                    own = verify(whole, beside)
                    report = join_reports(report, own, "the policy with its weights as they were, by the numpy kernels")
                    found = decisions(whole, tested, options.weights, session)
                    report = replace(report.with_findings(found), whole_sizes=whole_sizes)
                with bundle.writing(out):
                    (stage / PARITY).write_bytes(bundle.dumps(report.to_dict()))
            failed = report is not None and report.passed is False
            name = f"{policy.name}{bundle.FAILED}" if failed else policy.name
            if self.hold is None or out != options.out:
                place = put(stage, name)
            else:
                place = out / name
                self.hold(staging.pop_all(), stage, place)
        return ExportResult(
            policy=policy,
            folder=place,
            agreed=contract,
            sizes={a.format.key: a.size for a in artifacts},
            report=report,
            renamed=job.note,
            left_out=(),
            whole_sizes=whole_sizes,
        )


def export(
    paths: Sequence[Path | str | Source],
    options: ExportOptions,
    progress: Progress = lambda text: None,
    pool: RuntimePool | None = None,
    refused: Callable[[ExportModelError], None] | None = None,
    understood: Callable[[Sequence[Policy]], object] = lambda policies: None,
) -> Iterator[ExportResult]:
    """Export every policy of every source, one after the other.

    A path is read (once, if it is given twice), a Source was read already. A source that is refused, or a file of a
    folder, does not stop the others: ``refused`` is told, by default the errors of all are raised in the end
    (``RefusedError`` where there are several). A disagreement is in the result, not an exception. A ``pool`` that is
    given stays open, for callers that export many times. ``understood`` is called with the policies of a source before
    the first is written; what it raises refuses the source.
    """
    if not paths:
        raise UsageError("no source was given", fix="export-model FILE -o DIR")
    if options.name is not None and len(paths) > 1:
        raise UsageError("--name goes with a single policy", fix="export one source, or leave --name out")
    paths = list({id(p) if isinstance(p, Source) else Path(p): p for p in paths}.values())
    exporter, names = Exporter(options), Names()
    exporter.check(paths, progress)
    errors: list[ExportModelError] = []
    done = 0
    with contextlib.ExitStack() as opened:
        if pool is None and exporter.runtimes:
            from export_model.converters.runtimes.pool import RuntimePool

            pool = opened.enter_context(RuntimePool())
        for number, path in enumerate(paths, 1):
            told = numbered_progress(progress, number, len(paths))
            apart: list[ExportModelError] = []
            try:
                with near(path) as here:
                    jobs = exporter.compile_source(here, names, told, path, apart)
                    understood([job.policy for job in jobs])
                    for result in exporter.write_jobs(jobs, pool, told):
                        done += 1
                        yield result
            except ExportModelError as error:
                if len(paths) == 1 and not apart:
                    raise
                apart.append(error)
            errors += apart
            if refused is not None:
                for each in apart:
                    refused(each)
    if errors and refused is None:
        raise RefusedError(errors, max(len(paths), len(errors) + min(done, 1)))


def near(path: Path | str | Source) -> AbstractContextManager[Path | Source]:
    """A source where it can be read; what is at an address is fetched."""
    return nullcontext(path) if isinstance(path, Source) else nearby(Path(path))


def numbered_progress(progress: Progress, number: int, total: int) -> Progress:
    """Steps on one of several, with its number."""
    return progress if total == 1 else lambda text: progress(f"[{number}/{total}] {text}")


def consumer(name: str) -> Profile:
    """The profile that ``--for`` names. Raises UsageError."""
    from export_model.converters.consumers.profiles import profile  # most exports are for no consumer in particular

    return profile(name)


def _check_parity(options: ExportOptions, formats: Sequence[Format]) -> None:
    """What decides whether a policy passed is there, and is asked. Raises UsageError."""
    parity = options.parity
    if options.verify == "none":
        parity.check_unverified()
    check_budget(parity.budget, {f.key: 0 for f in formats})
    if parity.golden is not None:
        from export_model.exporter.verify.golden import read_recording

        read_recording(Path(parity.golden))


def _formats(options: ExportOptions, wanted: Profile | None) -> list[Format]:
    """What to write: ``--to``, or what the consumer of ``--for`` loads. Raises UsageError."""
    usual = DEFAULTS if wanted is None else wanted.formats[:1]
    asked = [format_for_writing(word) for word in (usual if options.targets is None else options.targets)]
    formats = list(dict.fromkeys(asked))
    if wanted is None:
        return formats
    targets = [f.key for f in formats]
    for target in targets:
        if target not in wanted.formats:
            raise UsageError(
                f"--to {target} does not go with --for {wanted.name}",
                why=f"{wanted.purpose}: it loads {', '.join(wanted.formats)}",
                fix="leave --to out",
            )
    if 0 < sum(t in wanted.own_names for t in targets) < len(targets):
        raise UsageError(
            f"--to {','.join(targets)} does not go with --for {wanted.name} at once",
            why="a bundle has one set of names, and these formats have different ones",
            fix="export twice, with another -o",
        )
    for flag, given, decided in (
        ("--names", options.compile.names, "names"),
        ("--opset", options.opset, f"opset: {wanted.opset}"),
    ):
        if given is not None:
            raise UsageError(
                f"{flag} {given} does not go with --for {wanted.name}",
                why=f"the consumer decides the {decided}",
                fix=f"leave {flag} out",
            )
    noise = options.compile.noise
    if noise is not None and noise not in wanted.noise and not wanted.own_names.issuperset(targets):
        raise UsageError(
            f"--noise {noise} does not go with --for {wanted.name}",
            why="nothing feeds noise there: the model draws it"
            if "keep" in wanted.noise
            else "the consumer acts without chance: its files have the action at no noise",
            fix=f"leave --noise out, or give --noise {' or '.join(wanted.noise)}",
        )
    return formats


#: What a second policy of a report is.
UNDER_OWN_NAMES = "the policy under its own names, from which this was made"


def join_reports(
    report: ParityReport,
    own: ParityReport,
    what: str = UNDER_OWN_NAMES,
) -> ParityReport:
    """The report of a policy, with what came of the one that it was made from."""
    said = own.verdict if own.passed is not None else f"{count_text(len(own.comparisons), 'comparison')} passed"
    note = f"{what}: {said}, against {own.reference}"
    passed = False if own.passed is False else report.passed
    comparisons, notes = (*report.comparisons, *own.failures), (*report.notes, note)
    return replace(
        report,
        passed=passed,
        comparisons=comparisons,
        notes=notes,
        self_consistent=own.self_consistent,
        original=own.original,
    )
