"""A bundle that was written, verified again: hashes first, then its formats against its source or its own graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.bundle.bundle import Bundle, unfit
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.format import Format
from export_model.converters.formats.programs.artifact import can_confine
from export_model.converters.formats.registry import FROZEN_GRAPH, KERNELS, WRITTEN, own_reference
from export_model.converters.formats.saved_model.writer import signatures_of
from export_model.converters.formats.source import NO_NORMALISER, OriginalRun, ReadOptions
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool, chosen_runtimes, unverified_error
from export_model.exporter.export.job import Job, own_in, runs_elsewhere
from export_model.exporter.export.options import storage_of
from export_model.exporter.export.pipeline import Progress, consumer, join_reports
from export_model.exporter.export.remade import baked_again, compiled_again, made_again, read_back, tensors
from export_model.exporter.export.sources import Source, read_source
from export_model.exporter.verify.checks.decisions import decisions
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.participants import policy_under_test, write_reference
from export_model.exporter.verify.plays import read_plays
from export_model.exporter.verify.report import ParityReport
from export_model.exporter.verify.session import Session
from export_model.exporter.verify.verdict import reference_text
from export_model.exporter.verify.verification import verify
from export_model.signatures.code import CodeOptions
from export_model.signatures.contract import POLICY, READ_BY, Contract
from export_model.signatures.errors import BundleError, UsageError, naming
from export_model.signatures.fields import printable
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature

#: Of a bundle whose policy is not made from its source by any choice that is known.
OWN_REFERENCE = (
    "the source gives other inputs and outputs: the bundle was exported with options; what the source's own tensors do "
    "not answer is held against the bundle's own {}, and so is what is drawn"
)


class _Given(Struct, frozen=True):
    """What a bundle is held against.

    That is its source as it was read, and what runs that; or, of a bundle in a consumer's names, the policy made from
    the source once more.
    """

    source: Source | None = None
    original: OriginalRun | None = None
    again: Job | None = None


class _Case(Struct, frozen=True, kw_only=True):
    """A bundle as it is verified: the formats that are run, with its files, and the source code that is not."""

    bundle: Bundle
    formats: list[Format]
    programs: list[str]
    #: the format that the numpy kernels run beside ``.bytes``, where the bundle has it
    judge: Format | None
    made_for: str | None
    #: nothing is run: the checkers of the consumer are asked alone
    asked: bool

    @property
    def artefacts(self) -> dict[str, Path]:
        """Format → the path that a loader is given."""
        return {f.key: self.bundle.path(f) for f in self.formats}

    @property
    def reference(self) -> Path:
        """The file that the kernels run where the source is not."""
        if self.judge is None and self.made_for is None:
            return self.bundle.graph_file
        return self.bundle.path(self.judge or self.formats[0])


def verify_folder(
    folder: Path,
    *,
    source: Path | None = None,
    step: int | None = None,
    trust_source: bool = False,
    runtimes: str | Sequence[str] = "auto",
    options: VerifyOptions | None = None,
    allow_unverified: bool = False,
    progress: Progress = lambda text: None,
) -> ParityReport:
    """Verify a bundle again: hashes first, then every format in the runtimes.

    Without ``source`` the reference is the bundle's own ``.bytes``, without that its ``.nn``, without that the first
    other file that is read back. Raises BundleError, and RuntimeUnavailableError when no independent runtime ran
    (unless ``allow_unverified``, or there is only a ``.nn``, which no runtime outside Unity has).
    """
    if step is not None and source is None:
        raise UsageError(f"--step {step} goes with --source", fix="give the folder of the run: --source FOLDER")
    if (
        runtimes == "none" and options is not None
    ):  # sizes are compared all the same, and the kernels replay a recording
        replayed = ("--golden", "--atol", "--rtol", "--tolerances") if options.golden is not None else ()
        options.check_unverified(("--max-size", *replayed))
    found = Bundle.open(folder)
    found.verify_hashes()
    given = _Given() if source is None else _evidence_of(found, _source_of(source, found.contract, step, trust_source))
    case = _case(found, given)
    if case.asked:
        _check_asked(found, str(case.made_for), runtimes, options)
    for form in (f for f in WRITTEN.values() if found.has(f) and f.held is not None):
        assert form.held is not None
        with naming(found.path(form)):
            found.verify_contract(form.held(found.path(form)))
            if (
                form.misstatement is not None
                and (what := form.misstatement(found.path(form), found.signature)) is not None
            ):
                raise unfit(found.path(form), what, f"it is not what {POLICY} says of the interface")
    own = case.judge or FROZEN_GRAPH
    if case.judge is None and case.made_for is None and given.again is None:
        again, own = read_back(found)
        given = replace(given, again=again)
    report = _run(case, given, runtimes, options, progress)
    if case.programs:
        report = _with_note(
            report,
            f"not compiled again: {', '.join(case.programs)}: source code may be any program, and nothing confines "
            "one here; its bytes were compared",
        )
    if case.asked:
        return _with_note(
            report,
            f"made for {case.made_for}: its bytes and what the consumer's checkers say were verified; its numbers were "
            "compared when it was exported, and are again with --source FILE",
        )
    report = _with_own_reference(report, case, given, own)
    report = replace(report, played=read_plays(folder))
    return _unless_unverified(report, case, None if allow_unverified or runtimes == "none" else runtimes)


def _with_own_reference(report: ParityReport, case: _Case, given: _Given, own: Format) -> ParityReport:
    """The report, which says what of it was held against the bundle's own file, if anything was."""
    if given.source is not None and (given.again is not None or case.judge is None):
        return report
    if given.original is None:
        report = replace(report, reference=f"{own.key}/{KERNELS}", self_consistent=False)
    if given.source is None:
        return _with_note(report, f"the source was not given: the reference is {reference_text(report)}")
    return _with_note(report, OWN_REFERENCE.format(own.main_of(case.bundle.name)))


def _with_note(report: ParityReport, note: str) -> ParityReport:
    return replace(report, notes=(*report.notes, note))


def _unless_unverified(report: ParityReport, case: _Case, required: str | Sequence[str] | None) -> ParityReport:
    """Return the report; raise RuntimeUnavailableError where no independent runtime ran of those ``required``."""
    (first, *others) = case.formats
    if report.passed is not None:
        return report
    if first.elsewhere and not others:
        # No runtime that is here has it, so none can be asked for: the files are whole and one contract says so.
        return _with_note(
            report,
            f"only {first.elsewhere} runs a .{first.key}: its bytes, its contract and that it answers by our own "
            "reader were verified",
        )
    if required is not None and not report.undecided:
        raise unverified_error(case.formats, *chosen_runtimes(required, case.formats), str(case.bundle.folder))
    return report


def _evidence_of(found: Bundle, read: Source) -> _Given:
    """What the source says of a bundle. Raises BundleError where it is another, or means something else."""
    contract, made_for = found.contract, found.contract.tool.get("profile")
    if contract.tool.get("bake") is not None:
        return _Given(read, _original_of(read, contract), baked_again(read, contract))
    if made_for is None:
        original = _original_of(read, contract)
        try:
            again = compiled_again(read, contract)
        except BundleError:  # it was exported with options that no contract keeps
            _check_meaning(read, contract, found.folder)
            if original is None and own_reference([f.key for f in WRITTEN.values() if found.has(f)]) is None:
                raise
            return _Given(read, original)
        if any(ours != its for _, ours, its in _meanings(contract.signature, again.policy.signature)):
            _check_meaning(read, contract, found.folder)
        return _Given(read, original, again)
    wanted = consumer(made_for)
    if wanted.own_names.isdisjoint(f.key for f in WRITTEN.values() if found.has(f)):
        # Names of a consumer are not those of the source: what it was made from is dressed anew, and held against it.
        return _Given(read, again=made_again(read, contract, wanted))
    return _Given(read, _original_of(read, contract))


def _case(found: Bundle, given: _Given) -> _Case:
    formats = [f for f in WRITTEN.values() if found.has(f)]
    judge = own_reference([f.key for f in formats])
    made_for = found.contract.tool.get("profile")
    programs = [] if can_confine() else [f.key for f in formats if f.program]
    return _Case(
        bundle=found,
        formats=[f for f in formats if f.key not in programs] or formats,
        programs=programs,
        judge=judge,
        made_for=made_for,
        # Without the source, it is the consumer alone that is asked.
        asked=given.again is None and made_for is not None and judge is None,
    )


def _policy_of(case: _Case, given: _Given) -> Policy:
    """The policy as its bundle has it: its contract, with the graph of one of its files. Raises BundleError."""
    found = case.bundle
    signature, source = found.contract.signature, found.contract.source
    if FROZEN_GRAPH.key in case.artefacts:
        with naming(case.reference):
            embedding = found.graph()
        graph = _whole_graph(embedding, _names(signature), case.artefacts)
        with naming(case.reference):
            found.check_graph(runnable(graph))
    else:
        graph = _outline(signature, noise_kept=source.noise_kept)
    graph = graph if given.again is None else given.again.policy.graph
    inputs, outputs = ({s.name: s.name for s in specs} for specs in (signature.inputs, signature.outputs))
    return Policy(found.name, graph, signature, inputs, outputs, source)


def _names(signature: PolicySignature) -> list[str]:
    return [s.name for s in (*signature.inputs, *signature.outputs)]


def _run(
    case: _Case, given: _Given, runtimes: str | Sequence[str], options: VerifyOptions | None, progress: Progress
) -> ParityReport:
    """Verify the files, and the policy that a consumer's was made from beside them."""
    policy, found, again = _policy_of(case, given), case.bundle, given.again
    used, known = chosen_runtimes(runtimes, case.formats)
    running = used or (KERNELS,)
    with scratch_folder() as scratch, RuntimePool() as pool:
        tested = policy_under_test(
            policy,
            _safe_copies(case.artefacts, _names(policy.signature), list(signatures_of(policy)), scratch),
            scratch,
            sizes={f.key: found.size(f) for f in case.formats},
            reference=case.reference if again is None else write_reference(again.policy, scratch),
            source=given.original,
            files=case.artefacts,
            profile=case.made_for,
            batch=found.contract.tool.get("batch"),
            code=CodeOptions.of(found.contract.tool),
            runs_elsewhere=given.source is not None and runs_elsewhere(given.source),
            before=again.own if again is not None and again.bake else None,
            reread=again is not None,
        )
        weights = found.contract.tool.get("weights")
        # What was rounded is held against itself; the source is asked what it decides.
        held = replace(tested, source=None, before=None) if weights else tested
        session = Session(() if case.asked else running, known, pool, options or VerifyOptions(), progress)
        report = verify(held, session)
        if weights and given.original is not None:
            decided = decisions(tested, held, storage_of(weights), replace(session, runtimes=running))
            ran = given.original.runtime if decided and given.original.runtime in used else None
            report = replace(report.with_findings(decided), self_consistent=False, original=ran)
        if again is not None and again.own is not None and not again.bake:
            under = own_in(again, case.formats, scratch / "own")
            other = verify(under, Session(running, known, pool, progress=progress))
            report = join_reports(report, other)
    return report


def _safe_copies(
    artefacts: Mapping[str, Path], names: Sequence[str], signatures: Sequence[str], scratch: Path
) -> dict[str, Path]:
    """Copies of a bundle's artefacts as far as a runtime may be given them: anyone may have made the bundle.

    Raises UnsupportedOpError where one does more than compute, DamagedFileError, GraphError.
    """
    copies = {}
    for key, path in artefacts.items():
        found, folder = WRITTEN[key], scratch / key
        folder.mkdir()
        with naming(path):
            copies[key] = (
                path if found.vetted is None else found.vetted(path, signatures if found.signatures else names, folder)
            )
    return copies


def _check_asked(found: Bundle, made_for: str, runtimes: str | Sequence[str], options: VerifyOptions | None) -> None:
    """Raise where a bundle in a consumer's names lacks the file, or is to be compared without its source."""
    folder = found.folder
    if not any(found.has(WRITTEN[key]) for key in consumer(made_for).formats):
        raise unfit(folder, "has no file that its consumer loads", f"it was made for {made_for}")
    if runtimes != "auto" or (options is not None and (options.golden or options.rules)):
        raise UsageError(
            f"without its source, a bundle that was made for {made_for} is asked of its consumer's checkers alone",
            where=str(folder),
            why="its names are the consumer's; its numbers were compared when it was exported",
            fix="give the source too: --source FILE",
        )


def _whole_graph(graph: Graph, names: Sequence[str], artefacts: Mapping[str, Path]) -> Graph:
    """A graph that has all inputs and outputs: the .bytes', else another file's.

    A .bytes that lacks one is what the comparison is to find; raises BundleError where all lack one.
    """
    missing = [name for name in names if name not in graph]
    for key, path in artefacts.items():
        read = WRITTEN[key].graph
        if missing and read is not None:
            with naming(path):
                graph = read(path)
            missing = [name for name in names if name not in graph]
    if missing:
        raise unfit(artefacts[FROZEN_GRAPH.key], f"has no tensor {missing[0]!r}", f"{POLICY} names it")
    return graph


def _outline(signature: PolicySignature, *, noise_kept: bool) -> Graph:
    """A graph where a bundle has none that we read.

    What is asked of it is which outputs are drawn. These are samplers, the others constants.
    """
    size = Node("size", "Const", value=np.array([1, 1], np.int32))
    nodes = [size]
    for spec in signature.inputs:
        attrs = {"dtype": np.dtype(spec.dtype), "shape": TensorShape(spec.shape)}
        nodes.append(Node(spec.name, "Placeholder", attrs=attrs))
    for spec in signature.outputs:
        drawn = spec.role is Role.SAMPLED or (spec.role is Role.CONTINUOUS and noise_kept)
        attrs = {"dtype": np.dtype(np.float32)} if drawn else {}
        nodes.append(Node(spec.name, "RandomStandardNormal" if drawn else "Identity", ("size",), attrs))
    return Graph(tuple(nodes))


def _source_of(source: Path, contract: Contract, step: int | None, trust_source: bool) -> Source:
    """What a bundle was exported from; raises BundleError where ``source`` is another file.

    A run's folder is read at ``step``, by default at the one that the export asked for.
    """
    origin = contract.origin
    read = ReadOptions(**{name: getattr(origin, name) for name in READ_BY}, trust_source=trust_source)
    if step is not None:
        read = replace(read, step=step)
    if read.normaliser not in (None, NO_NORMALISER):  # a file's name: it is expected beside the source
        read = replace(read, normaliser=str(source.parent / str(read.normaliser)))
    found = read_source(source, read)
    if found.sha256 != origin.sha256:
        raise BundleError(
            "is not the source of this bundle",
            where=str(source),
            why=f"its sha256 differs from that of {origin.path} in {POLICY}",
            fix="give the file it was exported from (a checkpoint of a run's folder: its --step), or export it again",
        )
    return found


def _original_of(found: Source, contract: Contract) -> OriginalRun | None:
    named = [m for m in found.models if m.name is not None and printable(m.name) == contract.origin.model]
    original = (named or list(found.models))[0].original
    with naming(found.path):
        return None if original is None else original.narrow(contract.source)


def _check_meaning(found: Source, contract: Contract, folder: Path) -> None:
    """Raise BundleError where the source, read again, means something else by the tensors that the contract names.

    A bundle that was exported with options (--input, --output) may have others: nothing is held against it then.
    """
    with naming(found.path):
        signatures = [p.signature for _, p in found.compile_models()]
    alike = [s for s in signatures if tensors(s) == tensors(contract.signature)]
    wrong = [[what for what, ours, its in _meanings(contract.signature, s) if ours != its] for s in alike]
    if wrong and all(wrong):
        what = f"says otherwise of {', '.join(wrong[0])} than its source"
        raise unfit(folder / POLICY, what, f"{found.path.name} was read again, and means something else")


def _meanings(ours: PolicySignature, its: PolicySignature) -> list[tuple[str, object, object]]:
    """(what a contract says beside its tensors, as one says it, as the other does)."""
    return [
        ("branches", ours.branches, its.branches),
        ("memory", ours.memory, its.memory),
        ("preprocess", {**ours.preprocess}, {**its.preprocess}),
        *(
            (f"{a.name}'s distribution", a.distribution, b.distribution)
            for a, b in zip(ours.inputs, its.inputs, strict=True)
        ),
        *((f"{a.name}'s source", a.source, b.source) for a, b in zip(ours.outputs, its.outputs, strict=True)),
    ]
