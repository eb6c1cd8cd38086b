"""One policy to write: its contract, its artefacts, and what verification is given of it.

So, too, its weights where they are rounded (``--dtype float16``, ``--quantize int8``).
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.compiler.passes.weights import Storage, round_weights
from export_model.converters.formats.embed import FIXED_BATCH
from export_model.converters.formats.format import Artifact, Format, WriteOptions
from export_model.converters.formats.registry import ONNX, WRITTEN
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.policy.policy import Policy
from export_model.exporter import __version__
from export_model.exporter.export.options import ExportOptions
from export_model.exporter.export.sources import Source
from export_model.signatures.code import CodeOptions
from export_model.signatures.contract import READ_BY, Contract, Origin, parse
from export_model.signatures.errors import SignatureError, TooLargeError, UsageError, naming
from export_model.signatures.fields import FieldError, printable

if TYPE_CHECKING:
    from export_model.converters.consumers.profile import Profile
    from export_model.exporter.verify.participants import PolicyUnderTest
if not TYPE_CHECKING:  # what asks a record for its signature looks these names up
    Profile = Any


#: Agents that a file may be made for (``--batch``).
MOST_AGENTS = 1 << 16


class Job(Struct, frozen=True):
    """One policy to write, and where it comes from."""

    source: Source
    model: SourceModel
    policy: Policy
    profile: Profile | None = None
    #: the policy under its own names, where ``policy`` has those of a consumer; before its action was baked
    own: Policy | None = None
    #: why it has another name than its source's
    note: str | None = None
    #: the policy with its weights as they were, where those of ``policy`` are rounded
    whole: Policy | None = None
    #: for how many agents its files are
    batch: int | None = None
    #: how its source code is written
    code: CodeOptions = CodeOptions()
    #: what of the interface the graph computes beside what its source does
    bake: str | None = None


def artefacts_of(
    job: Job, formats: Sequence[Format], options: ExportOptions
) -> tuple[Contract, list[Artifact], tuple[str, ...]]:
    """The contract, the artefacts, and why some of the usual formats are not among these."""
    with naming(job.source.path):
        contract = contract_of(
            job.policy,
            job.source,
            model=job.model,
            read=options.read,
            profile=None if job.profile is None else job.profile.name,
            weights=None if job.whole is None else options.weights,
            batch=job.batch,
            code=options.code,
            bake=job.bake,
        )
        if job.profile is None:
            how = WriteOptions(
                contract.compact(),
                checked=options.verify != "none",
                weights=options.weights,
                batch=options.batch,
                code=options.code,
            )
            if options.opset is not None:
                how = replace(how, opset=options.opset)
            artifacts, notes = list[Artifact](), list[str]()
            for form in formats:
                try:
                    artifacts.append(_artifact(form, job.policy, how))
                except TooLargeError as error:
                    if options.targets is not None:
                        raise
                    notes.append(f"{form.key} was left out: {error.what}: {error.why}")
            return contract, artifacts, tuple(notes)
        how = job.profile.write_options(contract.compact())
        artifacts = [job.profile.complete(_artifact(f, job.policy, how)) for f in formats]
        for artifact in artifacts if job.profile.loaders else ():
            from export_model.converters.consumers.robots.loaders import loadable

            files = {name: data.to_bytes() for name, data in artifact.files.items()}
            loadable(job.profile.name, job.profile.loaders, files, artifact.main, job.policy.name)
        if job.profile.importers:
            from export_model.converters.consumers.importable import importable
            from export_model.converters.consumers.playable import playable

            for artifact in artifacts:
                importable(job.profile, artifact.files, job.policy.name)
                playable(job.profile, artifact.files, job.policy.name)
        return contract, artifacts, ()


def _artifact(form: Format, policy: Policy, how: WriteOptions) -> Artifact:
    if not form.consumer:  # a plain export loads nothing of consumers
        return form.artifact(policy, how)
    from export_model.converters.consumers.named_files import artifact_of

    return artifact_of(form, policy, how)


def contract_of(
    policy: Policy,
    source: Source,
    model: SourceModel,
    read: ReadOptions,
    profile: str | None = None,
    weights: str | None = None,
    batch: int | None = None,
    code: CodeOptions | None = None,
    bake: str | None = None,
) -> Contract:
    """The contract as every artefact embeds it. Raises SignatureError where it could not be read back."""
    origin = Origin(
        path=printable(source.path.name or source.path.absolute().name),  # of the current folder
        sha256=source.sha256,
        model=None if model.name is None else printable(model.name),
        **{name: getattr(read, name) for name in READ_BY},
    )
    if read.normaliser is not None:
        origin = replace(origin, normaliser=printable(Path(read.normaliser).name))
    said = None if code is None else code.to_dict() or None
    options = {"profile": profile, "weights": weights, "batch": batch, "code": said, "bake": bake}
    made = {key: value for key, value in options.items() if value is not None}
    tool = {"name": "export-model", "version": __version__, **made}
    contract = Contract(policy.name, policy.signature, origin, policy.source, tool)
    try:
        parse(contract.to_dict())
    except FieldError as error:
        raise SignatureError(
            "the policy cannot be described",
            why=f"{error.field} {error.why}",
            fix="give inputs and outputs other names where the model is made, or choose with --input and --output",
        ) from error
    return contract


def under_test(job: Job, stage: Path, artifacts: Sequence[Artifact], scratch: Path) -> PolicyUnderTest:
    """A policy whose artefacts lie in ``stage``; what else verification needs is put into ``scratch``."""
    from export_model.exporter.verify.participants import policy_under_test, write_reference

    paths = {a.format.key: stage / a.main for a in artifacts}
    return policy_under_test(
        job.policy,
        paths,
        scratch,
        sizes={a.format.key: a.size for a in artifacts},
        reference=write_reference(job.policy, scratch),
        source=job.model.original if (job.own is None or job.bake) and job.whole is None else None,
        profile=None if job.profile is None else job.profile.name,
        batch=job.batch,
        code=job.code,
        runs_elsewhere=runs_elsewhere(job.source),
        before=job.own if job.bake and job.whole is None else None,
    )


def runs_elsewhere(source: Source) -> bool:
    """Return whether a library that is installed runs a source by itself, though verification does not ask it."""
    library = source.format.library
    return bool(library) and find_spec(library) is not None


def own_in(job: Job, formats: Sequence[Format], folder: Path) -> PolicyUnderTest:
    """The policy of a consumer's job under its own names, written to a folder that is thrown away.

    It is written in those of the formats that hold every policy; one of a consumer alone holds its names and no others.
    """
    assert job.own is not None
    job = replace(job, policy=job.own, own=None, whole=None, profile=None, batch=None, bake=None)
    contract = contract_of(job.policy, job.source, job.model, ReadOptions())
    artifacts = [f.artifact(job.policy, WriteOptions(contract.compact())) for f in formats if f.default]
    for artifact in artifacts:
        artifact.write(folder)
    return under_test(job, folder, artifacts, folder)


def check_weights(options: ExportOptions, formats: Sequence[Format]) -> None:
    """Raise UsageError where rounded weights are asked for and what is written cannot hold them."""
    if options.weights == "float32":
        return
    flag = "--dtype float16" if options.weights == "float16" else "--quantize int8"
    if options.profile is not None:
        raise UsageError(
            f"{flag} does not go with --for {options.profile}",
            why=f"{options.profile} was not shown to read weights in less than float32",
            fix="leave one of them out",
        )
    wide = [f.key for f in formats if not f.narrow]
    if wide:
        raise UsageError(
            f"{flag} does not go with --to {','.join(wide)}",
            why=f"weights in {options.weights} are written to {', '.join(f.key for f in WRITTEN.values() if f.narrow)}",
            fix="leave one of them out",
        )


def check_batch(options: ExportOptions, formats: Sequence[Format]) -> None:
    """Raise UsageError where files for a fixed number of agents are asked for and all that are written take any."""
    if options.batch is None:
        return
    if not 0 < options.batch <= MOST_AGENTS:
        raise UsageError(
            f"--batch {options.batch}: must be from 1 to {MOST_AGENTS}", why="it is how many agents act at once"
        )
    if options.profile is not None:
        raise UsageError(
            f"--batch does not go with --for {options.profile}",
            why="the consumer decides for how many agents its files are",
            fix="leave one of them out",
        )
    if not any(f.fixed for f in formats):
        able = ",".join(f.key for f in WRITTEN.values() if f.fixed)
        raise UsageError(
            f"--batch does not go with --to {','.join(f.key for f in formats)}",
            why="such files take any number of agents",
            fix=f"write those for which some consumers ask for a fixed one: --to {able}",
        )


def check_code(options: ExportOptions, formats: Sequence[Format]) -> None:
    """Raise UsageError where source code is to be written in some way and none is."""
    said = options.code.to_dict()
    if said and not any(f.program for f in formats):
        (key, value), *_ = said.items()
        what = f"--to {','.join(f.key for f in formats)}" if options.profile is None else f"--for {options.profile}"
        raise UsageError(
            f"--{key} {value:g} does not go with {what}"
            if isinstance(value, float)
            else f"--{key} {value} does not go with {what}",
            why="it says how source code is written",
            fix=f"add a format to --to: {', '.join(f.key for f in WRITTEN.values() if f.program)}"
            if options.profile is None
            else "leave one of them out",
        )


def check_opset(options: ExportOptions, formats: Sequence[Format]) -> None:
    """Raise UsageError where an opset is asked for and no format has one."""
    if options.opset is not None and ONNX not in formats:
        raise UsageError(
            f"--opset {options.opset} does not go with --to {','.join(f.key for f in formats)}",
            why="it is the version of ONNX's operators",
            fix="leave it out, or add onnx to --to",
        )


def check_bake(options: ExportOptions) -> None:
    """Raise UsageError where an interface is to be baked and a consumer decides what its action is."""
    if options.bake is not None and options.profile is not None:
        raise UsageError(
            f"--bake {options.bake} does not go with --for {options.profile}",
            why="the consumer's agents apply their own scale to the action",
            fix="leave one of them out",
        )


def bake(job: Job, what: str) -> Job:
    """The policy whose graph computes what is stated of its action; ``own`` is the one before."""
    from export_model.converters.compiler.passes.bake import BAKED

    with naming(job.source.path):
        baked = BAKED[what](job.policy)
    if baked.graph is job.policy.graph:
        return replace(job, policy=baked)
    return replace(job, policy=baked, own=job.policy, bake=what)


def fix_batch(job: Job, batch: int, formats: Sequence[Format], flag: str = "--batch") -> Job:
    """The policy of which some files are for ``batch`` agents at a time.

    A note in its contract says so, with the ``flag`` that asked for it.
    """
    files = " and ".join(f.main_of(job.policy.name) for f in formats if f.fixed)
    note = f"{FIXED_BATCH}{batch}, no more and no fewer ({flag}): {files}"
    signature = replace(job.policy.signature, notes=(*job.policy.signature.notes, note))
    return replace(job, policy=replace(job.policy, signature=signature), batch=batch)


def smaller(job: Job, weights: Storage) -> Job:
    """The policy with its weights rounded, which a note in its contract says."""
    whole = job.policy
    note = f"weights are stored as {weights}; computation stays in float32"
    signature = replace(whole.signature, notes=(*whole.signature.notes, note))
    return replace(
        job, policy=replace(whole, graph=round_weights(whole.graph, weights), signature=signature), whole=whole
    )


def sizes_unrounded(job: Job, formats: Sequence[Format], options: ExportOptions) -> dict[str, int]:
    """What the formats would take with weights in float32; nothing where that is how they are written."""
    if job.whole is None:
        return {}
    whole = replace(job, policy=job.whole, whole=None)
    _, artifacts, _ = artefacts_of(whole, formats, replace(options, weights="float32", verify="none"))
    return {a.format.key: a.size for a in artifacts}
