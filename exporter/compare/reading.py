"""Candidates that are read as ``export`` reads them, and answer under the reference's names.

A file whose own names, batch or memories are not the reference's is run in the runtime of its kind, which is given what
its tensors take (exporter/verify/original.py); one that no runtime loads by itself is written as ONNX and run as that.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.files.children.process import LoadedModel, RunFailedError
from export_model.converters.formats.format import Format, WriteOptions
from export_model.converters.formats.onnx.exporters import FAULT_NOTE
from export_model.converters.formats.registry import FROZEN_GRAPH, KERNELS, ONNX
from export_model.converters.formats.source import OriginalRun, ReadOptions
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.compare.pairing import Pairing, alike, axes_to, pair_policies, source_name, source_names
from export_model.exporter.export.sources import read_source
from export_model.exporter.verify.original import Original
from export_model.exporter.verify.participants import Failure, Feeds, Participant
from export_model.signatures.errors import ExportModelError, SourceError
from export_model.signatures.interface import Interface
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec

#: What a policy is written as where no runtime here loads its own file.
_WRITTEN_AS = (ONNX, FROZEN_GRAPH)
#: Inputs that only the candidate has, and what says nothing in each: no noise, every action allowed.
_NEUTRAL = {Role.NOISE: 0.0, Role.MASKS: 1.0}
#: What many makers call an action, and readers of files without names: it tells no maker.
_ANYONES = frozenset(("action", "actions"))
#: Options that each side of a comparison has its own of (exporter/cli/rows.py); the reference's have no prefix.
APART = (
    "step",
    "brain",
    "input",
    "output",
    "set",
    "sensors",
    "activation",
    "script",
    "repair",
    "normaliser",
    "interface",
)
_FLAG = re.compile(rf"(?<![\w-])--({'|'.join(APART)})(?![\w-])")


class ReadCandidate(Struct, frozen=True):
    """A candidate as the policy that ``export`` makes of it, beside the reference's."""

    label: str
    format: Format
    path: Path
    policy: Policy
    original: OriginalRun | None
    pairing: Pairing

    #: what its weights were rounded to: a file that is read has them as they are
    weights: Storage | None = None

    @property
    def faults(self) -> tuple[str, ...]:
        """Faults of the exporter that wrote it, as sentences."""
        return tuple(note for note in self.policy.signature.notes if note.startswith(FAULT_NOTE))

    @property
    def interface(self) -> Interface | None:
        """What the file states of its numbers."""
        return self.policy.signature.interface

    @property
    def input_names(self) -> Mapping[str, str]:
        """The reference's input → the name that the interface has for it."""
        return self.pairing.inputs

    @property
    def forms(self) -> tuple[Format, ...]:
        """The formats that it may be run as."""
        return (self.format, *_WRITTEN_AS)

    def may_be_fed(self, reference: Policy) -> bool:
        """Whether its own names, fed, mean the reference's tensors: any number of rows, and nothing joined or reshaped.

        That it does not draw as the reference does is a fault where it is of one maker, else what both can say counts.
        """
        kept = not self.pairing.apart or self.shares_names(reference)
        return self.policy.source.rows is None and not self.pairing.reshaped and not any(self.pairing.joined) and kept

    def limit_outputs(self, names: Collection[str]) -> ReadCandidate:
        """Return the candidate with no more outputs than the file gives: an intermediate tensor is none."""
        declared = {s.name for s in self.policy.signature.outputs if source_names(s) <= {*names}}
        outputs = {ours: theirs for ours, theirs in self.pairing.outputs.items() if theirs in declared}
        return replace(self, pairing=replace(self.pairing, outputs=outputs))

    def shares_names(self, reference: Policy) -> bool:
        """Whether both files call an output alike, by a name that not everyone gives: they are of one maker."""
        ours, theirs = (p.signature.outputs for p in (reference, self.policy))
        alike = {n for s in ours for n in source_names(s)} & {n for s in theirs for n in source_names(s)}
        return bool(alike - _ANYONES)

    @property
    def names(self) -> list[str]:
        """Names of its inputs and outputs, in the policy and in the file."""
        specs = (*self.policy.signature.inputs, *self.policy.signature.outputs)
        return [n for s in specs for n in (s.name, *source_names(s))]

    def own_names(self, name: str) -> list[str]:
        """Return what the file calls the reference's ``name``, where it has one tensor for it."""
        specs = (*self.policy.signature.inputs, *self.policy.signature.outputs)
        own = {**self.pairing.inputs, **self.pairing.outputs}.get(name)
        return [n for s in specs if s.name == own and isinstance(s.source, str) for n in source_names(s)]

    def place(self, runtimes: Sequence[str]) -> tuple[Format | None, str]:
        """Return (what it is written as, None: it is run as it is; the runtime)."""
        if self.original is not None and self.original.runtime in runtimes:
            return None, self.original.runtime
        places = ((form, r) for form in _WRITTEN_AS for r in form.runtimes if r in runtimes and r != KERNELS)
        return next(places, (FROZEN_GRAPH, KERNELS))

    def missing(self, reference: Policy) -> list[str]:
        """Return the reference's outputs that it lacks: of one maker all that count, of another the memory."""
        whole = self.shares_names(reference)
        outputs = [s for s in reference.signature.outputs if whole or s.role is Role.MEMORY_OUT]
        return [s.name for s in outputs if s.source is not None and not self._answers(s)]

    def _answers(self, spec: TensorSpec) -> bool:
        return spec.name in self.pairing.outputs or spec.role in self.pairing.incomparable

    def problems(self, reference: Policy) -> Iterator[tuple[str, str]]:
        """Yield (the reference's name, what does not fit there); nothing is run where an input does not."""
        there = ", ".join(repr(s.name) for s in self.policy.signature.inputs)
        for name in self.pairing.lacking:
            if reference.signature.input(name).role is not Role.NOISE:
                yield name, f"missing input {name!r}; there are {there}"
        for name in self.pairing.surplus:
            if self.policy.signature.input(name).role not in _NEUTRAL:
                yield name, f"it takes an input {name!r} that is not in the reference"

    def notes(self, reference: Policy, runtimes: Sequence[str]) -> Iterator[str]:
        """Yield what is compared otherwise than it is called, as sentences."""
        form, _ = self.place(runtimes)
        yield from (f"{self.label}: {fault}" for fault in self.faults)
        if form is not None:
            yield f"{self.label} was run as export-model's {form.label.removeprefix('an ').removeprefix('a ')} of it"
        rows = self.policy.source.rows
        if form is None and rows is not None:
            yield f"{self.label} takes {rows} row{'s' if rows > 1 else ''} at a time, and was compared so"
        for note in (*self.pairing.apart, *self.pairing.reshaped):
            yield f"{self.label}: {note}"
        if any(self.pairing.joined):
            whole, parts = (" + ".join(names) for names in self.pairing.joined)
            yield f"{self.label}: {whole} = {parts}, in this order"
        pairs = {**self.pairing.inputs, **self.pairing.outputs}
        specs = {s.name: s for s in (*self.policy.signature.inputs, *self.policy.signature.outputs)}
        for role in self.pairing.by_order:
            ours = (s for s in (*reference.signature.inputs, *reference.signature.outputs) if s.role == role)
            named = [
                f"{s.name} = {source_name(specs[pairs[s.name]]) or pairs[s.name]}" for s in ours if s.name in pairs
            ]
            yield f"{self.label}: {', '.join(named)} by their order; --map NAME=OTHER says otherwise"


def read_candidate(
    label: str,
    path: Path,
    reference: Policy,
    read: ReadOptions | None,
    understanding: CompileOptions | None,
    names: Mapping[str, str],
) -> ReadCandidate:
    """Read a file as the policy it holds. Raises ExportModelError, SourceError where it holds several."""
    with naming_candidates_options():
        source = read_source(path, read)
        found = list(source.compile_models(understanding))
        if len(found) > 1:
            raise SourceError(
                f"the candidate holds {len(found)} policies",
                where=str(path),
                why=", ".join(p.name.removeprefix(f"{source.stem(m)}-") for m, p in found),
                fix="choose one with --brain, or give one model of it",
            )
    model, policy = found[0]
    return ReadCandidate(label, source.format, path, policy, model.original, pair_policies(reference, policy, names))


@contextmanager
def naming_candidates_options() -> Iterator[None]:
    """Let an error name the options of candidates in the place of the reference's."""
    try:
        yield
    except ExportModelError as error:
        error.what = _FLAG.sub(r"--candidate-\1", error.what)
        error.why, error.fix = (t and _FLAG.sub(r"--candidate-\1", t) for t in (error.why, error.fix))
        error.args = (error.message,)
        raise


def read_participants(
    candidate: ReadCandidate,
    reference: Policy,
    runtimes: Sequence[str],
    pool: RuntimePool,
    folder: Path,
    failure: Failure,
) -> Iterator[Participant]:
    """Yield the candidate in the runtime of its kind, or in one that runs what it is written as.

    What does not load or fit goes to ``failure``. Raises OSError.
    """
    form, runtime = candidate.place(runtimes)
    problems = list(candidate.problems(reference))
    for name in [] if problems else candidate.missing(reference):
        failure(candidate.label, runtime, RunFailedError(f"missing output {name!r}"), name)
    for name, text in problems:
        failure(candidate.label, runtime, RunFailedError(text), name)
    if problems:
        return
    try:
        model = _load(candidate, form, runtime, pool, folder)
        answering = _Answering(candidate, reference, model, as_it_is=form is None)
    except RunFailedError as error:
        failure(candidate.label, runtime, error, "*")
        return
    yield Participant(
        format=candidate.format.key,
        runtime=runtime,
        run=answering.run,
        outputs=list(answering.outputs),
        model=model,
        label=candidate.label,
    )
    model.unload()


def _load(candidate: ReadCandidate, form: Format | None, runtime: str, pool: RuntimePool, folder: Path) -> LoadedModel:
    if form is None:
        assert candidate.original is not None
        with candidate.original.loadable() as (path, options):
            return pool.process(runtime).load(path, **options)
    artifact = form.artifact(candidate.policy, WriteOptions("{}"))
    artifact.write(folder)
    return pool.process(runtime).load(str(folder / artifact.main), **form.loader())


class _Answering:
    """A candidate that is asked in the reference's names; ``outputs``: the reference's → its own, which it answers."""

    def __init__(self, candidate: ReadCandidate, reference: Policy, model: LoadedModel, *, as_it_is: bool) -> None:
        own, pairing = candidate.policy, candidate.pairing
        self._pairing = pairing
        self._ours, self._theirs, self._model = reference.signature, own.signature, model
        self._fed = {theirs: ours for ours, theirs in pairing.inputs.items()}
        self._original = Original(model, own.signature, own.source) if as_it_is else None
        answered = {s.name for s in own.signature.outputs} if self._original is None else self._original.output_names
        self.outputs = {ours: theirs for ours, theirs in pairing.outputs.items() if theirs in answered}

    def run(self, inputs: Sequence[Feeds], fetch: Sequence[str]) -> list[dict[str, np.ndarray]]:
        """Answer as a participant does."""
        own = [{**self._feeds(feeds), **self._split_vectors(feeds)} for feeds in inputs]
        wanted = list(dict.fromkeys(self.outputs[name] for name in fetch))
        answers = self._model.run_all(own, wanted) if self._original is None else self._original.run_all(own)
        return [{name: self._as_reference(name, answer[self.outputs[name]]) for name in fetch} for answer in answers]

    def _feeds(self, feeds: Feeds) -> dict[str, np.ndarray]:
        rows, own = self._ours.rows(feeds), {}
        for spec in self._theirs.inputs:
            shape = [rows if n is None else n for n in spec.shape]
            if spec.name in self._fed:
                ours = self._ours.input(self._fed[spec.name])
                own[spec.name] = _to_layout(feeds[ours.name], ours, spec).astype(spec.dtype, copy=False)
            elif spec.role in _NEUTRAL:
                own[spec.name] = np.full(shape, _NEUTRAL[spec.role], spec.dtype)
        return own

    def _split_vectors(self, feeds: Feeds) -> dict[str, np.ndarray]:
        """The vectors that are one on one side, and several on the other."""
        ours, theirs = self._pairing.joined
        if not ours:
            return {}
        ends = np.cumsum([self._theirs.input(name).shape[1] or 0 for name in theirs])[:-1]
        return dict(zip(theirs, np.split(np.concatenate([feeds[n] for n in ours], axis=1), ends, axis=1), strict=True))

    def _as_reference(self, name: str, array: np.ndarray) -> np.ndarray:
        ours, theirs = self._ours.output(name), self._theirs.output(self.outputs[name])
        array = _to_layout(array, theirs, ours)
        integers = array.dtype.kind in "iu" and np.dtype(ours.dtype).kind in "iu"
        return array.astype(ours.dtype, copy=False) if integers else array


def _to_layout(array: np.ndarray, spec: TensorSpec, other: TensorSpec) -> np.ndarray:
    """Return an array of ``spec`` in the layout and rank of ``other``."""
    order = axes_to(spec.shape, other.shape)
    if order is not None:
        return array.transpose(order) if array.ndim == len(order) else array
    if not alike(spec, other):
        return array  # of other numbers: the comparison says so
    return array.reshape(len(array), *(n or -1 for n in other.shape[1:]))
