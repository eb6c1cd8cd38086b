"""Inputs to try a policy on, drawn from the policy itself and seeded.

Around the statistics of its own normaliser where it has one, at the edges (zeros, the ±5 clip, values of 1e3, float32
denormals, all but one action masked), images in 0..1, batches of 1, 2 and 7, and one of 64 where there are no images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from signatures.roles import Role
from signatures.spec import PolicySignature, TensorSpec

BATCHES = (1, 2, 7)
#: Tried once, and not with images, which take long.
LARGE_BATCH = 64
#: What a free axis behind the batch is tried with (image sides, number of entities).
_FREE_AXIS = 8


@dataclass(frozen=True, slots=True)
class Case:
    """One set of inputs: its name in reports, the arrays by canonical name, and how many rows they have."""

    name: str
    feeds: dict[str, np.ndarray]
    batch: int


#: Quoted: naming the generator's class would load numpy.random, which an export that verifies nothing does not need.
Style: TypeAlias = "Callable[[np.random.Generator, TensorSpec, tuple[int, ...]], np.ndarray]"


def draw_cases(signature: PolicySignature, *, seed: int = 0, samples: int = 2) -> list[Case]:
    """The cases for one policy; the same seed gives the same ones on every machine (PCG64)."""
    rng = np.random.default_rng(seed)
    cases = [
        _case(signature, rng, f"typical, batch {batch}, #{i}", batch, _typical)
        for batch in BATCHES
        for i in range(samples)
    ]
    edges = (("zeros", _zeros), ("clip edges", _clip_edges), ("beyond the clip", _beyond), ("1e3", _large))
    for name, style in (*edges, ("denormals", _denormals)):
        cases.append(_case(signature, rng, name, 2, style))
    if any(s.role is Role.MASKS for s in signature.inputs):
        cases.append(_case(signature, rng, "all but one action masked", 7, _typical, masks=_one_allowed))
        cases.append(_case(signature, rng, "random masks", 7, _typical, masks=_random_masks))
    if not any(s.role is Role.VISUAL for s in signature.inputs):
        cases.append(_case(signature, rng, f"typical, batch {LARGE_BATCH}", LARGE_BATCH, _typical))
    return cases


def draw_rollout(signature: PolicySignature, *, seed: int, steps: int, batch: int = 2) -> list[dict[str, np.ndarray]]:
    """Feeds for ``steps`` steps in a row; the memory in the first is zero, as at the start of an episode."""
    rng = np.random.default_rng((seed, 1))
    feeds = [_case(signature, rng, "", batch, _typical).feeds for _ in range(steps)]
    if signature.memory is not None and signature.memory.input is not None:
        name = signature.memory.input
        feeds[0][name] = np.zeros_like(feeds[0][name])
    return feeds


def _case(
    signature: PolicySignature,
    rng: np.random.Generator,
    name: str,
    batch: int,
    style: Style,
    masks: Callable[[np.random.Generator, int, Sequence[int]], np.ndarray] | None = None,
) -> Case:
    feeds = {}
    for spec in signature.inputs:
        shape = tuple((batch if i == 0 else _FREE_AXIS) if n is None else n for i, n in enumerate(spec.shape))
        if spec.role is Role.MASKS:
            branches = signature.branches if sum(signature.branches) == shape[-1] else (shape[-1],)
            feeds[spec.name] = (masks or _all_allowed)(rng, batch, branches).astype(spec.dtype)
        else:
            feeds[spec.name] = np.asarray(_other(signature, rng, spec, shape, style), dtype=spec.dtype)
    return Case(name, feeds, batch)


def _other(
    signature: PolicySignature, rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...], style: Style
) -> np.ndarray:
    if spec.role is Role.PREV_ACTION:
        sizes = signature.branches or (2,)
        if len(shape) == 1:
            return rng.integers(0, sizes[0], shape)
        return np.stack([rng.integers(0, sizes[min(i, len(sizes) - 1)], shape[0]) for i in range(shape[1])], axis=1)
    if spec.role is Role.VISUAL:
        return rng.random(shape) * float((spec.distribution or {}).get("high", 1.0))
    if spec.role is Role.NOISE:
        return rng.standard_normal(shape)
    if spec.role is Role.MEMORY_IN:
        return rng.standard_normal(shape) * 0.5
    if np.dtype(spec.dtype).kind in "iu":
        high = int((spec.distribution or {}).get("high", 1))
        return rng.integers(0, high + 1, shape)
    if spec.role is Role.PARAMETER:
        return rng.random(shape)
    return style(rng, spec, shape)


def _statistics(spec: TensorSpec) -> tuple[np.ndarray, np.ndarray]:
    known = spec.distribution or {}
    if "std" not in known:
        return np.zeros(1), np.ones(1)
    return np.asarray(known["mean"], np.float64), np.asarray(known["std"], np.float64)


def _typical(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    mean, std = _statistics(spec)
    return np.asarray(mean + std * rng.standard_normal(shape))


def _zeros(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    return np.zeros(shape)


def _clip_edges(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    mean, std = _statistics(spec)
    return np.asarray(mean + 5 * std * rng.choice([-1.0, 1.0], shape))


def _beyond(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    mean, std = _statistics(spec)
    return np.asarray(mean + 8 * std * rng.choice([-1.0, 1.0], shape))


def _large(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    return np.asarray(1e3 * rng.choice([-1.0, 1.0], shape))


def _denormals(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    """Below the smallest normal float32: runtimes may take them for zero."""
    return np.asarray(np.finfo(np.float32).tiny * rng.uniform(-1.0, 1.0, shape))


def _all_allowed(rng: np.random.Generator, batch: int, branches: Sequence[int]) -> np.ndarray:
    return np.ones((batch, sum(branches)))


def _one_allowed(rng: np.random.Generator, batch: int, branches: Sequence[int]) -> np.ndarray:
    parts = [np.eye(size)[rng.integers(0, size, batch)] for size in branches]
    return np.concatenate(parts, axis=1)


def _random_masks(rng: np.random.Generator, batch: int, branches: Sequence[int]) -> np.ndarray:
    drawn = (rng.random((batch, sum(branches))) < 0.5).astype(float)
    return np.asarray(np.maximum(drawn, _one_allowed(rng, batch, branches)))
