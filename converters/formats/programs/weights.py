"""The constants of a program as they are kept.

They are in float32 or, where they were rounded to that, in float16 or in int8 with the length of a step for each
channel; they stand in the source, or in one little-endian file that all languages load.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.compiler.passes.weights import Storage, compact
from export_model.converters.graph.ops.loops.base import Element, Expression, Tensor, apply, number
from export_model.converters.graph.program import Place, Program, elements, inline_scalars
from export_model.converters.graph.types import BOOL, FLOAT32, INT64
from export_model.signatures.code import WEIGHTS_FILE

#: dtypes of constants that stay in the source: each language holds them in its own way.
_IN_SOURCE = (BOOL, INT64)
_ALIGNED = 4


def weights_name(policy: str) -> str:
    """The file of a policy's weights, the same for every language."""
    return WEIGHTS_FILE.format(name=policy)


class Kept(Struct, frozen=True, eq=False):
    """A constant: ``narrow`` is it, or it in fewer bytes; ``step`` what that is multiplied by, one for each channel.

    ``axis`` is that of the channels. ``offsets`` are in the file, if it is there.
    """

    place: Place
    narrow: Place
    step: Place | None = None
    axis: int = 0
    offsets: tuple[int, ...] = ()

    @property
    def inner(self) -> int:
        """After how many elements the next channel begins."""
        assert self.narrow.value is not None
        return int(np.prod(self.narrow.value.shape[self.axis + 1 :], dtype=np.int64))


class ProgramWeights(Struct, frozen=True, eq=False):
    """All constants of a program, in its order, and the file (None: they are in the source)."""

    kept: tuple[Kept, ...]
    file: bytes | None = None
    by_place: Mapping[int, Kept] = field(default_factory=dict)

    @property
    def checksum(self) -> int:
        """The CRC-32 of the file."""
        return zlib.crc32(self.file or b"")


def weights_of(program: Program, storage: Storage, *, in_file: bool) -> ProgramWeights:
    """The constants of a program. Numbers stay the same: only what comes back from fewer bytes takes fewer."""
    made, content = list[Kept](), bytearray()
    given = {id(t.place) for t in program.outputs.values()}
    for place in program.constants:
        kept = _keep(place, "float32" if id(place) in given else storage)
        if in_file and place.dtype not in _IN_SOURCE:
            offsets = []
            for part in _parts(kept):
                assert part.value is not None
                content += bytes(-len(content) % _ALIGNED)
                offsets.append(len(content))
                content += part.value.astype(part.dtype.newbyteorder("<")).tobytes()
            kept = Kept(kept.place, kept.narrow, kept.step, kept.axis, tuple(offsets))
        made.append(kept)
    return ProgramWeights(tuple(made), bytes(content) if in_file else None, {id(k.place): k for k in made})


def _parts(kept: Kept) -> Iterator[Place]:
    yield kept.narrow
    if kept.step is not None:
        yield kept.step


def _keep(place: Place, storage: Storage) -> Kept:
    found = None if place.value is None or storage == "float32" else compact(place.value, storage)
    if found is None:
        return Kept(place, place)
    narrow, step = found
    small = Place("constant", place.name, narrow.dtype, narrow.size, narrow)
    if step is None:
        return Kept(place, small)
    axis = max(range(step.ndim), key=lambda i: step.shape[i])
    lengths = Place("constant", f"{place.name}_step", FLOAT32, step.size, step)
    return Kept(place, small, lengths, axis)


def _channel(kept: Kept, x: Element) -> Expression:
    """The channel that an element of a constant, or of a view of it, belongs to."""
    assert kept.narrow.value is not None and kept.step is not None
    if kept.step.size == 1:
        return number(0)
    if x.tensor.shape == kept.narrow.value.shape:
        return x.at[kept.axis]
    flat: Expression = number(0)
    for length, at in zip(x.tensor.shape, x.at, strict=True):
        flat = apply("add", apply("mul", flat, number(length)), at)
    flat = flat if kept.inner == 1 else apply("div", flat, number(kept.inner))
    return apply("mod", flat, number(kept.step.size))


def widen_where_used(program: Program, weights: ProgramWeights) -> Program:
    """Return a program that reads its constants as they are kept: a cast, and a step's length, at each element."""
    stages = []
    for stage in program.stages:
        swap: dict[int, Expression] = {}
        for one in elements(stage.body):
            kept = weights.by_place.get(id(one.tensor.place))
            if kept is None or kept.narrow is kept.place:
                continue
            small = Tensor(kept.narrow, kept.narrow.dtype, one.tensor.shape)
            wide = apply("cast", Element(small, one.at), dtype=FLOAT32)
            if kept.step is not None:
                length = Element(Tensor(kept.step, FLOAT32, (kept.step.size,)), (_channel(kept, one),))
                wide = apply("mul", wide, length)
            swap[id(one)] = wide
        stages.append(replace(stage, body=inline_scalars(stage.body, swap)) if swap else stage)
    return replace(program, stages=tuple(stages))
