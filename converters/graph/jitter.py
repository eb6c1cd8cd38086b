"""Monte Carlo arithmetic: what an op computes, moved at random as far as rounding may move it.

Runtimes approximate some functions, each in its own way: ``ops/approximations.py`` says how far.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from export_model.converters.graph.nodes import Node
from export_model.converters.graph.ops.approximations import APPROXIMATIONS, RANGES
from export_model.converters.graph.ops.base import OpDef, axes_within
from export_model.converters.graph.ops.linear import matmul
from export_model.converters.graph.shapes import run_kernel

#: Of functions that were not measured.
_ELSE = (4.0, 0.0)
#: Operands of more elements are not moved one by one, which a policy of some megabytes takes seconds for.
_MOST_DRAWN = 1 << 22
#: Elements that are moved at once, which fit into caches.
_AT_ONCE = 1 << 16
#: Mean square of one unit in the last place, in ε² of the number it is of: mantissas spread as logarithms do.
_UNIT = 0.75 / (2 * math.log(2))

#: How many parts of a sum are added side by side: one, four or eight, by where the axes lie. What these give for equal
#: numbers are onnxruntime 1.31's and TensorFlow 2.21's answers, but for a unit or two in the last place.
_LANES = (1, 4, 8)

#: Arithmetic of two that every runtime computes alike where float32 holds the very result. A quotient is not: shaders
#: multiply by a reciprocal.
_EXACT_AT_TIMES = frozenset(("factor", "summand", "subtrahend"))

#: The exponent of a float32, where its bits are, whose last place is the smallest number that has all digits.
_FEW_DIGITS = np.uint32(23 << 23)


class Jitter:
    """One run's chance. ``arithmetic`` says whose approximations are moved by; raises ValueError where it is none."""

    def __init__(self, seed: int | Sequence[int], arithmetic: str = "processor") -> None:
        known = {str(name): table for name, table in APPROXIMATIONS.items()}
        if arithmetic not in known:
            raise ValueError(f"the arithmetic {arithmetic!r} is none of {', '.join(known)}")
        self._random = np.random.default_rng(seed)
        self._approximations = known[arithmetic]

    def operands(self, entry: OpDef, operands: Sequence[np.ndarray]) -> list[np.ndarray]:
        """What an op reads: every term of a sum of products, moved by one unit in its last place.

        Terms of a plain sum are no products; large operands stay: ``_added_up`` knows what comes of moving them.
        """
        if entry.precision != "summed" or not entry.layer:
            return list(operands)
        return [self._perturb(a) if a.size <= _MOST_DRAWN else a for a in operands]

    def results(
        self, entry: OpDef, node: Node, operands: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> Sequence[np.ndarray]:
        """What an op gives, moved: sums by their partial sums, approximations by what was measured, the rest by 1."""
        if entry.exact:
            return results
        if entry.precision == "summed":
            results = self._added_up(entry, node, operands, results)
        known = self._approximations.get(entry.name, _ELSE if entry.precision == "approximate" else (1.0, 0.0))
        moved = [self._perturb(r, *known) for r in results]
        if entry.operand in _EXACT_AT_TIMES:
            moved = [_keep_exact(entry, node, operands, r, m) for r, m in zip(results, moved, strict=True)]
        return [r.clip(*RANGES[entry.name]) for r in moved] if entry.name in RANGES else moved

    def _signs(self, shape: tuple[int, ...]) -> np.ndarray:
        return np.where(self._random.random(shape) < 0.5, -1, 1)

    def _perturb(self, array: np.ndarray, ulps: float = 1, absolute: float = 0) -> np.ndarray:
        """Every float moved up or down; zeros stay."""
        if array.dtype.kind != "f":
            return array

        def move(some: np.ndarray) -> np.ndarray:
            signs = np.asarray(self._random.random(some.shape) - 0.5, some.dtype)
            step = _spacing(some)
            if ulps != 1:
                step = step * ulps
            if absolute:
                step = np.maximum(step, absolute)
            moved = np.asarray(some + np.copysign(step, signs))
            np.copyto(moved, some, where=(some == 0) | ~np.isfinite(some))
            return moved

        with np.errstate(all="ignore"):
            return _piecewise(move, array)

    def _added_up(
        self, entry: OpDef, node: Node, operands: Sequence[np.ndarray], results: Sequence[np.ndarray]
    ) -> Sequence[np.ndarray]:
        """Sums of products moved by what rounding every partial sum makes, where they are added one after the other.

        Plain sums may have equal terms, whose roundings are not by chance: ``_in_other_order``.

        Partial sums of n terms walk: on average their square is half of ‖terms‖², and each is rounded by about a
        quarter of a unit, so the total is about ε/4·√n·‖terms‖. The kernel itself, run on squares, gives ‖terms‖².
        An operand that was not moved would have moved each term by about a unit of its own.
        """
        if any(r.dtype.kind != "f" for r in results) or entry.layer == "pool":  # whose terms were moved as operands
            return results
        if not entry.layer:
            # of a mean the squares are a mean, too
            terms = 1.0 if entry.takes == "mean" else operands[0].size / max(1, results[0].size)
            results = [_in_other_order(entry, operands, r) for r in results]
        else:  # the second operand is the kernel: its last axis is the result's (a transposed one has as many elements)
            terms = operands[1].size / max(1, results[0].shape[-1])
        with np.errstate(all="ignore"):
            terms = terms / 16 + _UNIT * sum(a.size > _MOST_DRAWN for a in operands)
            if entry.kernel is matmul:
                squares: Sequence[np.ndarray] = [matmul(node, operands[0], operands[1], squared=True)]
            else:
                squares = run_kernel(entry, node, [np.square(a) if a.dtype.kind == "f" else a for a in operands])

            def move(result: np.ndarray, square: np.ndarray) -> np.ndarray:
                step = np.finfo(result.dtype).eps * np.sqrt(terms * np.maximum(square, 0))
                signs = self._signs(result.shape)
                return np.where(np.isfinite(step), result + signs * step, result).astype(result.dtype)

            return [_piecewise(move, *pair) for pair in zip(results, squares, strict=True)]


def _keep_exact(
    entry: OpDef, node: Node, operands: Sequence[np.ndarray], result: np.ndarray, moved: np.ndarray
) -> np.ndarray:
    """``moved`` with the elements of ``result`` that were not rounded as they are: ×±1, ×2ⁿ, ×0, sums of few digits.

    A mask's ``(1 - mask)·1e8`` would otherwise be 12 off where it is 0. Of float64 nothing here says which they are.
    """
    if result.dtype != np.float32 or not result.size or any(a.dtype != np.float32 for a in operands):
        return moved
    shape = result.shape or (1,)
    spread, exact, into = [np.broadcast_to(a, shape) for a in operands], result.reshape(shape), moved.reshape(shape)
    rows = max(1, _AT_ONCE * shape[0] // result.size)
    for first in range(0, shape[0], rows):
        part = slice(first, first + rows)
        (whole,) = run_kernel(entry, node, [a[part].astype(np.float64) for a in spread])
        np.copyto(into[part], exact[part], where=whole == exact[part])
    return into.reshape(result.shape)


def _in_other_order(entry: OpDef, operands: Sequence[np.ndarray], result: np.ndarray) -> np.ndarray:
    """A sum or a mean as runtimes add it, whichever of ``_LANES`` is farther off.

    Of equal terms every partial sum is rounded the same way: a mean of 7,056 equal numbers is up to 214 units in
    the last place off in TensorFlow 2.21 and onnxruntime 1.31, one of 56,448 over axes that are apart up to 6,300
    in the latter. Roundings at random would move them by a handful.
    """
    array, axes = operands[0], axes_within(np.atleast_1d(operands[1]), operands[0].ndim)
    if not array.size or array.dtype.kind != "f":
        return result
    moved = result
    with np.errstate(all="ignore"):
        for lanes in _LANES:
            total = _add_one_by_one(array, axes, lanes).reshape(result.shape)
            if entry.takes == "mean":
                total = total / array.dtype.type(array.size // total.size)
            moved = np.where(np.abs(total - result) > np.abs(moved - result), total, moved)
    return moved


def _add_one_by_one(array: np.ndarray, axes: Sequence[int], lanes: int) -> np.ndarray:
    """The sum over ``axes``: of so many parts side by side, each one term after the other, then of the parts."""
    others = [a for a in range(array.ndim) if a not in axes]
    terms = array.transpose(*axes, *others).reshape(-1, *(array.shape[a] for a in others))
    missing = np.zeros((-len(terms) % lanes, *terms.shape[1:]), array.dtype)
    parts = np.concatenate([terms, missing]).reshape(-1, lanes, *terms.shape[1:])
    return np.asarray(np.add.accumulate(np.add.accumulate(parts)[-1])[-1])


def _piecewise(move: Callable[..., np.ndarray], *arrays: np.ndarray) -> np.ndarray:
    """What ``move`` makes of arrays of one shape, element by element, in their order.

    Large ones are moved a piece at a time, so that what it takes on the way is never held for all of them. Chance comes
    in the order of the elements.
    """
    first = arrays[0]
    if first.size <= _AT_ONCE or not all(a.flags.c_contiguous and a.shape == first.shape for a in arrays):
        return move(*arrays)
    moved = np.empty(first.shape, first.dtype)
    flat, into = [a.reshape(-1) for a in arrays], moved.reshape(-1)
    for i in range(0, first.size, _AT_ONCE):
        into[i : i + _AT_ONCE] = move(*(a[i : i + _AT_ONCE] for a in flat))
    return moved


def _spacing(array: np.ndarray) -> np.ndarray:
    """One unit in the last place of each number; whatever there is of zeros and of what is not finite.

    Of float32 its exponent says it, in a third of the time that numpy takes.
    """
    if array.dtype == np.float32:
        exponents = array.view(np.uint32) & np.uint32(0xFF << 23)
        if not ((exponents <= _FEW_DIGITS) & (array != 0)).any():
            return np.asarray(exponents - _FEW_DIGITS).view(np.float32)
    return np.asarray(np.spacing(np.abs(array)))
