"""Inputs to try a policy on, drawn from the policy itself and seeded.

Around the statistics of its own normaliser where it has one, at the edges (zeros, the ±5 clip, 8 to 1e4, one number far
from the others, float32 denormals, every two inputs at opposite extremes, a memory far from zero), each action masked
alone and all but one, each id of a table, the patterns that observations have (one number alone, zeros and ones …),
images in 0..1, dim and bright, pixels at their ends, with structure (signatures/pictures.py), batches of 1 to 7, of 16,
10, 12, 32, 48 and 64, and an odd one above 512 (a smaller one of large images); of vectors alone, one of 4,096.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

import numpy as np
from msgspec import Struct

from export_model.signatures.ids import id_bounds, is_clipped
from export_model.signatures.masks import all_allowed, forbidden, one_allowed, random_masks
from export_model.signatures.pictures import structured_images
from export_model.signatures.roles import OBSERVATIONS, Role
from export_model.signatures.spec import PolicySignature, TensorSpec

BATCHES = (1, 2, 7)
#: Tried once; with images, which take long, the largest whose pixels are no more than these.
LARGE_BATCH = 521
#: Tried once with vectors alone, and in one runtime of each format.
HUGE_BATCH = 4096
LARGE_BATCHES_OF_IMAGES = (67, 33, 17, 9)
MAX_PIXELS = 1 << 21
#: Rows of each batch of ``draw_typical``.
_TYPICAL_BATCH = 259
#: Batches of images with structure, beside which vectors have the patterns of observations.
PATTERN_BATCHES_OF_IMAGES = (32, 64)
#: How far extremes are, in deviations, and what is beyond them, as it is: from … to …, each number drawn in between.
EXTREMES = ((5.0, 5.0), (2.5, 4.0), (5.5, 8.0))
FAR = ((8.0, 30.0), (30.0, 100.0), (100.0, 300.0), (300.0, 1e3), (1e3, 1e4))
#: The inputs that are far: float32 alone may make a difference there.
FAR_CASES = ("opposite extremes", "8 to 1e4", "one number far away", "masks, 8 to 1e4")
#: Its first two rows together forbid every action, but for the only one of a branch.
ONE_ALLOWED = "all but one action masked"
#: A row for each action that alone is forbidden, then some for two.
ONE_FORBIDDEN = "one or two actions masked"
#: Rows of the case in which every id of a table turns up where there are no more; beside images fewer.
EVERY_ID = "every id"
MOST_IDS, MOST_IDS_OF_IMAGES = 512, 64
#: What a free axis behind the batch is tried with (image sides, number of entities).
_FREE_AXIS = 8
#: The deviation of integers that nothing looks up.
_SPREAD_OF_INTEGERS = 3


class Case(Struct, frozen=True):
    """One set of inputs: its name in reports, the arrays by canonical name, and how many rows they have."""

    name: str
    feeds: dict[str, np.ndarray]
    batch: int
    #: What an environment may give at every step: typical observations, whatever the masks, ids and images are.
    ordinary: bool = True

    def flush_denormals(self) -> dict[str, np.ndarray] | None:
        """The feeds as a processor sees them that takes denormals for zero, None where there are none."""
        tiny = np.finfo(np.float32).tiny
        denormal = {n: (a != 0) & (np.abs(a) < tiny) for n, a in self.feeds.items() if a.dtype == np.float32}
        if not any(d.any() for d in denormal.values()):
            return None
        return {n: np.where(denormal[n], 0, a).astype(a.dtype) if n in denormal else a for n, a in self.feeds.items()}


#: How far noise goes in the cases that are not typical: a draw of N(0, 1) hardly ever does.
_FAR_NOISE = 6.0

#: Quoted: naming the generator's class would load numpy.random, which an export that verifies nothing does not need.
Style: TypeAlias = "Callable[[np.random.Generator, TensorSpec, tuple[int, ...]], np.ndarray]"
#: Images from 0 to 1, whatever style the rest has.
Pixels: TypeAlias = "Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]"


def draw_cases(signature: PolicySignature, *, seed: int = 0, samples: int = 2) -> list[Case]:
    """The cases for one policy; the same seed gives the same ones on every machine (PCG64)."""
    rng = np.random.default_rng(seed)
    cases = [
        _case(signature, rng, f"typical, batch {batch}, #{i}", batch, _typical)
        for batch in BATCHES
        for i in range(samples)
    ]
    cameras = any(s.role is Role.VISUAL for s in signature.inputs)
    edges = (("zeros", 2, _zeros), ("clip edges", 10, _clip_edges), ("beyond the clip", 12, _beyond))
    for name, batch, style in (*edges, ("1e3", 2, _large), ("denormals", 2, _denormals)):
        cases.append(_case(signature, rng, name, 2 if cameras else batch, style))
    free = any(_is_free(s) for s in signature.inputs)
    if any(s.role is Role.MASKS for s in signature.inputs):
        cases.append(_case(signature, rng, ONE_ALLOWED, 7, _typical, masks=one_allowed))
        cases.append(_case(signature, rng, "random masks", 7, _typical, masks=random_masks))
        if free:
            far = _far(signature, few=True)
            cases.append(_case(signature, rng, "masks, 8 to 1e4", 2 * len(FAR), far, masks=random_masks))
        without = 1 - forbidden(signature, rng)
        if len(without):
            given = _case(signature, rng, ONE_FORBIDDEN, len(without), _typical, masks=lambda *_: without)
            cases.append(given)
    if (ids := _ids(signature)) > 1:
        cases.append(_case(signature, rng, EVERY_ID, ids, _each_id))
    if cameras:
        return [*cases, *_beside_images(signature, rng)]
    large = _large_batch(signature)
    cases.append(_case(signature, rng, f"typical, batch {large}", large, _typical))
    if free:
        pattern = len(_opposite_signs(signature))
        cases.append(_case(signature, rng, "opposite extremes", pattern * len(EXTREMES), _opposite(signature)))
        cases.append(_case(signature, rng, "8 to 1e4", 2 * pattern * len(FAR), _far(signature)))
        cases.append(_case(signature, rng, "one number far away", _FEW_FAR, _one_far))
    cases += [_case(signature, rng, name, batch, style) for name, batch, style in _PATTERNS]
    if all(len(s.shape) == 2 for s in signature.observations):
        cases.append(_case(signature, rng, f"typical, batch {HUGE_BATCH}", HUGE_BATCH, _typical))
    return cases


def _beside_images(signature: PolicySignature, rng: np.random.Generator) -> Iterator[Case]:
    """What a policy that sees images is tried with, and beside them the edges of what else it sees."""
    large, pixels = _large_batch(signature), _pixels(signature)
    yield _case(signature, rng, "pixels at their ends", 3, _typical, pixels=_ends)
    yield _case(signature, rng, f"typical, batch {large}", large, _typical, pixels=_dim_and_bright)
    if any(_is_free(s) for s in signature.inputs):
        most = max(2, MAX_PIXELS // max(1, pixels))
        pattern = min(most, len(_opposite_signs(signature)))
        yield _case(signature, rng, "opposite extremes", pattern, _opposite(signature, EXTREMES[:1]))
        yield _case(signature, rng, "8 to 1e4", len(FAR), _far(signature, few=True))
        yield _case(signature, rng, "one number far away", min(most, _FEW_FAR_BESIDE_IMAGES), _one_far)
    for batch in (n for n in PATTERN_BATCHES_OF_IMAGES if n * pixels <= MAX_PIXELS) if pixels else ():
        name = f"images with structure, batch {batch}"
        yield _case(signature, rng, name, batch, _every_pattern, pixels=_image_sampler(batch))


def draw_typical(signature: PolicySignature, *, seed: int, count: int) -> list[Case]:
    """``count`` large batches of what is typical: rows enough for shares and spreads."""
    rng = np.random.default_rng((seed, 2))
    batch = min(_TYPICAL_BATCH, _large_batch(signature))
    return [_case(signature, rng, f"typical, batch {batch}, #{i}", batch, _typical) for i in range(count)]


def draw_rollout(signature: PolicySignature, *, seed: int, steps: int, batch: int = 2) -> list[dict[str, np.ndarray]]:
    """Feeds for ``steps`` steps in a row; the memory in the first is zero, as at the start of an episode."""
    rng = np.random.default_rng((seed, 1))
    feeds = [_case(signature, rng, "", batch, _typical).feeds for _ in range(steps)]
    if signature.memory is not None:
        for name in (signature.memory.input, *(taken for taken, _ in signature.memory.others)):
            if name is not None:
                feeds[0][name] = np.zeros_like(feeds[0][name])
    return feeds


def _case(
    signature: PolicySignature,
    rng: np.random.Generator,
    name: str,
    batch: int,
    style: Style,
    masks: Callable[[np.random.Generator, int, Sequence[int]], np.ndarray] | None = None,
    pixels: Pixels | None = None,
) -> Case:
    feeds = {}
    for spec in signature.inputs:
        shape = tuple((batch if i == 0 else _FREE_AXIS) if n is None else n for i, n in enumerate(spec.shape))
        if spec.role is Role.MASKS:
            branches = signature.branches if sum(signature.branches) == shape[-1] else (shape[-1],)
            feeds[spec.name] = (masks or all_allowed)(rng, batch, branches).astype(spec.dtype)
        else:
            feeds[spec.name] = np.asarray(_other(signature, rng, spec, shape, style, pixels), dtype=spec.dtype)
    return Case(name, feeds, batch, style in (_typical, _each_id))


def _other(
    signature: PolicySignature,
    rng: np.random.Generator,
    spec: TensorSpec,
    shape: tuple[int, ...],
    style: Style,
    pixels: Pixels | None,
) -> np.ndarray:
    if spec.role is Role.PREV_ACTION:
        sizes = signature.branches or (2,)
        if len(shape) == 1:
            return rng.integers(0, sizes[0], shape)
        return np.stack([rng.integers(0, sizes[min(i, len(sizes) - 1)], shape[0]) for i in range(shape[1])], axis=1)
    if spec.role is Role.VISUAL:
        drawn = rng.random(shape) if pixels is None else pixels(rng, shape)
        return drawn * float((spec.distribution or {}).get("high", 1.0))
    if spec.role is Role.NOISE:
        return rng.standard_normal(shape) if style is _typical else rng.uniform(-_FAR_NOISE, _FAR_NOISE, shape)
    if spec.role is Role.MEMORY_IN:
        return rng.standard_normal(shape) * _MEMORIES.get(style, 0.5)
    if (bounds := id_bounds(spec)) is not None:
        return _integers(rng, spec, shape, bounds, style)
    if np.dtype(spec.dtype).kind in "iu":
        return rng.integers(0, 2, shape)
    if spec.role is Role.PARAMETER:
        return rng.random(shape) if style not in (_equal, _whole) else style(rng, spec, shape)
    return style(rng, spec, shape)


def _integers(
    rng: np.random.Generator,
    spec: TensorSpec,
    shape: tuple[int, ...],
    bounds: tuple[np.ndarray, np.ndarray],
    style: Style,
) -> np.ndarray:
    """Ids within their bounds, each of a table in turn if the style says so; what has none in the style of the case."""
    low, high = (np.broadcast_to(b, shape) for b in bounds)
    known = np.isfinite(high)
    first, count = np.where(known, low, 0).astype(np.int64), np.where(known, high - low + 1, 1).astype(np.int64)
    reach = count + count // 4 + 1 if is_clipped(spec) and style is not _each_id else count
    drawn = rng.integers(0, reach) if shape else rng.integers(0, int(reach))
    if style is _each_id and shape:
        turn = np.arange(shape[0]).reshape(-1, *(1,) * (len(shape) - 1))
        start = rng.integers(0, count[:1])  # the columns are not in step
        ends = np.where(turn == 0, 0, np.where(turn == 1, count - 1, drawn))
        drawn = np.where(count <= shape[0], (turn + start) % count, ends)
    free = np.zeros(shape) if known.all() else np.asarray(style(rng, spec, shape))
    if np.dtype(spec.dtype).kind in "iu":
        limits = np.iinfo(spec.dtype)
        free = np.clip(np.rint(_SPREAD_OF_INTEGERS * free if style is _typical else free), limits.min, limits.max)
    return np.where(known, first + drawn, free)


def _each_id(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    """What is no id is typical where each id is tried."""
    return _typical(rng, spec, shape)


def _ids(signature: PolicySignature) -> int:
    """Rows in which every id turns up, as far as there are not too many; 0 where there are no ids beyond 0 and 1."""
    bounds = [b for s in signature.inputs if s.role in OBSERVATIONS and (b := id_bounds(s)) is not None]
    spans = [float(np.max((high - low + 1)[np.isfinite(high)], initial=0)) for low, high in bounds]
    most = MOST_IDS_OF_IMAGES if any(s.role is Role.VISUAL for s in signature.inputs) else MOST_IDS
    return min(int(max(spans, default=0)), most) if max(spans, default=0) > 2 else 0


def _statistics(spec: TensorSpec) -> tuple[np.ndarray, np.ndarray]:
    known = spec.distribution or {}
    if "std" not in known:
        return np.zeros(1), np.ones(1)
    return np.asarray(known["mean"], np.float64), np.asarray(known["std"], np.float64)


def _typical(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    mean, std = _statistics(spec)
    return np.asarray(mean + std * rng.standard_normal(shape))


def _dim_and_bright(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Images that are dim, bright, flat: each has a range of its own within 0..1, but for the first third."""
    pixels = rng.random(shape)
    low, high = np.sort(rng.random((2, len(pixels), *(1,) * (pixels.ndim - 1))), axis=0)
    low[: len(pixels) // 3], high[: len(pixels) // 3] = 0, 1
    return np.asarray(low + (high - low) * pixels)


def _ends(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Images that are black, white, and both at random, in turn."""
    pixels = rng.integers(0, 2, shape).astype(np.float64)
    pixels[0::3], pixels[1::3] = 0, 1
    return pixels


def _image_sampler(batch: int) -> Pixels:
    def pixels(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        return structured_images(rng, shape, first=batch // 4)  # another batch begins with other ones

    return pixels


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


def _alone(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    rows, count = (shape[0] if shape else 1), _numbers((None, *shape[1:]))
    made = np.zeros((rows, count))
    if count:
        made[np.arange(rows), rng.integers(0, count, rows)] = 1
    return made.reshape(shape)


def _equal(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    rows = rng.uniform(-3.0, 3.0, (*shape[:1], *(1,) * (len(shape) - 1)))
    return np.asarray(np.broadcast_to(rows, shape))


def _unit(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    return rng.random(shape)


def _one_far(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    """Typical but for one number of each row: where all are far away, what saturates hides what is wrong."""
    made = _typical(rng, spec, shape).reshape(shape[0] if shape else 1, -1)
    if made.size:
        rows = np.arange(len(made))
        far = rng.choice([-1.0, 1.0], len(rows)) * _between(rng, FAR[0][0], FAR[3][1], rows.shape)
        made[rows, rng.permutation(np.resize(np.arange(made.shape[1]), len(rows)))] = far
    return made.reshape(shape)


def _between(rng: np.random.Generator, low: float, high: float, shape: tuple[int, ...]) -> np.ndarray:
    """Numbers of which each order of magnitude has as many."""
    return np.asarray(np.exp(rng.uniform(math.log(low), math.log(high), shape)))


def _whole(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    return rng.integers(-9, 10, shape).astype(np.float64)


#: What observations often look like though no statistics say so, each with another number of rows.
_PATTERNS: tuple[tuple[str, int, Style], ...] = (
    ("one number alone", 3, _alone),
    ("zeros and ones", 4, lambda rng, spec, shape: rng.integers(0, 2, shape).astype(np.float64)),
    ("all numbers equal", 5, _equal),
    ("near zero", 16, lambda rng, spec, shape: np.asarray(0.01 * rng.standard_normal(shape))),
    ("whole numbers", 32, _whole),
    ("from zero to one", 64, _unit),
)
#: Rows of which each has one number far away.
_FEW_FAR, _FEW_FAR_BESIDE_IMAGES = 48, 24


def _every_pattern(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    """Each row in the next pattern, or with one number far away; then typical ones."""
    styles = [style for _, _, style in _PATTERNS] + [_one_far, _typical]
    made = np.zeros(shape)
    for number, style in enumerate(styles):
        rows = len(made[number :: len(styles)])
        made[number :: len(styles)] = style(rng, spec, (rows, *shape[1:]))
    return made


#: A memory far from zero, in its standard deviations: what an LSTM's cell may reach, soon and after long.
_MEMORIES: dict[Style, float] = {_clip_edges: 5.0, _beyond: 5.0, _whole: 50.0}


def _denormals(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    """Below the smallest normal float32: runtimes may take them for zero."""
    return np.asarray(np.finfo(np.float32).tiny * rng.uniform(-1.0, 1.0, shape))


def unknown_ids(signature: PolicySignature) -> list[str]:
    """Return the inputs of integers of which only 0 and 1 are tried, as nothing says which go."""
    observed = (s for s in signature.inputs if s.role in OBSERVATIONS and s.role is not Role.VISUAL)
    return [s.name for s in observed if np.dtype(s.dtype).kind in "iu" and id_bounds(s) is None]


def _is_free(spec: TensorSpec) -> bool:
    """Whether a style draws the numbers of an input, some of an integer one's at least: those that are no ids."""
    decided = (Role.MASKS, Role.PREV_ACTION, Role.VISUAL, Role.NOISE, Role.MEMORY_IN, Role.PARAMETER)
    if spec.role in decided or np.dtype(spec.dtype).kind not in "iu":
        return spec.role not in decided
    bounds = id_bounds(spec)
    return bounds is not None and not np.isfinite(bounds[1]).all()


def _opposite_signs(signature: PolicySignature) -> np.ndarray:
    """Signs, [rows, numbers of all inputs]: every two numbers have both pairs of opposite signs in some row.

    Of two numbers, some bit of their places differs; a row for each bit and one for its complement, and one for each
    sign alone.
    """
    count = sum(_numbers(s.shape) for s in signature.inputs if _is_free(s))
    bits = np.arange(max(1, (count - 1).bit_length()))[:, None]
    signs = np.where(np.arange(count) >> bits & 1, 1.0, -1.0)
    return np.concatenate([signs, -signs, np.ones((1, count)), -np.ones((1, count))])


def _large_batch(signature: PolicySignature) -> int:
    pixels = _pixels(signature)
    if not pixels:
        return LARGE_BATCH
    fitting = (n for n in LARGE_BATCHES_OF_IMAGES if n * pixels <= MAX_PIXELS)
    return next(fitting, LARGE_BATCHES_OF_IMAGES[-1])


def _pixels(signature: PolicySignature) -> int:
    return sum(_numbers(s.shape) for s in signature.inputs if s.role is Role.VISUAL)


def _numbers(shape: Sequence[int | None]) -> int:
    return math.prod(_FREE_AXIS if n is None else n for n in shape[1:])


def _signs(signature: PolicySignature, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
    """The part of ``_opposite_signs`` that is ``spec``'s, repeated as often as ``shape`` has room for it."""
    before = [s for s in signature.inputs[: signature.inputs.index(spec)] if _is_free(s)]
    start = sum(_numbers(s.shape) for s in before)
    own = _opposite_signs(signature)[:, start : start + _numbers(spec.shape)]
    return own[np.arange(shape[0] if shape else 1) % len(own)].reshape(shape)


def _opposite(signature: PolicySignature, strata: Sequence[tuple[float, float]] = EXTREMES) -> Style:
    def style(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
        mean, std = _statistics(spec)
        return np.asarray(mean + std * _signs(signature, spec, shape) * _sizes(rng, strata, shape))

    return style


def _far(signature: PolicySignature, *, few: bool = False) -> Style:
    """The sizes of ``FAR`` with the signs of ``_opposite_signs``, or with ``few`` a row of each, signs drawn."""

    def style(rng: np.random.Generator, spec: TensorSpec, shape: tuple[int, ...]) -> np.ndarray:
        if few:
            return np.asarray(rng.choice([-1.0, 1.0], shape) * _sizes(rng, FAR, shape))
        sizes = _sizes(rng, FAR, shape)
        # Of each stratum the signs twice: each number of its own size, and all numbers of a row alike.
        same = np.arange(len(sizes)) // len(_opposite_signs(signature)) % 2 == 1
        if sizes.size:
            sizes[same] = sizes[same].reshape(int(same.sum()), -1)[:, :1].reshape(-1, *(1,) * (len(shape) - 1))
        return np.asarray(_signs(signature, spec, shape) * sizes)

    return style


def _sizes(rng: np.random.Generator, strata: Sequence[tuple[float, float]], shape: tuple[int, ...]) -> np.ndarray:
    """As many rows of one stratum as of the next, in their order."""
    rows = shape[0] if shape else 1
    which = np.arange(rows) * len(strata) // rows
    low, high = (np.asarray(strata)[which, i].reshape(-1, *(1,) * len(shape[1:])) for i in (0, 1))
    return np.asarray(low * (high / low) ** rng.random(shape or (1,))).reshape(shape)
