"""Integers that an input takes: ids of a table's rows, column by column.

As in policy.json: ``{"kind": "integer", "low": 0, "high": 9}``; a list of each where columns have tables of their own;
None where a number may be any, as nothing looks it up; with ``"clipped": true`` higher ones are taken as the highest.
Without such an entry nothing is known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from export_model.signatures.errors import UsageError

if TYPE_CHECKING:
    from export_model.signatures.spec import TensorSpec


def id_bounds(spec: TensorSpec) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the lowest and the highest id of each number of a row, infinite where any goes; None: nothing is known."""
    known = spec.distribution or {}
    if known.get("kind") != "integer":
        return None
    low, high = (
        np.array([edge if n is None else n for n in (value if isinstance(value, list) else [value])], np.float64)
        for value, edge in ((known["low"], -np.inf), (known["high"], np.inf))
    )
    return low, high


def is_clipped(spec: TensorSpec) -> bool:
    """Whether the policy takes ids beyond the highest as the highest."""
    return bool((spec.distribution or {}).get("clipped"))


def check_ids(spec: TensorSpec, values: np.ndarray) -> None:
    """Raise UsageError unless all of ``values`` [B, …] that are looked up in a table are ids of it."""
    bounds = id_bounds(spec)
    if bounds is None or not values.size:
        return
    low, high = (np.broadcast_to(b, values.shape) for b in bounds)
    wide = values.astype(np.float64)
    within = (wide >= low) & ((wide <= high) | is_clipped(spec))
    wrong = ~(within & ((wide == np.rint(wide)) | np.isinf(high)))
    if wrong.any():
        place = tuple(int(i) for i in np.unravel_index(int(wrong.argmax()), wide.shape))
        raise UsageError(
            f"{spec.name!r} holds {wide[place]:g} at {list(place)}",
            why=f"the policy looks it up; it must be an integer from {low[place]:.0f} to {high[place]:.0f}",
        )


def bounds_text(spec: TensorSpec) -> str:
    """Return what the integers of ``spec`` are, for people: ``an integer from 0 to 9``."""
    bounds = id_bounds(spec)
    assert bounds is not None
    low, high = bounds
    if not np.isfinite(high).any():
        return "integers, of any size"
    if len(high) == 1:
        return f"an integer from {low[0]:.0f} to {high[0]:.0f}{', or beyond' if is_clipped(spec) else ''}"
    shown = [f"{a:.0f} to {b:.0f}" if np.isfinite(b) else "any" for a, b in zip(low[:8], high[:8], strict=True)]
    return f"integers, column by column: {', '.join(shown)}{', …' if len(high) > 8 else ''}"
