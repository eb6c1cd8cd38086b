"""Monte Carlo arithmetic: what an op computes, moved at random as far as rounding may move it.

Runtimes approximate some functions, each in its own way. How far they are from the function was measured
(``tests/runtimes/test_approximations.py``), over arguments from 1e-6 to 30; a formula like exp(x) - 1 is as far off at
its zero as anywhere, which no number of units in the last place of its result says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias

import numpy as np

from converters.graph.nodes import Node
from converters.graph.ops.base import OpDef
from converters.graph.shapes import run_kernel

Arithmetic: TypeAlias = Literal["processor", "graphics"]

#: Op → (units in the last place of the result, absolute): the farther of both counts. The worst of TensorFlow 1.4, 1.7
#: and 2.21 (Eigen), onnxruntime 1.31 and its wasm build 1.30 (MLAS), TensorFlow.js 4.22's cpu and wasm (XNNPACK).
_PROCESSOR: Mapping[str, tuple[float, float]] = {
    "Cos": (2, 3.2e-7),
    "Elu": (1, 7e-8),
    "Erf": (5, 1.7e-7),
    "Exp": (2, 0),
    "Expm1": (4, 9e-8),
    "Log": (3, 0),
    "Log1p": (3, 1.1e-7),
    "LogSoftmax": (3, 1.3e-7),
    "Rsqrt": (3, 0),
    "Selu": (2, 1.3e-7),
    "Sigmoid": (6, 1.7e-7),
    "Sin": (5, 2.5e-7),
    "Softmax": (36, 0),
    "Softplus": (7, 1.1e-7),
    "Sqrt": (4, 0),
    "Tanh": (6, 0),
}
#: TensorFlow.js' WebGL, where it is worse: shaders, and here Chromium's software renderer.
_GRAPHICS = {
    "Cos": (2, 2e-4),
    "Elu": (4, 1.8e-7),
    "Erf": (6, 5.8e-7),
    "Exp": (28, 0),
    "Expm1": (28, 2.2e-7),
    "Log": (4, 1.2e-7),
    "Log1p": (4, 1.8e-7),
    "LogSoftmax": (3, 2.4e-7),
    "Selu": (4, 3.2e-7),
    "Sin": (5, 2e-4),
    "Softmax": (64, 0),
    "Softplus": (7, 1.1e-7),
    "Tanh": (6, 1.4e-7),
}
APPROXIMATIONS: Mapping[Arithmetic, Mapping[str, tuple[float, float]]] = {
    "processor": _PROCESSOR,
    "graphics": {**_PROCESSOR, **_GRAPHICS},
}
#: Of functions that were not measured.
_ELSE = (4.0, 0.0)


class Jitter:
    """One run's chance. ``arithmetic`` says whose approximations are moved by; raises ValueError where it is none."""

    def __init__(self, seed: int | Sequence[int], arithmetic: str = "processor") -> None:
        known = {str(name): table for name, table in APPROXIMATIONS.items()}
        if arithmetic not in known:
            raise ValueError(f"the arithmetic {arithmetic!r} is none of {', '.join(known)}")
        self._random = np.random.default_rng(seed)
        self._approximations = known[arithmetic]

    def operands(self, entry: OpDef, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
        """What an op reads: every term of a sum of products moved by one unit in its last place."""
        return [self._moved(a) for a in operands] if entry.precision == "summed" else list(operands)

    def results(
        self, entry: OpDef, node: Node, operands: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> Sequence[np.ndarray]:
        """What an op gives, moved: sums by their partial sums, approximations by what was measured, the rest by 1."""
        if entry.exact:
            return results
        if entry.precision == "summed":
            results = self._added_up(entry, node, operands, results)
        known = self._approximations.get(entry.name, _ELSE if entry.precision == "approximate" else (1.0, 0.0))
        return [self._moved(r, *known) for r in results]

    def _signs(self, shape: tuple[int, ...]) -> np.ndarray:
        return np.where(self._random.random(shape) < 0.5, -1, 1)

    def _moved(self, array: np.ndarray, ulps: float = 1, absolute: float = 0) -> np.ndarray:
        """Every float moved up or down; zeros stay."""
        if array.dtype.kind != "f":
            return array
        with np.errstate(all="ignore"):
            step = np.where(np.isfinite(array), np.maximum(np.spacing(np.abs(array)) * ulps, absolute), 0)
            moved = array + self._signs(array.shape) * step
        return np.asarray(np.where(array == 0, array, moved)).astype(array.dtype)

    def _added_up(
        self, entry: OpDef, node: Node, operands: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> Sequence[np.ndarray]:
        """Sums of products moved by what rounding every partial sum makes, where they are added one after the other.

        Partial sums of n terms walk: on average their square is half of ‖terms‖², and each is rounded by about a
        quarter of a unit, so the total is about ε/4·√n·‖terms‖. The kernel itself, run on squares, gives ‖terms‖².
        """
        if any(r.dtype.kind != "f" for r in results):
            return results
        if not entry.layer:
            terms = operands[0].size / max(1, results[0].size)
        else:  # the second operand is the kernel: its last axis is the result's (a transposed one has as many elements)
            terms = operands[1].size / max(1, results[0].shape[-1])
        with np.errstate(all="ignore"):
            squares = run_kernel(entry, node, [np.square(a) if a.dtype.kind == "f" else a for a in operands])
            moved = []
            for result, square in zip(results, squares, strict=True):
                step = np.finfo(result.dtype).eps / 4 * np.sqrt(terms * np.maximum(square, 0))
                signs = self._signs(result.shape)
                moved.append(np.where(np.isfinite(step), result + signs * step, result).astype(result.dtype))
        return moved
