"""Scales and offsets of a logged column that no table has, fitted so that the policy answers what was logged.

Levenberg-Marquardt in two unknowns for each column, all columns at once: the policy is run for the steps of a sample
with the column as it is, a little scaled and a little moved.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from export_model.exporter.logs.causes import Cause, InputChange, column_name, on, scale_column, vectors
from export_model.exporter.logs.recording import Array, Recording
from export_model.exporter.logs.trials import Chain, Trials
from export_model.signatures.spec import PolicySignature

TURNS = 14
#: Where the search starts: as it is, and turned round.
STARTS = ((1.0, 0.0), (-1.0, 0.0), (4.0, 0.0), (0.25, 0.0))
#: Columns that are fitted; a policy that sees more is most likely wrong in one of the first, or in all.
MOST_COLUMNS = 256
#: A step of the derivative, of the column's own spread.
STEP = 1e-3
#: What is scanned: multiples of a column, and of its spread.
SCANNED_SCALES = tuple(float(sign * 1.2**n) for sign in (1, -1) for n in range(-16, 17) if (sign, n) != (1, 0))
SCANNED_OFFSETS = tuple(float(sign * 0.1 * 1.3**n) for sign in (1, -1) for n in range(16))
#: Mean cost of a fit that may be right: the logarithm of 1 + a share of what is allowed.
FITS = 1.5


class _Column(Struct, frozen=True):
    name: str
    number: int | None  # None: all of them
    where: str
    spread: float


def fitted_causes(few: Trials, chain: Chain) -> list[Cause]:
    """Causes that explain the steps of ``few`` by a scale and an offset of one column, or of one observation."""
    numbers = [t for t in few.targets if not t.branches]
    columns = _columns(few.replay.signature, few.recording)
    if not numbers or not columns:
        return []
    best: dict[_Column, tuple[float, Array]] = {}
    for start in STARTS:
        unknowns = np.tile(np.asarray(start), (len(columns), 1))
        damping = np.full(len(columns), 1e-2)
        residuals = _residuals(few, chain, columns, unknowns)
        for _ in range(TURNS):
            unknowns, damping, residuals = _turn(few, chain, columns, unknowns, damping, residuals)
        for column, unknown, residual in zip(columns, unknowns, residuals, strict=True):
            cost = float(np.log1p(np.abs(residual)).mean())
            if column not in best or cost < best[column][0]:
                best[column] = (cost, unknown)
    return [
        _cause(column, float(unknown[0]), float(unknown[1])) for column, (cost, unknown) in best.items() if cost < FITS
    ]


def scanned_causes(signature: PolicySignature, recording: Recording) -> list[Cause]:
    """Scales and offsets at steps of a fifth: where actions were drawn, odds tell no more of a figure than that."""
    found = []
    for column in _columns(signature, recording):
        found += [_cause(column, scale, 0.0, "about ") for scale in SCANNED_SCALES]
        found += [_cause(column, 1.0, offset * column.spread, "about ") for offset in SCANNED_OFFSETS]
    return found


def _columns(signature: PolicySignature, recording: Recording) -> list[_Column]:
    found = []
    for spec, logged in vectors(signature, recording):
        spread = np.maximum(logged.std(axis=0), 1e-3 * np.maximum(np.abs(logged).max(axis=0), 1e-3))
        if logged.shape[1] > 1:
            found.append(_Column(spec.name, None, spec.name, float(spread.mean())))
        found += [
            _Column(spec.name, number, column_name(signature, spec.name, number), float(spread[number]))
            for number in range(min(logged.shape[1], MOST_COLUMNS))
        ]
    return found


def _cause(column: _Column, scale: float, offset: float, about: str = "") -> Cause:
    # What the fit cannot tell from 1 and 0 is not said.
    scale = 1.0 if abs(scale - 1) < 1e-4 else scale
    offset = 0.0 if abs(offset) < 1e-4 * max(column.spread, 1e-3) else offset
    parts = [f"{about}{scale:.4g} × what was logged" if scale != 1 else "what was logged"]
    parts += [f"{'+' if offset > 0 else '−'} {about}{abs(offset):.4g}"] if offset else []
    kind = "scale" if scale != 1 else "offset"
    return Cause(
        kind,
        column.where,
        f"the policy was given {' '.join(parts)}: the {kind} was forgotten",
        _change(column, scale, offset),
    )


def _residuals(few: Trials, chain: Chain, columns: Sequence[_Column], unknowns: Array) -> Array:
    """By column: how far each logged number is from the answer, in units of what is allowed: [columns, numbers]."""
    changes = [_change(c, *map(float, u)) for c, u in zip(columns, unknowns, strict=True)]
    chains = [(*chain, Cause("scale", c.where, "", change)) for c, change in zip(columns, changes, strict=True)]
    found = []
    for verdict in few.verdicts(chains):
        parts = []
        for target in few.targets:
            if not target.branches:
                logged = few.recording.outputs[target.name].astype(np.float64).reshape(few.recording.steps, -1)
                answer = verdict.answers[target.answer].astype(np.float64).reshape(few.recording.steps, -1)
                parts.append((answer - logged).reshape(-1) / few.tolerance.atol)
        found.append(np.nan_to_num(np.concatenate(parts), nan=1e9, posinf=1e9, neginf=-1e9))
    return np.stack(found)


def _change(column: _Column, scale: float, offset: float) -> InputChange:
    if column.number is None:
        return on(column.name, lambda a: a * a.dtype.type(scale) + a.dtype.type(offset))
    return scale_column(column.name, column.number, scale, offset)


def _turn(
    few: Trials, chain: Chain, columns: Sequence[_Column], unknowns: Array, damping: Array, residuals: Array
) -> tuple[Array, Array, Array]:
    """One step of Levenberg-Marquardt for every column; a step that makes it worse is not taken."""
    spread = np.asarray([c.spread for c in columns])
    steps = np.stack([np.full(len(columns), STEP), STEP * spread], axis=1)
    slopes = []
    for unknown in range(2):
        moved = unknowns.copy()
        moved[:, unknown] += steps[:, unknown]
        slopes.append((_residuals(few, chain, columns, moved) - residuals) / STEP)
    jacobian = np.stack(slopes, axis=2)  # [columns, numbers, 2], in units of (1, the column's spread)
    normal = np.einsum("cni,cnj->cij", jacobian, jacobian)
    right = np.einsum("cni,cn->ci", jacobian, residuals)
    trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    solved = np.linalg.solve(normal + (damping[:, None, None] * trace + 1e-12) * np.eye(2), right[:, :, None])[:, :, 0]
    tried = unknowns - solved * np.stack([np.ones(len(columns)), spread], axis=1)
    after = _residuals(few, chain, columns, tried)
    better = (after**2).sum(axis=1) < (residuals**2).sum(axis=1)
    damping = np.where(better, damping * 0.2, damping * 8).clip(1e-9, 1e6)
    return np.where(better[:, None], tried, unknowns), damping, np.where(better[:, None], after, residuals)
