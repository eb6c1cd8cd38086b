"""What is stated of an action, applied by the judge itself: what a graph that computes it (--bake) is held against."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from export_model.converters.interfaces.isaac_lab import RAW_ACTION
from export_model.signatures.interface import Range, Term
from export_model.signatures.spec import PolicySignature


def apply_stated(signature: PolicySignature, answers: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return answers with the limit of the raw action, then scale, offset and clip, applied to the continuous action.

    ``signature`` is that of the policy before the bake: what callers of its source are told to apply.
    """
    interface = signature.interface
    head = next((h for h in signature.heads if h.is_continuous), None)
    if interface is None or head is None:
        return dict(answers)
    limits = [q.clip for q in interface.limits if q.name == RAW_ACTION]
    made = dict(answers)
    for name in {head.name, head.name if head.plain is None else head.plain.name} & answers.keys():
        action = answers[name].astype(np.float64)
        if limits:
            action = _clip(action, limits[0])
        made[name] = _terms(action, interface.actions).astype(answers[name].dtype)
    return made


def _terms(action: np.ndarray, terms: tuple[Term, ...]) -> np.ndarray:
    """Apply terms that stand side by side along the last axis."""
    edges = np.cumsum([term.size or 0 for term in terms])[:-1]
    parts = np.split(action, edges, axis=-1) if len(terms) > 1 else [action] * len(terms)
    applied = [
        _clip(part * np.asarray(term.scale or 1.0) + np.asarray(term.offset or 0.0), term.clip)
        for part, term in zip(parts, terms, strict=True)
    ]
    return np.concatenate(applied, axis=-1) if applied else action


def _clip(values: np.ndarray, ranges: tuple[Range, ...]) -> np.ndarray:
    if not ranges:
        return values
    low, high = (np.array([np.nan if r[i] is None else r[i] for r in ranges]) for i in (0, 1))
    return np.where(values < low, low, np.where(values > high, high, values))  # nothing is below or above a NaN
