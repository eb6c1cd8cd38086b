"""Long episodes on a policy's own memory: stretches side by side give what one step after the other gives."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from msgspec.structs import replace

from export_model.exporter.logs.recording import NONE
from export_model.exporter.logs.replay import SHORT, MemoryUse, Replay
from tests.commands import ROOT
from tests.exporting import load_policy

HALLWAY = ROOT / "fixtures" / "trained" / "Hallway"
STEPS = 3 * SHORT * SHORT // 64
Array = np.ndarray


def links(lengths: Sequence[int]) -> tuple[Array, Array]:
    """The row of the step before, and the same across episodes."""
    rows = np.arange(sum(lengths))
    before = rows - 1
    before[np.cumsum([0, *lengths[:-1]])] = NONE
    return before, rows - 1


def one_by_one(step: Callable[[Array, Array], Array], seen: Array, source: Array, width: int) -> Array:
    memory = np.zeros((len(seen) + 1, width), np.float32)
    for row in range(len(seen)):
        memory[row] = step(memory[source[row]][None], seen[row : row + 1])[0]
    return memory[:-1]


#: A memory that forgets, one that never does, one that becomes no number.
MEMORIES: dict[str, Callable[[Array, Array], Array]] = {
    "forgets": lambda memory, seen: np.tanh(np.float32(0.5) * memory + seen),
    "adds up": lambda memory, seen: memory + seen,
    "overflows": lambda memory, seen: memory * np.float32(1e30) - memory * np.float32(1e31) + seen,
}


@pytest.mark.filterwarnings("ignore:.*encountered in:RuntimeWarning")
@pytest.mark.parametrize("use", [MemoryUse.KEPT, MemoryUse.NOT_RESET, MemoryUse.LATE])
@pytest.mark.parametrize("name", MEMORIES)
def test_stretches_side_by_side_are_the_steps_one_by_one(name: str, use: MemoryUse) -> None:
    policy = load_policy(HALLWAY, runtime="numpy")
    pair = policy.signature.recurrence
    assert pair is not None
    width = int(policy.signature.input(pair[0]).shape[-1] or 0)
    before, last = links([STEPS, 5, 1, STEPS // 2])
    seen = np.random.default_rng(0).normal(size=(len(before), width)).astype(np.float32)
    calls = []

    def run(feeds: dict[str, Array], fetch: Sequence[str]) -> dict[str, Array]:
        calls.append(len(feeds["seen"]))
        return {n: MEMORIES[name](feeds[pair[0]], feeds["seen"]) for n in fetch}

    replay = Replay(run, policy.signature, (pair[1],))  # type: ignore[arg-type]
    # the signature's own inputs are what the rows are cut by
    feeds = {s.name: np.zeros((len(before), *(n or 1 for n in s.shape[1:])), s.dtype) for s in policy.signature.inputs}
    feeds = {n: a for n, a in feeds.items() if n != pair[0]} | {"seen": seen}
    found = replay.answers(feeds, before, last, use)[pair[1]]
    source = {MemoryUse.KEPT: before, MemoryUse.NOT_RESET: last}.get(
        use, np.where(before == NONE, NONE, before[before])
    )
    np.testing.assert_array_equal(found, one_by_one(MEMORIES[name], seen, source, width))
    if name == "forgets":
        assert len(calls) < STEPS / 2, "as many runs as steps"


def test_a_memory_that_is_never_fed_back_is_run_at_once() -> None:
    policy = load_policy(HALLWAY, runtime="numpy")
    before, last = links([600])
    rows = {s.name: np.zeros((600, *(n or 1 for n in s.shape[1:])), s.dtype) for s in policy.signature.inputs}
    pair = policy.signature.recurrence
    assert pair is not None
    given = {n: a for n, a in rows.items() if n != pair[0]}
    calls = []

    def run(feeds: dict[str, Array], fetch: Sequence[str]) -> dict[str, Array]:
        calls.append(len(feeds[pair[0]]))
        return policy.run(feeds, fetch)  # type: ignore[return-value]

    Replay(run, policy.signature, (pair[1],)).answers(given, before, last, MemoryUse.DROPPED)  # type: ignore[arg-type]
    assert calls == [600]


def test_an_episode_of_a_hundred_thousand_steps_takes_seconds_of_the_processor() -> None:
    policy = load_policy(HALLWAY, runtime="numpy")
    before, last = links([100_000])
    rng = np.random.default_rng(1)
    pair = policy.signature.recurrence
    assert pair is not None
    feeds = {
        s.name: rng.normal(size=(100_000, *(n or 1 for n in s.shape[1:]))).astype(s.dtype)
        if s.dtype == "float32" and s.name in {o.name for o in policy.signature.observations}
        else np.ones((100_000, *(n or 1 for n in s.shape[1:])), s.dtype)
        for s in policy.signature.inputs
        if s.name != pair[0]
    }
    begun = time.process_time()
    found = Replay(policy.run, policy.signature, (pair[1],)).answers(feeds, before, last)[pair[1]]
    assert time.process_time() - begun < 10
    # the end of it, from its own memory, one step after the other
    memory = found[-301:-300]
    for row in range(-300, 0):
        given = {n: a[row:][:1] for n, a in feeds.items()}
        memory = policy.run({**given, pair[0]: memory}, [pair[1]])[pair[1]]
    np.testing.assert_allclose(found[-1:], memory, atol=1e-6)


def test_a_memory_that_is_not_given_back_is_zero() -> None:
    policy = load_policy(HALLWAY, runtime="numpy")
    pair = policy.signature.recurrence
    assert pair is not None
    outputs = tuple(s for s in policy.signature.outputs if s.name != pair[1])
    signature = replace(policy.signature, outputs=outputs, memory=None)
    assert signature.recurrence is None
    rows = {s.name: np.ones((3, *(n or 1 for n in s.shape[1:])), s.dtype) for s in signature.inputs}
    name = next(s.name for s in outputs if s.dtype == "float32")
    wanted = policy.run({**rows, pair[0]: np.zeros_like(rows[pair[0]])}, [name])[name]
    given = {n: a for n, a in rows.items() if n != pair[0]}
    before, last = links([3])
    found = Replay(policy.run, signature, (name,)).answers(given, before, last)[name]  # type: ignore[arg-type]
    np.testing.assert_array_equal(found, wanted)
