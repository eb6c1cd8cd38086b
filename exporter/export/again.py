"""A bundle that was written, verified again: hashes first, then its formats against its source or its own graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from converters.files.folders import scratch_folder
from converters.formats.bundle.bundle import Bundle, unfit
from converters.formats.bundle.embed import runnable
from converters.formats.programs.artifact import can_confine
from converters.formats.registry import FROZEN_GRAPH, WRITTEN
from converters.formats.saved_model.writer import signatures_of
from converters.formats.source import NO_NORMALISER, OriginalRun, ReadOptions
from converters.graph.nodes import Graph, Node, TensorShape
from converters.policy.policy import Policy
from converters.runtimes.pool import RuntimePool, chosen_runtimes
from exporter.export.job import Job, own_in, runs_elsewhere
from exporter.export.options import storage_of
from exporter.export.pipeline import Progress, consumer, join_reports
from exporter.export.sources import Source, read_source
from exporter.verify.checks.decisions import decisions
from exporter.verify.options import VerifyOptions
from exporter.verify.participants import policy_under_test, write_reference
from exporter.verify.report import ParityReport
from exporter.verify.verification import verify
from signatures.code import CodeOptions
from signatures.contract import POLICY, Contract, safe_name
from signatures.errors import BundleError, RuntimeUnavailableError, UsageError, naming
from signatures.fields import printable
from signatures.roles import Role
from signatures.spec import PolicySignature

#: The runtime that is our own kernels in numpy.
KERNELS = "numpy"

if TYPE_CHECKING:
    from converters.consumers.profile import Profile


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

    Without ``source`` the reference is the bundle's own ``.bytes``, without that its ``.nn``. Raises BundleError, and
    RuntimeUnavailableError when no independent runtime ran (unless ``allow_unverified``, or there is only a ``.nn``,
    which no runtime outside Unity has).
    """
    if step is not None and source is None:
        raise UsageError(f"--step {step} goes with --source", fix="give the folder of the run: --source FOLDER")
    found = Bundle.open(folder)
    found.verify_hashes()
    contract = found.contract
    read = None if source is None else _source_of(source, contract, step, trust_source)
    signature = contract.signature
    formats = [f for f in WRITTEN.values() if found.has(f)]
    artefacts = {f.key: found.path(f) for f in formats}
    made_for = contract.tool.get("profile")
    # Names of a consumer are not those of the source: what it was made from is dressed anew, and held against it.
    dressed = made_for is not None and consumer(made_for).own_names.isdisjoint(artefacts)
    again = _made_again(read, contract, consumer(made_for)) if read is not None and made_for and dressed else None
    original = None if read is None or again is not None else _original_of(read, contract)
    if read is not None and made_for is None:
        _check_meaning(read, contract, folder)
    # Without the source, it is the consumer alone that is asked.
    judge = next((f for f in formats if KERNELS in f.runtimes), None)
    asked = again is None and made_for is not None and judge is None
    if asked:
        _check_asked(found, str(made_for), runtimes, options)
    reference = found.graph_file if judge is None and made_for is None else found.path(judge or formats[0])
    for each in formats:
        if each.held is not None:
            with naming(artefacts[each.key]):
                found.verify_contract(each.held(artefacts[each.key]))
    programs = [] if can_confine() else [f.key for f in formats if f.program]
    formats = [f for f in formats if f.key not in programs] or formats
    artefacts = {f.key: artefacts[f.key] for f in formats}
    names = [s.name for s in (*signature.inputs, *signature.outputs)]
    if FROZEN_GRAPH.key in artefacts:
        with naming(reference):
            embedding = found.graph()
        graph = _whole_graph(embedding, names, artefacts)
        with naming(reference):
            found.check_graph(runnable(graph))
    else:
        graph = _outline(signature, noise_kept=contract.source.noise_kept)
    graph = graph if again is None else again.policy.graph
    policy = Policy(
        found.name,
        graph,
        signature,
        {s.name: s.name for s in signature.inputs},
        {s.name: s.name for s in signature.outputs},
        contract.source,
    )
    used, known = chosen_runtimes(runtimes, formats)
    sizes = {f.key: found.size(f) for f in formats}
    with scratch_folder() as scratch, RuntimePool() as pool:
        copies = _safe_copies(artefacts, names, list(signatures_of(policy)), scratch)
        tested = policy_under_test(
            policy,
            copies,
            scratch,
            sizes=sizes,
            reference=reference if again is None else write_reference(again.policy, scratch),
            source=original,
            files=artefacts,
            profile=made_for,
            batch=contract.tool.get("batch"),
            code=CodeOptions.of(contract.tool),
            runs_elsewhere=read is not None and runs_elsewhere(read),
        )
        weights = contract.tool.get("weights")
        # What was rounded is held against itself; the source is asked what it decides.
        held = replace(tested, source=None) if weights else tested
        report = verify(held, () if asked else used or ("numpy",), known, pool, options, progress)
        if weights and original is not None:
            kept = storage_of(weights)
            decided = decisions(tested, held, kept, used or ("numpy",), pool, options or VerifyOptions())
            ran = original.runtime if decided and original.runtime in used else None
            report = replace(report.with_findings(decided), self_consistent=False, original=ran)
        if again is not None and again.own is not None:
            under = own_in(again, formats, scratch / "own")
            report = join_reports(report, verify(under, used or ("numpy",), known, pool, None, progress))
    if programs:
        note = (
            f"not compiled again: {', '.join(programs)}: source code may be any program, and nothing confines "
            "one here; its bytes were compared"
        )
        report = replace(report, notes=(*report.notes, note))
    if asked:
        note = (
            f"made for {made_for}: its bytes and what the consumer's checkers say were verified; its numbers were "
            "compared when it was exported, and are again with --source FILE"
        )
        return replace(report, notes=(*report.notes, note))
    if source is None:
        own = (judge or FROZEN_GRAPH).key
        note = f"the source was not given: the reference is the bundle's own .{own}"
        report = replace(report, reference=f"{own}/{KERNELS}", notes=(*report.notes, note), self_consistent=False)
    (first, *others) = formats
    if report.passed is None and first.elsewhere and not others:
        # No runtime that is here has it, so none can be asked for: the files are whole and one contract says so.
        note = (
            f"only {first.elsewhere} runs a .{first.key}: its bytes, its contract and that it answers by our own "
            "reader were verified"
        )
        report = replace(report, notes=(*report.notes, note))
    elif report.passed is None and not report.undecided and not (allow_unverified or runtimes == "none"):
        raise RuntimeUnavailableError(
            "no independent runtime is installed, so nothing was verified",
            where=str(folder),
            why="only the numpy reference ran",
            fix="pip install export-model[onnxruntime] (or [tensorflow]), or --allow-unverified",
        )
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
    """A graph where a bundle has none that we read: what is asked of it is which outputs are drawn. These are samplers,
    the others constants.
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
    asked = origin.step if step is None else step
    normaliser = origin.normaliser
    if normaliser not in (None, NO_NORMALISER):  # a file's name: it is expected beside the source
        normaliser = str(source.parent / normaliser)
    read = ReadOptions(asked, origin.sensors, trust_source, origin.goals, origin.activation, normaliser)
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
    alike = [s for s in signatures if _tensors(s) == _tensors(contract.signature)]
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


def _made_again(found: Source, contract: Contract, wanted: Profile) -> Job:
    """A bundle's policy from its source, in the names of its consumer; raises BundleError where none is like it."""
    compiled = list(found.compile_models())
    named = [(m, p) for m, p in compiled if safe_name(p.name) == contract.name]
    for model, own in named or compiled[: len(compiled) == 1]:
        dressed = wanted.dress(own)
        if _tensors(dressed.signature) == _tensors(contract.signature):
            return Job(found, model, replace(dressed, name=contract.name), wanted, own)
    raise BundleError(
        "cannot be held against its source",
        where=str(found.path),
        why="the source gives other inputs and outputs than the bundle has: it was exported with options",
        fix="leave --source out, or export it again",
    )


def _tensors(signature: PolicySignature) -> list[tuple[object, ...]]:
    return [(s.name, s.role, s.dtype, s.shape) for s in (*signature.inputs, *signature.outputs)]
