"""``export-model compare``: artefacts that any tool made, held against a reference.

The reference is read as a policy, so that it says what to draw for its inputs and which outputs are drawn. A candidate
is not read, only fed: its names are taken from its file, matched with the reference's, and it is run in the runtimes of
its format, as far as a file that anyone may have made is given to one. What it lacks, has too much or calls otherwise
is a failure that says what to map.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from converters.compiler.options import CompileOptions
from converters.files.children.process import LoadedModel, RunFailedError
from converters.files.folders import scratch_folder, size_of
from converters.formats.bundle.bundle import Bundle
from converters.formats.format import Format, Port, Ports
from converters.formats.read import ports_of
from converters.formats.source import OriginalRun, ReadOptions
from converters.policy.policy import Policy
from converters.runtimes.pool import RuntimePool, chosen_runtimes
from converters.runtimes.registry import RuntimeInfo
from exporter.compare.fit import misfit
from exporter.compare.weights import compare_rounded, merge_reports, rounded_to
from exporter.export.sources import read_source
from exporter.remote.fetching import nearby
from exporter.verify.checks.size import check_budget
from exporter.verify.difference import compare
from exporter.verify.options import VerifyOptions
from exporter.verify.participants import (
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
from exporter.verify.reference import random_outputs
from exporter.verify.report import ParityReport
from exporter.verify.tolerances import Tolerance, check_rules
from exporter.verify.verification import Judge, verify
from signatures.contract import POLICY
from signatures.errors import ExportModelError, RuntimeUnavailableError, UsageError, naming, suggestion
from signatures.roles import Role
from signatures.sampling import draw_cases
from signatures.spec import TensorSpec

_LOG = logging.getLogger(__name__)
Progress = Callable[[str], None]


class _Problem(Struct, frozen=True):
    """What does not fit, at which of the reference's names; ``blocking`` where a run would make no sense."""

    name: str
    text: str
    blocking: bool = False


class _Candidate(Struct, frozen=True):
    """A candidate's ports with the reference's names: what it is fed and asked for under its own."""

    label: str
    format: Format
    ports: Ports
    #: canonical input → the candidate's port
    inputs: Mapping[str, Port]
    #: canonical output → the candidate's name of it
    outputs: Mapping[str, str]
    #: the candidate's own inputs that have one value only, or the number of rows (None)
    constant: Mapping[str, np.ndarray | None]
    #: outputs that the candidate draws, because it makes the noise that the reference is fed
    drawn: frozenset[str]
    problems: tuple[_Problem, ...]
    #: outputs that export-model made for the reference, and that this one has none of
    missing_ok: tuple[str, ...] = ()

    def own_feeds(self, feeds: Feeds) -> dict[str, np.ndarray]:
        """What it is fed, by its own names, for the reference's inputs."""
        rows = next((len(a) for a in feeds.values() if a.ndim), 1)
        own = [(p, feeds[name]) for name, p in self.inputs.items()]
        given = {p.name: array.astype(p.dtype or array.dtype, copy=False) for p, array in own}
        ranks = {p.name: len(p.shape or ()) for p in self.ports.inputs}
        for name, value in self.constant.items():
            given[name] = np.full([1] * ranks[name], rows, np.int32) if value is None else np.asarray(value)
        return given

    @property
    def missing(self) -> list[str]:
        """Outputs of the reference that it has no name for."""
        return [p.name for p in self.problems if not p.blocking]


def compare_artefacts(
    reference: Path | str,
    candidates: Path | str | Sequence[Path | str],
    *,
    names: Mapping[str, str] | None = None,
    runtimes: str | Sequence[str] = "auto",
    options: VerifyOptions | None = None,
    understanding: CompileOptions | None = None,
    read: ReadOptions | None = None,
    allow_unverified: bool = False,
    progress: Progress = _LOG.info,
    understood: Callable[[Policy], object] | None = None,
    pool: RuntimePool | None = None,
    judge: Judge = verify,
) -> ParityReport:
    """Compare files that any tool made with a reference; every format of a candidate that is a bundle takes part.

    - ``names``: a name of the reference → what the candidates call it.
    - ``runtimes``: as in ``verify_bundle``; ``options``: seed, samples, tolerances.
    - ``understanding``, ``read``: how to read the reference (the flags ``--input``, ``--output``, ``--step``, …).
    - ``allow_unverified``: no error where none of the candidates' runtimes is installed.
    - ``progress``: called with each step; the default logs them.
    - ``understood``: called with the reference as it was understood, before anything runs.
    - ``judge``: what is made of the candidates' participants, in place of a verification.

    Raises ExportModelError where a file cannot be read, UsageError where a name of ``names`` is none,
    RuntimeUnavailableError where no runtime could run any::

        report = compare_artefacts("3DBall.bytes", "theirs.onnx", names={"action": "Identity"})
        assert report.passed, report.failures
    """
    with ExitStack() as opened:
        given = [candidates] if isinstance(candidates, Path | str) else candidates
        reference = opened.enter_context(nearby(Path(reference)))
        near = [opened.enter_context(nearby(Path(path))) for path in given]
        policy, source = _reference(reference, understanding, read)
        if understood is not None:
            understood(policy)
        artefacts = [(path, *found) for path in near for found in ports_of(path)]
        if not artefacts:
            raise UsageError("no candidate was given", fix="export-model compare REFERENCE CANDIDATE...")
        aliases = _with_user_names(_aliases(policy, reference), names or {}, [p for *_, p in artefacts])
        made = _made_here(reference, policy)
        labels = _labels(artefacts)
        matched = [
            _match(label, kind, ports, policy, aliases, made)
            for label, (_, kind, ports) in zip(labels, artefacts, strict=True)
        ]
        used, known = chosen_runtimes(runtimes, [m.format for m in matched])
        if options is not None:
            check_budget(options.budget, {m.label: 0 for m in matched})
            outputs = {policy.name: [s.name for s in policy.signature.outputs]}
            check_rules(options.rules, outputs, {m.format.key: m.format.runtimes for m in matched}, used)
        folder = Path(opened.enter_context(scratch_folder()))
        pool = opened.enter_context(RuntimePool()) if pool is None else pool
        reference_file = write_reference(policy, folder)
        copies = [_safe_copy(m, folder / str(number)) for number, m in enumerate(matched)]
        own = rounded_to(reference)
        kept = [None if (storage := rounded_to(path)) == own else storage for path, *_ in artefacts]
        reports = []
        for storage in dict.fromkeys(kept):
            chosen = [(m, copy) for m, copy, of in zip(matched, copies, kept, strict=True) if of == storage]
            sizes = {m.label: size_of(m.ports.path) for m, _ in chosen}
            tested = policy_under_test(policy, {}, folder, sizes=sizes, reference=reference_file, source=source)
            compared = partial(_compare, policy, chosen, used, known, pool, options, progress, judge)
            if storage is None:
                reports.append(compared(tested))
            else:
                reports.append(compare_rounded(tested, policy, storage, folder, compared, used, pool, options))
        report = merge_reports(reports)
    notes = [f"not compared, as {m.label} never had it: {', '.join(m.missing_ok)}" for m in matched if m.missing_ok]
    report = replace(report, notes=(*report.notes, *notes))
    if report.passed is None and not report.undecided and not (allow_unverified or runtimes == "none"):
        raise RuntimeUnavailableError(
            "no runtime that runs the candidates is installed, so nothing was compared",
            why=f"they are {', '.join(sorted({m.format.key for m in matched}))}",
            fix="export-model runtimes lists the runtimes and how to install each; or --allow-unverified",
        )
    return report


def _compare(
    policy: Policy,
    candidates: Sequence[tuple[_Candidate, Path]],
    runtimes: Sequence[str],
    known: Sequence[RuntimeInfo],
    pool: RuntimePool,
    options: VerifyOptions | None,
    progress: Progress,
    judge: Judge,
    tested: PolicyUnderTest,
) -> ParityReport:
    def taking_part(numpy_model: LoadedModel, failure: Failure) -> Iterator[Participant]:
        for candidate, copy in candidates:
            yield from _participants(candidate, copy, policy, numpy_model, runtimes, pool, failure)

    return judge(tested, runtimes, known, pool, options, progress, taking_part)


def _reference(
    path: Path, understanding: CompileOptions | None, read: ReadOptions | None
) -> tuple[Policy, OriginalRun | None]:
    found = list(read_source(path, read).compile_models(understanding))
    if len(found) > 1:
        raise UsageError(
            f"the reference holds {len(found)} policies",
            where=str(path),
            why=", ".join(p.name for _, p in found),
            fix="choose one with --brain, or give one model of it",
        )
    model, policy = found[0]
    return policy, model.original


def _labels(found: Sequence[tuple[Path, Format, Ports]]) -> list[str]:
    """What each candidate is called in the report: its format where that is enough, else with its path."""
    formats = [kind.key for _, kind, _ in found]
    if len(set(formats)) == len(formats) and len({path for path, *_ in found}) == 1:
        return formats
    paths = [ports.path.resolve() for *_, ports in found]
    for depth in range(2, max(len(p.parts) for p in paths) + 1):  # as much of the paths as tells them apart
        labels = [f"{key} {'/'.join(path.parts[-depth:])}" for key, path in zip(formats, paths, strict=True)]
        if len(set(labels)) == len(set(zip(formats, paths, strict=True))):
            break
    turns = [labels[:i].count(label) for i, label in enumerate(labels)]  # one file may be given twice
    return [f"{label} ({n + 1})" if n else label for label, n in zip(labels, turns, strict=True)]


# ---- names


def _base(name: str) -> str:
    """A name without the output index that TensorFlow and tf2onnx append, and what TF Serving prefixes."""
    return name.removesuffix(":0").removeprefix("serving_default_")


def _aliases(policy: Policy, path: Path) -> dict[str, tuple[str, ...]]:
    """Canonical name → what a candidate may call it: first what the reference's own file does, then the canonical."""
    keys: dict[str, str] = {}
    try:
        own = [ports for _, ports in ports_of(path)]
    except ExportModelError:  # a checkpoint, a .nn: what nobody feeds by name has no names beside the policy's
        own = []
    for port in (p for i in own for p in (*i.inputs, *i.outputs) if p.tensor is not None):
        keys.setdefault(_base(str(port.tensor)), _base(port.name))
    aliases: dict[str, tuple[str, ...]] = {}
    for spec in (*policy.signature.inputs, *policy.signature.outputs):
        source = _base(spec.source) if isinstance(spec.source, str) else spec.name
        aliases[spec.name] = tuple(dict.fromkeys([keys.get(source, source), source, spec.name]))
    return aliases


def _with_user_names(
    aliases: Mapping[str, tuple[str, ...]], names: Mapping[str, str], artefacts: Sequence[Ports]
) -> dict[str, tuple[str, ...]]:
    """The aliases, with what --map says before all others of a name. Raises UsageError."""
    ports = [p for i in artefacts for p in (*i.inputs, *i.outputs)]
    mapped = dict(aliases)
    for name, other in names.items():
        canonical = next((c for c, known in aliases.items() if _base(name) in known), None)
        if canonical is None:
            raise UsageError(
                f"--map {name}={other}: the reference has no input or output {name!r}",
                fix=_suggestion(name, [a for known in aliases.values() for a in known]),
            )
        if _find(other, ports) is None:
            raise UsageError(
                f"--map {name}={other}: no candidate has an input or output {other!r}",
                fix=_suggestion(other, [p.name for p in ports]),
            )
        # A candidate that calls it as the reference does needs no map: with several, each is found by its own name.
        mapped[canonical] = (other, *aliases[canonical])
    return mapped


def _suggestion(name: str, names: Sequence[str]) -> str:
    names = list(dict.fromkeys(names))
    return suggestion(name, names).strip() or f"there are {', '.join(names[:20])}"


def _find(name: str, ports: Sequence[Port]) -> Port | None:
    return next((p for p in ports if p.name == name), None) or next((p for p in ports if _base(p.name) == name), None)


def _made_here(path: Path, policy: Policy) -> frozenset[str]:
    """Outputs of the reference that its source had not, as a bundle's policy.json says (or the graph that was read)."""
    made = {s.name for s in policy.signature.outputs if s.source is None}
    if (path / POLICY).is_file():
        made |= {s.name for s in Bundle.open(path).signature.outputs if s.source is None}
    return frozenset(made)


def _match(
    label: str,
    kind: Format,
    own: Ports,
    policy: Policy,
    aliases: Mapping[str, Sequence[str]],
    made: frozenset[str],
) -> _Candidate:
    problems: list[_Problem] = []

    def port_of(spec: TensorSpec, ports: Sequence[Port]) -> Port | None:
        return next((p for a in aliases[spec.name] if (p := _find(a, ports)) is not None), None)

    signature = policy.signature
    inputs = {s.name: p for s in signature.inputs if (p := port_of(s, own.inputs)) is not None}
    found = {s.name: p for s in signature.outputs if (p := port_of(s, own.outputs)) is not None}
    lacking = [s for s in signature.inputs if s.name not in inputs]
    noise = frozenset(s.name for s in lacking if s.role is Role.NOISE)
    drawn = frozenset(policy.graph.descendants(noise).intersection(found))
    # What was made for the reference may be missing where all of it is: then the candidate is of another maker.
    missing_ok = tuple(sorted(made - set(found))) if found and not made & set(found) else ()
    for spec in signature.outputs:
        if spec.name not in found and spec.name not in missing_ok:
            text = f"missing output {aliases[spec.name][0]!r}; there are {_names(own.outputs)}"
            problems.append(_Problem(spec.name, text))
    needed = policy.graph.ancestors(found)
    for spec in lacking:
        if spec.role is not Role.NOISE and spec.name in needed:
            text = f"missing input {aliases[spec.name][0]!r}; there are {_names(own.inputs)}"
            problems.append(_Problem(spec.name, text, blocking=True))
    for spec in signature.inputs:
        wrong = misfit(spec, inputs[spec.name]) if spec.name in inputs else ""
        if wrong:
            problems.append(_Problem(spec.name, wrong, blocking=True))
    constant, left = _constants(own, policy, {p.name for p in inputs.values()})
    if not own.open:
        for port in left:
            text = f"it takes an input {port.name!r} that is not in the reference"
            problems.append(_Problem(port.name, text, blocking=True))
    outputs = {n: p.name for n, p in found.items()}
    return _Candidate(label, kind, own, inputs, outputs, constant, drawn, tuple(problems), missing_ok)


def _names(ports: Sequence[Port]) -> str:
    return ", ".join(repr(p.name) for p in ports[:12]) or "none"


def _constants(own: Ports, policy: Policy, taken: set[str]) -> tuple[dict[str, np.ndarray | None], list[Port]]:
    """(the candidate's inputs that are not policy inputs but known: batch_size, sequence_length; those unknown)."""
    fixed = {_base(n): np.asarray(v) for n, v in policy.source.fixed.items()}
    batches = {_base(n) for n in policy.source.batch_sizes}
    constant: dict[str, np.ndarray | None] = {}
    left = []
    for port in own.inputs:
        base = _base(port.name)
        if port.name in taken:
            continue
        if base in fixed:
            constant[port.name] = fixed[base]
        elif base in batches or base == "batch_size":
            constant[port.name] = None
        elif base == "sequence_length":
            constant[port.name] = np.array(1, np.int32)
        else:
            left.append(port)
    return constant, left


# ---- running


def _safe_copy(candidate: _Candidate, folder: Path) -> Path:
    """A copy of the candidate as far as a runtime may be given it: anyone may have made it. Raises ExportModelError."""
    found, ports = candidate.format, candidate.ports
    folder.mkdir()
    if found.vetted is None:
        return ports.path
    fed = [p.name for p in candidate.inputs.values()]
    wanted = [str(ports.options["signature"])] if found.signatures else [*candidate.outputs.values(), *fed]
    with naming(ports.path):
        return found.vetted(ports.path, [*wanted, *candidate.constant], folder)


def _participants(
    candidate: _Candidate,
    path: Path,
    policy: Policy,
    numpy_model: LoadedModel,
    runtimes: Sequence[str],
    pool: RuntimePool,
    failure: Failure,
) -> Iterator[Participant]:
    chosen = [r for r in candidate.format.runtimes if r in runtimes and r != "numpy"]
    for runtime in chosen:
        again = loading(runtime, path, candidate.ports.options, partial(_run_renamed, candidate))
        for model, run in load_model(again, pool, partial(_not_loaded, candidate, failure, runtime)):
            blocked = any(p.blocking for p in candidate.problems)
            hints = {} if blocked else _same_numbers(candidate, policy, numpy_model, model)
            _misfits(candidate, failure, runtime, hints)
            if candidate.outputs and not blocked:
                yield Participant(
                    format=":".join((candidate.format.key, *filter(None, [candidate.ports.options.get("signature")]))),
                    runtime=runtime,
                    run=run,
                    outputs=list(candidate.outputs),
                    model=model,
                    label=candidate.label,
                    drawn=candidate.drawn,
                    path=path,
                    fed=candidate.own_feeds,
                    again=again,
                )


def _not_loaded(candidate: _Candidate, failure: Failure, runtime: str, error: RunFailedError, output: str) -> None:
    failure(candidate.label, runtime, error, output)
    _misfits(candidate, failure, runtime, {})


def _misfits(candidate: _Candidate, failure: Failure, runtime: str, hints: Mapping[str, str]) -> None:
    for problem in candidate.problems:
        failure(candidate.label, runtime, RunFailedError(problem.text + hints.get(problem.name, "")), problem.name)


def _same_numbers(
    candidate: _Candidate, policy: Policy, numpy_model: LoadedModel, model: LoadedModel
) -> dict[str, str]:
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


def _run_renamed(candidate: _Candidate, model: LoadedModel) -> Run:

    def run(inputs: Sequence[Feeds], fetch: Sequence[str]) -> list[dict[str, np.ndarray]]:
        answers = model.run_all([candidate.own_feeds(feeds) for feeds in inputs], [candidate.outputs[n] for n in fetch])
        return [{n: answer[candidate.outputs[n]] for n in fetch} for answer in answers]

    return run
