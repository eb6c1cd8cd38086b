"""The main job: sources in, verified bundles out."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from converters.format import Artifact, Format, WriteOptions
from converters.formats import DEFAULTS, WRITTEN, written
from converters.frozen_graph.reader import read_graph
from converters.frozen_graph.writer import frozen
from converters.graph.compile import CONTRACT_NODE
from converters.graph.nodes import Graph
from converters.graph.options import CompileOptions
from converters.policy import Policy
from converters.runtimes.pool import RuntimePool, chosen_runtimes
from converters.saved_model.writer import signatures_of
from converters.source import OriginalRun, ReadOptions, SourceModel
from converters.targets.profile import Profile
from converters.targets.profiles import profile
from exporter.export import bundle
from exporter.export.labels import Labels, labelled, read_labels
from exporter.export.sources import Source, naming, read_source
from exporter.verify.inner_tensors import saved_graph
from exporter.verify.options import VerifyOptions
from exporter.verify.participants import PolicyUnderTest
from exporter.verify.report import ParityReport
from exporter.verify.verification import verify
from signatures.errors import BundleError, RuntimeUnavailableError, UsageError
from signatures.spec import SourceMap

Progress = Callable[[str], None]


@dataclass(frozen=True)
class ExportOptions:
    """What ``export-model`` may be told; see the command line for the meaning of each."""

    out: Path = Path("exported")
    targets: Sequence[str] = DEFAULTS
    name: str | None = None
    compile: CompileOptions = field(default_factory=CompileOptions)
    read: ReadOptions = field(default_factory=ReadOptions)
    opset: int = 15
    verify: str | Sequence[str] = "auto"
    parity: VerifyOptions = field(default_factory=VerifyOptions)
    labels: Labels | None = None
    #: the consumer that the files are made for (``--for``); its own formats where ``targets`` are the usual ones
    profile: str | None = None


@dataclass(frozen=True, slots=True)
class ExportResult:
    """One policy, written: its bundle (``<policy>.failed`` where the formats disagree), contract and report."""

    policy: Policy
    folder: Path
    contract: Mapping[str, Any]
    sizes: Mapping[str, int]
    report: ParityReport | None

    @property
    def passed(self) -> bool | None:
        """Whether the formats agree; None where no independent runtime ran."""
        return None if self.report is None else self.report.passed


@dataclass(frozen=True, slots=True)
class _Job:
    """One policy to write, and where it comes from."""

    source: Source
    model: SourceModel
    policy: Policy
    profile: Profile | None = None


def export(
    paths: Sequence[Path | str | Source],
    options: ExportOptions,
    progress: Progress = lambda text: None,
    pool: RuntimePool | None = None,
) -> Iterator[ExportResult]:
    """Export every policy of every source, one after the other; a path is read, a Source was read already.

    All sources are read and compiled before the first is written, so a bad one leaves nothing behind. Raises
    ExportModelError; a disagreement is in the result, not an exception. A ``pool`` that is given stays open, for
    callers that export many times.
    """
    if not paths:
        raise UsageError("no source was given", fix="export-model FILE -o DIR")
    wanted = None if options.profile is None else profile(options.profile)
    formats = _formats(options, wanted)
    if not formats:
        raise UsageError("--to names no format", fix=f"the formats are {', '.join(WRITTEN)}")
    runtimes, known = chosen_runtimes(options.verify, formats)
    labels = read_labels(options.labels)
    jobs: list[_Job] = []
    origins: list[tuple[str, str]] = []
    for path in paths:
        progress(f"reading {path.path if isinstance(path, Source) else path}")
        source = path if isinstance(path, Source) else read_source(path, options.read)
        compiled = list(source.compiled(options.compile))
        named = _named([policy for _, policy in compiled], options, len(paths))
        dressed = [p if wanted is None else wanted.dress(p) for p in named]
        jobs.extend(_Job(source, model, p, wanted) for (model, _), p in zip(compiled, dressed, strict=True))
        origins.extend((p.name, f"{source.path} ({own.name})") for p, (_, own) in zip(named, compiled, strict=True))
    bundle.distinct_names(origins)
    jobs = [replace(j, policy=p) for j, p in zip(jobs, labelled([j.policy for j in jobs], labels), strict=True)]
    for policy in (j.policy for j in jobs):
        bundle.recover(options.out / policy.name)
        bundle.check_replaceable(options.out / policy.name)
    made = [(j, *_write(j, formats, options)) for j in jobs]
    with nullcontext(pool) if pool is not None else RuntimePool() as pool:
        for job, content, artifacts in made:
            policy = job.policy
            with _staged(options.out, content, artifacts) as stage, tempfile.TemporaryDirectory() as scratch:
                report = None
                if runtimes:
                    tested = _tested(job, stage, artifacts, Path(scratch))
                    report = verify(tested, runtimes, known, pool, options.parity, progress)
                    with bundle.writing(options.out):
                        (stage / bundle.PARITY).write_bytes(bundle.dumps(report.to_dict()))
                failed = report is not None and report.passed is False
                place = options.out / (f"{policy.name}.failed" if failed else policy.name)
                bundle.put_in_place(stage, place)
            yield ExportResult(policy, place, content, {a.format.key: a.size for a in artifacts}, report)


def _formats(options: ExportOptions, wanted: Profile | None) -> list[Format]:
    """What to write: ``--to``, or what the consumer of ``--for`` loads. Raises UsageError."""
    targets = tuple(dict.fromkeys(options.targets))
    if wanted is None:
        return [written(target) for target in targets]
    if targets == DEFAULTS:
        targets = wanted.formats[:1]
    for target in targets:
        if written(target).key not in wanted.formats:
            raise UsageError(
                f"--to {target} does not go with --for {wanted.name}",
                why=f"{wanted.purpose}: it loads {', '.join(wanted.formats)}",
                fix="leave --to out",
            )
    if options.compile.names != "canonical":
        raise UsageError(
            f"--names {options.compile.names} does not go with --for {wanted.name}",
            why="the consumer decides the names",
            fix="leave --names out",
        )
    return [written(target) for target in targets]


def _named(policies: list[Policy], options: ExportOptions, sources: int) -> list[Policy]:
    if options.name is not None:
        if len(policies) > 1 or sources > 1:
            raise UsageError("--name goes with a single policy", fix="choose one with --brain, or leave --name out")
        policies = [replace(policies[0], name=options.name)]
    return [replace(p, name=bundle.safe_name(p.name)) for p in policies]


def _write(job: _Job, formats: Sequence[Format], options: ExportOptions) -> tuple[dict[str, Any], list[Artifact]]:
    origin: dict[str, Any] = {"path": job.source.path.name, "sha256": job.source.sha256}
    if job.model.name is not None:
        origin["model"] = job.model.name
    if options.read.step is not None:
        origin["step"] = options.read.step
    if options.read.sensors:
        origin["sensors"] = [list(shape) for shape in options.read.sensors]
    content = bundle.contract(job.policy, origin)
    with naming(job.source.path):
        if job.profile is None:
            how = WriteOptions(bundle.compact(content), options.opset)
            return content, [f.artifact(job.policy, how) for f in formats]
        how = WriteOptions(bundle.compact(content), job.profile.opset, job.profile.name)
        artifacts = [f.artifact(job.policy, how) for f in formats]
        for artifact in artifacts:
            if job.profile.check is not None:
                job.profile.check(job.profile, artifact.files, job.policy.name)
        return content, artifacts


@contextmanager
def _staged(out: Path, content: Mapping[str, Any], artifacts: Sequence[Artifact]) -> Iterator[Path]:
    """A staged bundle that is gone afterwards, unless it was put in its place."""
    stage = bundle.write_staged(out, content, artifacts)
    try:
        yield stage
    finally:
        if stage.exists():
            shutil.rmtree(stage, ignore_errors=True)


def _tested(job: _Job, stage: Path, artifacts: Sequence[Artifact], scratch: Path) -> PolicyUnderTest:
    policy = job.policy
    paths = {a.format.key: stage / a.main for a in artifacts}
    reference = paths.get("bytes")
    if reference is None:
        # The numpy reference reads a .bytes; one is made for it where none was asked for.
        reference = scratch / "reference.bytes"
        reference.write_bytes(frozen(policy))
    keys = {k: ([s.name for s in i], [s.name for s in o]) for k, (i, o) in signatures_of(policy).items()}
    return PolicyUnderTest(
        policy.name,
        policy.signature,
        policy.graph,
        paths,
        {a.format.key: a.size for a in artifacts},
        reference,
        job.model.original if job.profile is None else None,
        policy.source,
        keys,
    )


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

    Without ``source`` the reference is the bundle's own ``.bytes``. Raises BundleError, and RuntimeUnavailableError
    when no independent runtime ran (unless ``allow_unverified``).
    """
    if step is not None and source is None:
        raise UsageError(f"--step {step} goes with --source", fix="give the folder of the run: --source FOLDER")
    content = bundle.read_policy_json(folder)
    bundle.check_hashes(folder, content)
    name = content["name"]
    artefacts = _artefacts(folder, content)
    graph_file = artefacts.get("bytes")
    if graph_file is None:
        raise BundleError(
            "has no .bytes, which is the reference without a source",
            where=str(folder),
            fix="export the policy again with bytes among --to",
        )
    signature, source_map = bundle.signature_of(content)
    original = None if source is None else _original_of(source, content, step, source_map, trust_source)
    embedding = _checked_graph(folder, graph_file, content)
    names = [s.name for s in (*signature.inputs, *signature.outputs)]
    graph = _whole_graph(embedding, names, artefacts)
    policy = Policy(
        name,
        graph,
        signature,
        {s.name: s.name for s in signature.inputs},
        {s.name: s.name for s in signature.outputs},
        source_map,
    )
    used, known = chosen_runtimes(runtimes, [WRITTEN[key] for key in artefacts])
    keys = {k: ([s.name for s in i], [s.name for s in o]) for k, (i, o) in signatures_of(policy).items()}
    with tempfile.TemporaryDirectory(prefix="export-model-") as scratch, RuntimePool() as pool:
        copies = _vetted(artefacts, names, list(keys), Path(scratch))
        tested = PolicyUnderTest(
            name, signature, policy.graph, copies, _sizes(content), graph_file, original, source_map, keys
        )
        report = verify(tested, used or ("numpy",), known, pool, options, progress)
    if source is None:
        note = "the source was not given: the reference is the bundle's own .bytes"
        report = replace(report, reference="bytes/numpy", notes=(*report.notes, note), self_consistent=False)
    if report.passed is None and not allow_unverified:
        raise RuntimeUnavailableError(
            "no independent runtime is installed, so nothing was verified",
            where=str(folder),
            why="only the numpy reference ran",
            fix="pip install export-model[onnxruntime] (or [tensorflow]), or --allow-unverified",
        )
    return report


def _vetted(
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


def _checked_graph(folder: Path, file: Path, content: Mapping[str, Any]) -> Graph:
    """The graph of a bundle's .bytes; raises BundleError where it embeds another contract than policy.json."""
    with naming(file):
        graph = read_graph(file.read_bytes())
    node = graph.get(CONTRACT_NODE)
    embedded = b"" if node is None or node.value is None or node.value.ndim else node.value.item()
    bundle.check_contract(folder, content, embedded.decode("utf-8", "replace") if isinstance(embedded, bytes) else "")
    return Graph(tuple(n for n in graph.nodes if n.name != CONTRACT_NODE))


def _whole_graph(graph: Graph, names: Sequence[str], artefacts: Mapping[str, Path]) -> Graph:
    """A graph that has all inputs and outputs: the .bytes', else the SavedModel's.

    A .bytes that lacks one is what the comparison is to find; raises BundleError where there is no SavedModel either.
    """
    missing = [name for name in names if name not in graph]
    if missing and "saved_model" in artefacts:
        with naming(artefacts["saved_model"]):
            graph = saved_graph(artefacts["saved_model"])
        missing = [name for name in names if name not in graph]
    if missing:
        raise BundleError(
            f"has no tensor {missing[0]!r}",
            where=str(artefacts["bytes"]),
            why=f"{bundle.POLICY} names it",
            fix="export the policy again",
        )
    return graph


def _artefacts(folder: Path, content: Mapping[str, Any]) -> dict[str, Path]:
    """Format → what a loader is given, for the formats whose files policy.json names."""
    name, files = content["name"], content["files"]
    return {key: folder / f.main_of(name) for key, f in WRITTEN.items() if f.first_file_of(name) in files}


def _sizes(content: Mapping[str, Any]) -> dict[str, int]:
    name, files = content["name"], content["files"]
    owned = {key: [e["bytes"] for path, e in files.items() if f.owns(path, name)] for key, f in WRITTEN.items()}
    return {key: sum(found) for key, found in owned.items() if found}


def _original_of(
    source: Path, content: Mapping[str, Any], step: int | None, source_map: SourceMap, trust_source: bool
) -> OriginalRun | None:
    """How to run the source of a bundle; raises BundleError where ``source`` is another file.

    A run's folder is read at ``step``, by default at the one that the export asked for.
    """
    asked = content["source"].get("step")
    sensors = tuple(tuple(shape) for shape in content["source"].get("sensors", ()))
    read = ReadOptions(step if step is not None or not isinstance(asked, int) else asked, sensors, trust_source)
    found = read_source(source, read)
    if found.sha256 != content["source"]["sha256"]:
        raise BundleError(
            "is not the source of this bundle",
            where=str(source),
            why=f"its sha256 differs from that of {content['source']['path']} in {bundle.POLICY}",
            fix="give the file it was exported from (a checkpoint of a run's folder: its --step), or export it again",
        )
    named = [m for m in found.models if m.name == content["source"].get("model")]
    original = (named or list(found.models))[0].original
    with naming(source):
        return None if original is None else original.narrowed(source_map)
