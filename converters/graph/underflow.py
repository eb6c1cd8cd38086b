"""What rests on a number that float32, or a runtime's approximation of a function, cannot tell from zero.

``log(sigmoid(x))`` of -30 is -30, and -∞ where a runtime's sigmoid is zero (onnxruntime: from -17 on); of -1e3 it is
-∞, -97 or -87. An answer lies between what comes of the two ends of such a number, and what float64 makes of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.approximations import RANGES, TINY
from export_model.converters.graph.ops.base import OpDef


class End(Jitter):
    """A run at one end of what a number may be that is not told from zero: zero, or as large as it may be."""

    def __init__(self, arithmetic: str, *, kept: bool) -> None:
        super().__init__(0, arithmetic)
        self._kept = kept

    def operands(self, entry: OpDef, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
        """What an op reads, as it is."""
        return list(operands)

    def results(
        self, entry: OpDef, node: Node, operands: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> Sequence[np.ndarray]:
        """What an op gives, at this run's end."""
        return [self._settle(entry, r) if r.dtype == np.float32 else r for r in results]

    def _settle(self, entry: OpDef, array: np.ndarray) -> np.ndarray:
        """An op's result with what is not told from zero at this run's end.

        A zero is one of these where the function has none (exp, sigmoid, softmax).
        """
        positive = entry.name in RANGES and RANGES[entry.name][0] == 0
        _, absolute = self._approximations.get(entry.name, (0, 0)) if positive else (0, 0)
        end = np.float32(max(absolute, TINY))
        lost = np.abs(array) < end
        if not positive:
            lost &= array != 0
        return np.where(lost, np.copysign(end if self._kept else np.float32(0), array), array) if lost.any() else array


class Whole(Jitter):
    """A run in float64, which is moved by nothing."""

    def operands(self, entry: OpDef, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
        """What an op reads, with more digits than it has."""
        return [a.astype(np.float64) if a.dtype == np.float32 else a for a in operands]

    def results(
        self, entry: OpDef, node: Node, operands: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> Sequence[np.ndarray]:
        """What an op gives, as it is."""
        return results
