"""A policy's answers for the steps of a recording: all at once, or step after step where it has a memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

import numpy as np
from msgspec import Struct

from export_model.exporter.logs.recording import NONE, Array, Arrays
from export_model.signatures.batches import Run
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature

#: Elements of one input that are run at once.
CHUNK_ELEMENTS = 1 << 21
#: Steps of an episode that are run one after the other before others are run side by side with them.
SHORT = 256


class MemoryUse(StrEnum):
    """What an agent does with the memory that the policy gave it."""

    KEPT = "fed back, zero when an episode begins"
    NOT_RESET = "fed back, never reset"
    LATE = "fed back one step late"
    DROPPED = "always zero"


class Replay(Struct, frozen=True):
    """Runs a policy over rows. ``fetch`` are the outputs that are wanted."""

    run: Run
    signature: PolicySignature
    fetch: tuple[str, ...]

    def answers(self, inputs: Arrays, before: Array, last: Array, use: MemoryUse = MemoryUse.KEPT) -> dict[str, Array]:
        """The outputs, [rows, …].

        ``inputs`` that hold the memory are fed as they are; without, it is fed back as ``use`` says, along ``before``
        (or ``last``). A memory that the policy does not give back is zero, as at the start of an episode.
        """
        pair = self.signature.recurrence
        if pair is None:
            lost = [s for s in self.signature.inputs if s.role is Role.MEMORY_IN and s.name not in inputs]
            zeros = {s.name: np.zeros((len(before), *(n or 1 for n in s.shape[1:])), np.float32) for s in lost}
            return self._at_once({**inputs, **zeros}, self.fetch)
        if pair[0] in inputs:
            return self._at_once(inputs, self.fetch)
        return self._step_by_step(inputs, last if use is MemoryUse.NOT_RESET else before, use, *pair)

    def _at_once(self, inputs: Arrays, fetch: Sequence[str]) -> dict[str, Array]:
        batched = {s.name for s in self.signature.inputs if s.batched}
        rows = next(len(a) for n, a in inputs.items() if n in batched)
        widest = max(a[0].size if len(a) else 1 for n, a in inputs.items() if n in batched)
        size = max(1, CHUNK_ELEMENTS // max(widest, 1))
        parts = []
        for first in range(0, rows, size):
            feeds = {n: np.ascontiguousarray(a[first : first + size]) if n in batched else a for n, a in inputs.items()}
            parts.append(self.run(feeds, fetch))
        return {n: np.concatenate([p[n] for p in parts]) for n in fetch}

    def _step_by_step(self, inputs: Arrays, before: Array, use: MemoryUse, taken: str, given: str) -> dict[str, Array]:
        """Run stretches of an episode side by side, each from the memory that the one before left when it was last run.

        Those whose memory has changed since run again, until none has. Stretch n is right after n runs, so that no step
        is computed otherwise than one after the other; a memory that forgets is right after two or three.
        """
        spec = self.signature.input(taken)
        rows = len(before)
        memory = np.zeros((rows + 1, *(n or 1 for n in spec.shape[1:])), np.float32)  # the last row is what NONE finds
        if use is MemoryUse.DROPPED:
            return self._at_once({**inputs, taken: memory[:-1]}, self.fetch)
        source = np.where(before == NONE, NONE, before[before]) if use is MemoryUse.LATE else before
        step, stretch = _stretches(before)
        ends = np.flatnonzero((source != NONE) & (stretch[source] != stretch))
        fetch = tuple(dict.fromkeys([*self.fetch, given]))
        found: dict[str, Array] = {}
        again = np.arange(rows)
        while len(again):
            fed_at_ends = memory[source[ends]].view(np.uint32)  # NaN is equal to itself so
            for level in _levels(again, step):
                answer = self._at_once(
                    {**{n: a[level] for n, a in inputs.items()}, taken: memory[source[level]]}, fetch
                )
                memory[level] = answer[given]
                for name, array in answer.items():
                    if name not in found:
                        found[name] = np.zeros((rows, *array.shape[1:]), array.dtype)
                    found[name][level] = array
            differs = (memory[source[ends]].view(np.uint32) != fed_at_ends).any(axis=tuple(range(1, memory.ndim)))
            again = np.flatnonzero(np.isin(stretch, stretch[ends[differs]]))
        return found


def _stretches(before: Array) -> tuple[Array, Array]:
    """Of each row its step within a stretch of its episode, and the number of that stretch."""
    rows = len(before)
    depth, first = np.zeros(rows + 1, np.int64), np.arange(rows + 1)
    depth[NONE] = -1
    for row, at in enumerate(before.tolist()):
        depth[row] = depth[at] + 1
        if at != NONE:
            first[row] = first[at]
    depth, first = depth[:-1], first[:-1]
    length = max(SHORT, math.isqrt(int(depth.max(initial=0))))
    number = np.unique(np.stack([first, depth // length]), axis=1, return_inverse=True)[1]
    return depth % length, number.reshape(-1)


def _levels(rows: Array, step: Array) -> list[Array]:
    """Rows that can be run at once, in order: those of one step."""
    order = rows[np.argsort(step[rows], kind="stable")]
    return np.split(order, np.flatnonzero(np.diff(step[order])) + 1)


def complete(inputs: Arrays, outputs: Arrays, before: Array, signature: PolicySignature) -> dict[str, Array]:
    """``inputs`` with what an agent always has: no noise, nothing masked, the discrete action of the step before.

    The memory is left to the replay.
    """
    found = dict(inputs)
    rows = len(before)
    for spec in signature.inputs:
        if spec.name in found or spec.role is Role.MEMORY_IN:
            continue
        shape = tuple(rows if n is None else n for n in spec.shape)
        array = np.full(shape, 1 if spec.role is Role.MASKS else 0, spec.dtype)
        taken = next((outputs[h.name] for h in signature.heads if not h.is_continuous and h.name in outputs), None)
        if spec.role is Role.PREV_ACTION and taken is not None:
            known = before != NONE
            array[known] = taken.reshape(rows, -1)[before[known]].reshape(array[known].shape)
        found[spec.name] = array
    return found
