"""Inputs that a user recorded, and what the policy answered then: ``--golden FILE.npz``.

An archive of numpy's, one array for each input, under its canonical name or the source's ("vector_observation",
"vector_observation:0"), all with the same number of rows. What an episode starts with may be left out: memory and noise
are then zero, masks allow everything. Arrays under the names of outputs are the answers to hold the policy against.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from msgspec import Struct

from export_model.converters.files.fetch import read_bytes
from export_model.converters.files.zip_archives import ZIP_ERRORS, entry_of, open_archive
from export_model.exporter.verify.npy import read_array
from export_model.signatures.errors import SourceError, UsageError
from export_model.signatures.roles import Role
from export_model.signatures.sampling import Case
from export_model.signatures.spec import PolicySignature, TensorSpec

#: Rows that are run at once; a recording may hold thousands.
_ROWS = 64
#: A recording may unpack to this many bytes, and so many times its own.
MAX_UNPACKED_FREE, MAX_UNPACKED_FACTOR = 1 << 26, 20
_DEFAULTS = {Role.MEMORY_IN: 0, Role.NOISE: 0, Role.MASKS: 1}


class Golden(Struct, frozen=True):
    """What was recorded: cases to run, and for each the recorded outputs (by canonical name; none may be there)."""

    cases: tuple[Case, ...] = ()
    answers: tuple[Mapping[str, np.ndarray], ...] = ()
    #: noise that was not recorded, so that what depends on it cannot be held against the recording
    noiseless: frozenset[str] = frozenset()


def read_golden(path: Path, signature: PolicySignature) -> Golden:
    """The recording in ``path``, in batches. Raises UsageError on whatever does not fit the policy."""
    arrays = read_arrays(path, "--golden")
    specs = {**_by_name(signature.outputs), **_by_name(signature.inputs)}
    given: dict[str, np.ndarray] = {}
    noiseless: set[str] = set()
    for name, array in arrays.items():
        spec = specs.get(name) or specs.get(name.removesuffix(":0"))
        if spec is None:
            known = ", ".join(s.name for s in (*signature.inputs, *signature.outputs))
            raise _recording_error(path, f"{name!r} is not an input or output of the policy", f"there are {known}")
        given[spec.name] = _fitting(path, spec, array)
    rows = _rows(path, signature, given)
    for spec in signature.inputs:
        if spec.name in given:
            continue
        if spec.role not in _DEFAULTS:
            fix = "record every observation; memory, noise and masks may be left out"
            raise _recording_error(path, f"the input {spec.name!r} was not recorded", fix)
        if spec.role is Role.NOISE:
            noiseless.add(spec.name)
        shape = tuple(rows if i == 0 else n or 1 for i, n in enumerate(spec.shape))
        given[spec.name] = np.full(shape, _DEFAULTS[spec.role], spec.dtype)
    outputs = [s.name for s in signature.outputs if s.name in given]
    cases, answers = [], []
    for first in range(0, rows, _ROWS):
        last = min(first + _ROWS, rows)
        feeds = {s.name: given[s.name][first:last] if s.batched else given[s.name] for s in signature.inputs}
        cases.append(Case(f"golden, rows {first}-{last - 1}", feeds, last - first))
        answers.append({name: given[name][first:last] for name in outputs})
    return Golden(tuple(cases), tuple(answers), frozenset(noiseless))


def read_recording(path: Path, option: str = "--golden") -> bytes:
    """The content of a recording. Raises UsageError where it cannot be read."""
    try:
        return read_bytes(path)
    except SourceError as error:
        raise _recording_error(path, error.what, error.fix, error.why, option) from error


def read_arrays(path: Path, option: str) -> dict[str, np.ndarray]:
    """The arrays of an .npz archive that was given to ``option``, by name. Raises UsageError."""
    data = read_recording(path, option)
    try:
        with open_archive(data) as archive:
            names = archive.namelist()
            odd = next((name for name in names if not name.endswith(".npy")), None)
            if odd is not None:
                raise ValueError(f"{odd[:80]!r} must be an array")
            whole = sum(entry.file_size for entry in archive.infolist())
            if whole > MAX_UNPACKED_FREE + MAX_UNPACKED_FACTOR * len(data):
                raise ValueError(f"its {len(data)} bytes unpack to {whole}")
            return {name.removesuffix(".npy"): read_array(entry_of(archive, name, whole)) for name in names}
    except (*ZIP_ERRORS, TypeError, RecursionError) as error:
        fix = "numpy.savez(FILE, …)"
        raise _recording_error(path, "cannot be read as an .npz archive", fix, str(error), option) from error


def _recording_error(
    path: Path, what: str, fix: str | None, why: str | None = None, option: str = "--golden"
) -> UsageError:
    return UsageError(f"{option}: {what}", where=str(path), why=why, fix=fix)


def _by_name(specs: tuple[TensorSpec, ...]) -> dict[str, TensorSpec]:
    """Every name that a tensor may be recorded under; the canonical ones win."""
    names = {s.source.removesuffix(":0"): s for s in specs if isinstance(s.source, str)}
    return {**names, **{s.name: s for s in specs}}


def _fitting(path: Path, spec: TensorSpec, array: np.ndarray) -> np.ndarray:
    if not spec.fits(array) or array.dtype.kind not in "fiub":
        wanted = "[" + ", ".join("rows" if n is None else str(n) for n in spec.shape) + "]"
        what = f"{spec.name!r} is {array.dtype} {list(array.shape)}, and {spec.dtype} {wanted} is wanted"
        raise _recording_error(path, what, "record it as the policy takes and gives it, a row for each step")
    return np.ascontiguousarray(array.astype(spec.dtype))


def _rows(path: Path, signature: PolicySignature, given: Mapping[str, np.ndarray]) -> int:
    free = {s.name for s in (*signature.inputs, *signature.outputs) if s.batched}
    counts = {name: len(array) for name, array in given.items() if name in free}
    if not counts or min(counts.values()) != max(counts.values()) or not min(counts.values()):
        said = ", ".join(f"{name} {count}" for name, count in counts.items()) or "none"
        fix = "give every array a row for each recorded step"
        raise _recording_error(path, "the arrays have not the same number of rows", fix, f"rows: {said}")
    return min(counts.values())
