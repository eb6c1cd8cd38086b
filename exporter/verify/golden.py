"""Inputs that a user recorded, and what the policy answered then: ``--golden FILE.npz``.

An archive of numpy's, one array for each input, under its canonical name or the source's ("vector_observation",
"vector_observation:0"), all with the same number of rows. What an episode starts with may be left out: memory and noise
are then zero, masks allow everything. Arrays under the names of outputs are the answers to hold the policy against.
"""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

from signatures.errors import UsageError
from signatures.records import dataclass
from signatures.roles import Role
from signatures.sampling import Case
from signatures.spec import PolicySignature, TensorSpec

#: Rows that are run at once; a recording may hold thousands.
_ROWS = 64
#: A recording may unpack to this many bytes, and so many times its own.
MAX_UNPACKED_FREE, MAX_UNPACKED_FACTOR = 1 << 26, 20
#: What zipfile, and numpy where it reads a header, raise for a damaged archive.
_BROKEN = (
    *(OSError, ValueError, TypeError, EOFError, MemoryError, OverflowError, NotImplementedError, RuntimeError),
    *(SyntaxError, tokenize.TokenError, zipfile.BadZipFile, zlib.error, struct.error),
)
_DEFAULTS = {Role.MEMORY_IN: 0, Role.NOISE: 0, Role.MASKS: 1}


@dataclass(frozen=True)
class Golden:
    """What was recorded: cases to run, and for each the recorded outputs (by canonical name; none may be there)."""

    cases: tuple[Case, ...] = ()
    answers: tuple[Mapping[str, np.ndarray], ...] = ()
    #: noise that was not recorded, so that what depends on it cannot be held against the recording
    noiseless: frozenset[str] = frozenset()


def read_golden(path: Path, signature: PolicySignature) -> Golden:
    """The recording in ``path``, in batches. Raises UsageError on whatever does not fit the policy."""
    arrays = _arrays(path)
    specs = {**_by_name(signature.outputs), **_by_name(signature.inputs)}
    given: dict[str, np.ndarray] = {}
    noiseless: set[str] = set()
    for name, array in arrays.items():
        spec = specs.get(name) or specs.get(name.removesuffix(":0"))
        if spec is None:
            raise UsageError(
                f"--golden: {name!r} is no input or output of the policy",
                where=str(path),
                fix=f"there are {', '.join(s.name for s in (*signature.inputs, *signature.outputs))}",
            )
        given[spec.name] = _fitting(path, spec, array)
    rows = _rows(path, signature, given)
    for spec in signature.inputs:
        if spec.name in given:
            continue
        if spec.role not in _DEFAULTS:
            raise UsageError(
                f"--golden: the input {spec.name!r} was not recorded",
                where=str(path),
                fix="record every observation; memory, noise and masks may be left out",
            )
        if spec.role is Role.NOISE:
            noiseless.add(spec.name)
        shape = tuple(rows if i == 0 else n or 1 for i, n in enumerate(spec.shape))
        given[spec.name] = np.full(shape, _DEFAULTS[spec.role], spec.dtype)
    outputs = [s.name for s in signature.outputs if s.name in given]
    cases, answers = [], []
    for first in range(0, rows, _ROWS):
        last = min(first + _ROWS, rows)
        feeds = {s.name: _part(s, given[s.name], first, last) for s in signature.inputs}
        cases.append(Case(f"golden, rows {first}-{last - 1}", feeds, last - first))
        answers.append({name: given[name][first:last] for name in outputs})
    return Golden(tuple(cases), tuple(answers), frozenset(noiseless))


def _arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        _check_sizes(path)
        with path.open("rb") as file:  # numpy leaves a file open that it opened itself and cannot read
            archive = np.load(file, allow_pickle=False)
            if isinstance(archive, np.ndarray):
                raise UsageError("--golden: is one array, not an archive", where=str(path), fix="numpy.savez(FILE, …)")
            with archive:
                return {name: archive[name] for name in archive.files}
    except _BROKEN as error:
        raise UsageError(
            "--golden: cannot be read as an .npz archive", where=str(path), why=str(error), fix="numpy.savez(FILE, …)"
        ) from error


def _check_sizes(path: Path) -> None:
    """Raise ValueError where an archive's arrays say to be larger than any recording, before one is read."""
    if not zipfile.is_zipfile(path):
        return
    with zipfile.ZipFile(path) as archive:
        whole = sum(entry.file_size for entry in archive.infolist())
        for entry in archive.infolist():
            if not entry.filename.endswith(".npy"):
                raise ValueError(f"{entry.filename[:80]!r} is no array")
            with archive.open(entry) as file:
                shape, dtype = _header(file)
            if math.prod(shape) * dtype.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename} says to be {list(shape)[:8]} and has {entry.file_size} bytes")
    if whole > MAX_UNPACKED_FREE + MAX_UNPACKED_FACTOR * path.stat().st_size:
        raise ValueError(f"its {path.stat().st_size} bytes unpack to {whole}")


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    return shape, dtype


def _by_name(specs: tuple[TensorSpec, ...]) -> dict[str, TensorSpec]:
    """Every name that a tensor may be recorded under; the canonical ones win."""
    names = {s.source.removesuffix(":0"): s for s in specs if isinstance(s.source, str)}
    return {**names, **{s.name: s for s in specs}}


def _fitting(path: Path, spec: TensorSpec, array: np.ndarray) -> np.ndarray:
    same = array.ndim == len(spec.shape) and all(
        n in (None, m) for n, m in zip(spec.shape[1:], array.shape[1:], strict=True)
    )
    if not same or array.dtype.kind not in "fiub":
        wanted = "[" + ", ".join("rows" if n is None else str(n) for n in spec.shape) + "]"
        raise UsageError(
            f"--golden: {spec.name!r} is {array.dtype} {list(array.shape)}, and {spec.dtype} {wanted} is wanted",
            where=str(path),
        )
    return np.ascontiguousarray(array.astype(spec.dtype))


def _rows(path: Path, signature: PolicySignature, given: Mapping[str, np.ndarray]) -> int:
    free = {s.name for s in (*signature.inputs, *signature.outputs) if s.shape and s.shape[0] is None}
    counts = {name: len(array) for name, array in given.items() if name in free}
    if not counts or min(counts.values()) != max(counts.values()) or not min(counts.values()):
        said = ", ".join(f"{name} {count}" for name, count in counts.items()) or "none"
        raise UsageError(
            "--golden: the arrays have not the same number of rows",
            where=str(path),
            why=f"rows: {said}",
            fix="give every array a row for each recorded step",
        )
    return min(counts.values())


def _part(spec: TensorSpec, array: np.ndarray, first: int, last: int) -> np.ndarray:
    return array[first:last] if spec.shape and spec.shape[0] is None else array
