"""How far each output of a policy varies over typical inputs: what a bound is a share of, or may be at most."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from export_model.exporter.verify.difference import SHARE, spread


class Spreads:
    """Spreads by output, each measured when it is first asked for; ``answers`` gives the typical ones of an output."""

    def __init__(self, answers: Callable[[str], Sequence[np.ndarray]]) -> None:
        self._answers = answers
        self._known: dict[str, np.ndarray | None] = {}

    def of(self, name: str) -> np.ndarray | None:
        """Return how far each column varies (``spread``)."""
        if name not in self._known:
            self._known[name] = spread(self._answers(name))
        return self._known[name]

    def share(self, name: str) -> np.ndarray | None:
        """Return what an output that hardly varies may be off, column by column: a share of how far it varies.

        Infinite for a column that is always the same.
        """
        found = self.of(name)
        return None if found is None else SHARE * found

    def ceiling(self, name: str, reference: np.ndarray) -> np.ndarray | float:
        """Return what rounding may explain at most: how far the output varies; of far numbers, a thousandth of each."""
        found = self.of(name)
        if reference.dtype.kind != "f" or found is None or not np.isfinite(found).any():
            return np.inf
        sizes = np.abs(np.nan_to_num(reference, posinf=0, neginf=0))
        return np.asarray(np.maximum(found[np.isfinite(found)].max(), SHARE * sizes))
