"""Which input and output of a candidate, made by any tool, is which of the reference's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.compiler.passes.weights import Storage
from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.bundle.bundle import Bundle
from export_model.converters.formats.format import Format, Port, Ports
from export_model.converters.formats.read import ports_of
from export_model.converters.formats.recognise import recognise_path
from export_model.converters.formats.source import ReadOptions
from export_model.converters.policy.policy import Policy
from export_model.exporter.compare.fit import misfit
from export_model.exporter.compare.reading import ReadCandidate, read_candidate
from export_model.exporter.compare.weights import rounded_to
from export_model.exporter.verify.participants import (
    Feeds,
)
from export_model.signatures.contract import POLICY
from export_model.signatures.errors import ExportModelError, UsageError, suggestion
from export_model.signatures.interface import Interface
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec


class Problem(Struct, frozen=True):
    """What does not fit, at which of the reference's names; ``blocking`` where a run would make no sense."""

    name: str
    text: str
    blocking: bool = False


class Candidate(Struct, frozen=True):
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
    problems: tuple[Problem, ...]
    #: outputs that export-model made for the reference, and this one has none of, or that it was written without
    missing_ok: tuple[str, ...] = ()
    #: what the file states of its numbers
    interface: Interface | None = None
    #: faults of the exporter that wrote it, as sentences
    faults: tuple[str, ...] = ()
    #: names that its roles gave, as "the reference's = its own"
    by_role: tuple[str, ...] = ()
    #: what its weights were rounded to, where they were
    weights: Storage | None = None

    @property
    def path(self) -> Path:
        """What a loader is given."""
        return self.ports.path

    @property
    def input_names(self) -> Mapping[str, str]:
        """The reference's input → the name that the interface has for it."""
        return {name: name for name in self.inputs}

    @property
    def forms(self) -> tuple[Format, ...]:
        """The formats that it may be run as."""
        return (self.format,)

    def notes(self, reference: Policy, runtimes: Sequence[str]) -> Iterator[str]:
        """Yield what was not compared, or under another name, as sentences."""
        if self.missing_ok:
            yield f"not compared, as {self.label} never had it: {', '.join(self.missing_ok)}"
        yield from (f"{self.label}: {fault}" for fault in self.faults)
        if self.by_role:
            yield f"{self.label}: {', '.join(self.by_role)}, by their roles"

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


#: Fed by its own names, or answering as it was read.
AnyCandidate: TypeAlias = Candidate | ReadCandidate


class Artefact(Struct, frozen=True):
    """One file or folder of a candidate; ``ports`` is None where no runtime loads it by itself."""

    place: Path
    format: Format
    ports: Ports | None

    @property
    def path(self) -> Path:
        """What a loader or a reader is given."""
        return self.place if self.ports is None else self.ports.path


def match_candidates(
    policy: Policy,
    reference: Path,
    near: Sequence[Path],
    names: Mapping[str, str],
    read: ReadOptions | None = None,
    understanding: CompileOptions | None = None,
) -> list[AnyCandidate]:
    """Return what is at the paths with the reference's names: fed by its own names where these fit, else as it is read.

    ``read`` and ``understanding`` say how candidates are read. Raises UsageError where there is none or a name of
    ``names`` is none, and ExportModelError where a candidate can be neither fed nor read.
    """
    artefacts = [a for path in near for a in _artefacts(path)]
    if not artefacts:
        raise UsageError("no candidate was given", fix="export-model compare REFERENCE CANDIDATE...")
    labels = labels_of(artefacts)
    readings = [
        _reading(label, a, policy, names, read, understanding) for label, a in zip(labels, artefacts, strict=True)
    ]
    ports = [p for a in artefacts if a.ports for p in (*a.ports.inputs, *a.ports.outputs)]
    known = [p.name for p in ports] + [n for r in readings if r is not None for n in r.names]
    aliases = _with_user_names(_aliases(policy, reference), names, known)
    made = _made_here(reference, policy)
    return [
        _feed_or_read(label, artefact, reading, policy, aliases, made)
        for label, artefact, reading in zip(labels, artefacts, readings, strict=True)
    ]


def _artefacts(path: Path) -> list[Artefact]:
    kind = recognise_path(Fetched(path))
    if kind.ports is None and kind.readable:
        return [Artefact(path, kind, None)]
    return [Artefact(path, form, ports) for form, ports in ports_of(path)]


def _reading(
    label: str,
    artefact: Artefact,
    policy: Policy,
    names: Mapping[str, str],
    read: ReadOptions | None,
    understanding: CompileOptions | None,
) -> ReadCandidate | None:
    """Read a candidate; None for a bundle's, whose names are the canonical ones, and where it can only be fed."""
    if not artefact.format.readable or (artefact.place / POLICY).is_file():
        return None
    try:
        return read_candidate(label, artefact.place, policy, read, understanding, names)
    except UsageError:
        raise
    except ExportModelError:
        if artefact.ports is None:
            raise
        return None


def _feed_or_read(
    label: str,
    artefact: Artefact,
    reading: ReadCandidate | None,
    policy: Policy,
    aliases: Mapping[str, tuple[str, ...]],
    made: frozenset[str],
) -> AnyCandidate:
    """Feed it by its own names where these fit and mean the same, else as it is read."""
    weights = rounded_to(artefact.place)
    if artefact.ports is None:
        assert reading is not None
        return reading
    if reading is None:
        fed = _match(label, artefact.format, artefact.ports, policy, aliases, made)
        bundle = (artefact.place / POLICY).is_file()
        stated = Bundle.open(artefact.place).signature.interface if bundle else None
        return replace(fed, weights=weights, interface=stated)
    ports = (*artefact.ports.inputs, *artefact.ports.outputs)
    keys = {_base(p.tensor): _base(p.name) for p in ports if p.tensor is not None}
    own = {n: (*known, *(keys.get(o, o) for o in reading.own_names(n))) for n, known in aliases.items()}
    fed = _match(label, artefact.format, artefact.ports, policy, own, made)
    read = reading if artefact.ports.open else reading.limit_outputs({_base(p.tensor or p.name) for p in ports})
    if not reading.may_be_fed(policy):
        return read
    if fed.problems:
        # What lacks an output either way is fed: then the numbers of its others say what to map.
        blocked = any(p.blocking for p in fed.problems)
        return read if blocked or not read.missing(policy) else replace(fed, weights=weights)
    called = {**{n: p.name for n, p in fed.inputs.items()}, **fed.outputs}
    by_role = tuple(f"{n} = {other}" for n, other in called.items() if _base(other) not in aliases[n])
    return replace(fed, weights=weights, by_role=by_role, interface=reading.interface, faults=reading.faults)


def labels_of(found: Sequence[Artefact]) -> list[str]:
    """What each candidate is called in the report: its format where that is enough, else with its path."""
    formats = [a.format.key for a in found]
    if len(set(formats)) == len(formats) and len({a.place for a in found}) == 1:
        return formats
    paths = [a.path.resolve() for a in found]
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
    aliases: Mapping[str, tuple[str, ...]], names: Mapping[str, str], theirs: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """The aliases, with what --map says before all others of a name. Raises UsageError."""
    mapped = dict(aliases)
    for name, other in names.items():
        canonical = next((c for c, known in aliases.items() if _base(name) in known), None)
        if canonical is None:
            raise UsageError(
                f"--map {name}={other}: the reference has no input or output {name!r}",
                fix=_suggestion(name, [a for known in aliases.values() for a in known]),
            )
        if other not in {*theirs, *map(_base, theirs)}:
            raise UsageError(
                f"--map {name}={other}: no candidate has an input or output {other!r}",
                fix=_suggestion(other, theirs),
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
) -> Candidate:
    problems: list[Problem] = []

    def port_of(spec: TensorSpec, ports: Sequence[Port]) -> Port | None:
        return next((p for a in aliases[spec.name] if (p := _find(a, ports)) is not None), None)

    signature = policy.signature
    inputs = {s.name: p for s in signature.inputs if (p := port_of(s, own.inputs)) is not None}
    found = {s.name: p for s in signature.outputs if (p := port_of(s, own.outputs)) is not None}
    lacking = [s for s in signature.inputs if s.name not in inputs]
    noise = frozenset(s.name for s in lacking if s.role is Role.NOISE)
    drawn = frozenset(policy.graph.descendants(noise).intersection(found))
    missing_ok = _may_lack(own, found, made, signature.outputs)
    for spec in signature.outputs:
        if spec.name not in found and spec.name not in missing_ok:
            text = f"missing output {aliases[spec.name][0]!r}; there are {_names(own.outputs)}"
            problems.append(Problem(spec.name, text))
    needed = policy.graph.ancestors(found)
    for spec in lacking:
        if spec.role is not Role.NOISE and spec.name in needed:
            text = f"missing input {aliases[spec.name][0]!r}; there are {_names(own.inputs)}"
            problems.append(Problem(spec.name, text, blocking=True))
    for spec in signature.inputs:
        wrong = misfit(spec, inputs[spec.name]) if spec.name in inputs else ""
        if wrong:
            problems.append(Problem(spec.name, wrong, blocking=True))
    constant, left = _constants(own, policy, {p.name for p in inputs.values()})
    if not own.open:
        for port in left:
            text = f"it takes an input {port.name!r} that is not in the reference"
            problems.append(Problem(port.name, text, blocking=True))
    outputs = {n: p.name for n, p in found.items()}
    return Candidate(
        label=label,
        format=kind,
        ports=own,
        inputs=inputs,
        outputs=outputs,
        constant=constant,
        drawn=drawn,
        problems=tuple(problems),
        missing_ok=missing_ok,
    )


def _may_lack(
    own: Ports, found: Mapping[str, Port], made: frozenset[str], outputs: Sequence[TensorSpec]
) -> tuple[str, ...]:
    """Outputs that may be missing: what the candidate was written without; all of what was made for the reference.

    Where all of that is missing, the candidate is of another maker. One that has no output may lack none.
    """
    others_make = not made & set(found)
    able = {*own.left_out, *(made if others_make else ())}
    return tuple(sorted(s.name for s in outputs if s.name in able and s.name not in found)) if found else ()


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
