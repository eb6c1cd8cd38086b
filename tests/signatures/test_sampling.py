"""Inputs to try a policy on: seeded, around its own statistics, at the edges, masks that always allow an action."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from export_model.signatures.roles import Role
from export_model.signatures.sampling import (
    BATCHES,
    EXTREMES,
    FAR,
    HUGE_BATCH,
    LARGE_BATCH,
    ONE_FORBIDDEN,
    Case,
    draw_cases,
    draw_rollout,
)
from export_model.signatures.spec import Memory, PolicySignature, TensorSpec

ACTION = TensorSpec("action", Role.CONTINUOUS, "float32", (None, 2))


def signature(*inputs: TensorSpec, branches: tuple[int, ...] = (), memory: Memory | None = None) -> PolicySignature:
    return PolicySignature(
        inputs=inputs,
        outputs=(ACTION,),
        family="own model",
        action_space="continuous",
        branches=branches,
        memory=memory,
    )


def spec(name: str, role: Role, *shape: int | None, dtype: str = "float32", **distribution: Any) -> TensorSpec:
    return TensorSpec(name, role, dtype, shape, None, distribution or None)


EVERYTHING = signature(
    spec("state", Role.VECTOR, None, 4, kind="normal", mean=[0.0, 100.0, -5.0, 0.5], std=[1.0, 10.0, 0.1, 2.0]),
    spec("state_1", Role.VECTOR, None, 1, dtype="int32", kind="integer", low=0, high=6),
    spec("observation_0", Role.VISUAL, None, 6, 5, 3),
    spec("entities_0", Role.ENTITIES, None, None, 4),
    spec("action_masks", Role.MASKS, None, 9),
    spec("prev_action", Role.PREV_ACTION, None, 3, dtype="int32"),
    spec("recurrent_in", Role.MEMORY_IN, None, 8),
    spec("epsilon", Role.NOISE, None, 2),
    spec("gain", Role.PARAMETER, 5),
    spec("scale", Role.PARAMETER),
    branches=(3, 2, 4),
    memory=Memory(8, "recurrent_in", "recurrent_out"),
)


def same(a: list[Case], b: list[Case]) -> bool:
    return all(
        x.name == y.name and x.feeds.keys() == y.feeds.keys() and all((x.feeds[n] == y.feeds[n]).all() for n in x.feeds)
        for x, y in zip(a, b, strict=True)
    )


def test_the_same_seed_gives_the_same_cases() -> None:
    assert same(draw_cases(EVERYTHING, seed=3), draw_cases(EVERYTHING, seed=3))
    assert not same(draw_cases(EVERYTHING, seed=3), draw_cases(EVERYTHING, seed=4))


def test_the_first_draw_is_the_same_on_every_machine() -> None:
    """PCG64's stream is part of numpy's promise."""
    first = draw_cases(signature(spec("state", Role.VECTOR, None, 3)), seed=0)[0].feeds["state"]
    expected = np.random.Generator(np.random.PCG64(0)).standard_normal((1, 3))
    np.testing.assert_array_equal(first, expected.astype(np.float32))


def test_every_batch_size_is_tried() -> None:
    cases = draw_cases(EVERYTHING, samples=3)
    typical = [c for c in cases if c.name.startswith("typical") and "#" in c.name]
    assert [c.batch for c in typical] == [b for b in BATCHES for _ in range(3)]
    alone = draw_cases(signature(spec("state", Role.VECTOR, None, 3)))
    assert {1, 2, 7, 10, 12, 16, 32, 48, 64, LARGE_BATCH, HUGE_BATCH} <= {c.batch for c in alone}
    assert {1, 2, 7, 32, 64, 67} <= {c.batch for c in cases}
    assert [c.name for c in cases[len(typical) :]] == [
        *("zeros", "clip edges", "beyond the clip", "1e3", "denormals"),
        *("all but one action masked", "random masks", "masks, 8 to 1e4", "one or two actions masked"),
        *("every id", "pixels at their ends", "typical, batch 67", "opposite extremes", "8 to 1e4"),
        "one number far away",
        *("images with structure, batch 32", "images with structure, batch 64"),
    ]
    assert len({c.name for c in cases}) == len(cases)


@pytest.mark.parametrize(("side", "batch"), [(0, LARGE_BATCH), (84, 67), (128, 33), (400, 9)])
def test_a_large_odd_batch_is_tried_once(side: int, batch: int) -> None:
    image = (spec("observation_0", Role.VISUAL, None, side, side, 3),) if side else ()
    cases = draw_cases(signature(spec("state", Role.VECTOR, None, 3), *image), samples=3)
    assert [c.name for c in cases if c.batch == batch] == [f"typical, batch {batch}"]
    typical = max(c.batch for c in cases if c.name.startswith("typical"))
    assert typical == (batch if side else HUGE_BATCH)


def test_pixels_are_tried_at_their_ends() -> None:
    (case,) = (c for c in draw_cases(EVERYTHING) if c.name == "pixels at their ends")
    black, white, both = case.feeds["observation_0"]
    assert (black == 0).all()
    assert (white == 1).all()
    assert {*np.unique(both)} == {0, 1}


def test_pictures_with_structure_are_tried_beside_every_pattern_of_a_vector() -> None:
    cases = [c for c in draw_cases(EVERYTHING) if "structure" in c.name]
    images = np.concatenate([c.feeds["observation_0"] for c in cases])
    assert images.min() >= 0
    assert images.max() <= 1
    for half in (images[:, :, :2], images[:, :, 3:], images[:, :3], images[:, 3:]):
        rest = images.any((1, 2, 3))
        assert ((half == 0).all((1, 2, 3)) & rest).any()
    assert ((images[..., 0] > 0).any((1, 2)) & (images[..., 1:] == 0).all((1, 2, 3))).any()
    steps = np.abs(np.diff(images, axis=2)).max((1, 2, 3))
    assert ((steps < 0.3) & (np.ptp(images, axis=(1, 2, 3)) > 0.5)).any(), "none is smooth"
    vectors = (np.concatenate([c.feeds["state"] for c in cases]) != 0).sum(axis=1)
    assert (vectors == 1).any()


def test_every_two_numbers_are_at_opposite_extremes_of_two_inputs_too() -> None:
    known = spec("state", Role.VECTOR, None, 4, mean=[1.0] * 4, std=[2.0] * 4)
    two = signature(known, spec("state_1", Role.VECTOR, None, 7))
    cases = {c.name: c for c in draw_cases(two)}
    fed = cases["opposite extremes"].feeds
    rows = np.concatenate([(fed["state"] - 1) / 2, fed["state_1"]], axis=1)
    for low, high in EXTREMES:
        here = rows[((low - 1e-5 <= np.abs(rows)) & (np.abs(rows) <= high + 1e-5)).all(axis=1)]
        assert all(((here[:, i] > 0) & (here[:, j] < 0)).any() for i in range(11) for j in range(11) if i != j)
    far = np.concatenate([cases["8 to 1e4"].feeds[s.name] for s in two.inputs], axis=1)
    for low, high in FAR:
        here = far[((low <= np.abs(far)) & (np.abs(far) <= high)).all(axis=1)]
        assert all(((here[:, i] > 0) & (here[:, j] < 0)).any() for i in range(11) for j in range(11) if i != j)
    alone = np.abs(np.concatenate([cases["one number far away"].feeds[s.name] for s in two.inputs], axis=1)) > 8
    assert alone.any(axis=0).all()


def test_the_memory_is_tried_far_from_zero() -> None:
    cases = {c.name: c for c in draw_cases(EVERYTHING)}
    assert np.abs(cases["clip edges"].feeds["recurrent_in"]).max() > 3
    assert np.abs(cases["typical, batch 7, #0"].feeds["recurrent_in"]).max() < 3


def test_masks_are_tried_only_where_there_are_some() -> None:
    names = [c.name for c in draw_cases(signature(spec("state", Role.VECTOR, None, 3)))]
    assert not any("mask" in name for name in names)


def test_arrays_have_the_dtypes_and_shapes_of_the_contract() -> None:
    for case in draw_cases(EVERYTHING):
        for each in EVERYTHING.inputs:
            array = case.feeds[each.name]
            assert array.dtype.name == each.dtype
            assert array.ndim == len(each.shape)
            for axis, (wanted, size) in enumerate(zip(each.shape, array.shape, strict=True)):
                assert size == (wanted if wanted is not None else case.batch if axis == 0 else 8)


def test_the_rows_are_those_of_the_observation_even_where_a_parameter_is_longer() -> None:
    case = draw_cases(EVERYTHING)[0]
    assert (case.batch, case.feeds["gain"].shape, EVERYTHING.rows(case.feeds)) == (1, (5,), 1)
    assert EVERYTHING.rows(draw_cases(EVERYTHING)[5].feeds) == 7
    assert signature(spec("gain", Role.PARAMETER, 5)).rows({"gain": np.zeros(5)}) == 1


def test_values_are_drawn_around_the_policys_own_statistics() -> None:
    cases = {c.name: c for c in draw_cases(EVERYTHING, samples=400)}
    rows = np.concatenate([c.feeds["state"] for n, c in cases.items() if n.startswith("typical")])
    np.testing.assert_allclose(rows.mean(axis=0), [0, 100, -5, 0.5], atol=0.6)
    np.testing.assert_allclose(rows.std(axis=0), [1, 10, 0.1, 2], rtol=0.1)
    assert not cases["zeros"].feeds["state"].any()
    np.testing.assert_allclose(np.abs(cases["clip edges"].feeds["state"][:, 1] - 100), 50)
    np.testing.assert_allclose(np.abs(cases["beyond the clip"].feeds["state"][:, 3] - 0.5), 16)
    assert (np.abs(cases["1e3"].feeds["state"]) == 1e3).all()
    denormal = cases["denormals"].feeds["state"]
    assert ((denormal != 0) & (np.abs(denormal) < np.finfo(np.float32).tiny)).all()


def test_each_input_is_in_its_range() -> None:
    for case in draw_cases(EVERYTHING, samples=20):
        assert ((case.feeds["state_1"] >= 0) & (case.feeds["state_1"] <= 6)).all()
        assert ((case.feeds["observation_0"] >= 0) & (case.feeds["observation_0"] <= 1)).all()
        previous = case.feeds["prev_action"]
        assert ((previous >= 0) & (previous < np.array([3, 2, 4]))).all()


def test_every_integer_of_a_discrete_state_turns_up() -> None:
    seen = np.concatenate([c.feeds["state_1"].ravel() for c in draw_cases(EVERYTHING, samples=40)])
    assert set(seen.tolist()) == set(range(7))


def test_a_discrete_state_without_a_known_range_is_zero_or_one() -> None:
    plain = signature(spec("state", Role.VECTOR, None, 1, dtype="int32"))
    seen = np.concatenate([c.feeds["state"].ravel() for c in draw_cases(plain, samples=10)])
    assert set(seen.tolist()) == {0, 1}


def test_the_previous_action_may_be_a_vector_and_its_branches_unknown() -> None:
    one = signature(spec("prev_action", Role.PREV_ACTION, None, dtype="int32"), branches=(5,))
    assert {int(v) for c in draw_cases(one, samples=30) for v in c.feeds["prev_action"]} == set(range(5))
    unknown = signature(spec("prev_action", Role.PREV_ACTION, None, 2, dtype="int32"))
    assert {int(v) for c in draw_cases(unknown, samples=9) for v in c.feeds["prev_action"].ravel()} == {0, 1}


@given(st.lists(st.integers(1, 6), min_size=1, max_size=4), st.integers(0, 2**32))
@settings(max_examples=50, deadline=None)
def test_masks_always_allow_an_action_of_every_branch(branches: list[int], seed: int) -> None:
    masked = signature(
        spec("state", Role.VECTOR, None, 2), spec("m", Role.MASKS, None, sum(branches)), branches=tuple(branches)
    )
    edges = np.cumsum(branches)[:-1]
    for case in draw_cases(masked, seed=seed):
        mask = case.feeds["m"]
        assert set(np.unique(mask)) <= {0.0, 1.0}
        parts = np.split(mask, edges, axis=1)
        assert all((part.sum(axis=1) >= 1).all() for part in parts)
        if case.name == "all but one action masked":
            assert all((part.sum(axis=1) == 1).all() for part in parts)
        elif case.name == ONE_FORBIDDEN:
            assert {*(mask == 0).sum(axis=1)} <= {1, 2}
            assert {*np.flatnonzero(np.repeat(branches, branches) > 1)} <= {*(1 - mask).argmax(axis=1)}
        elif case.name not in ("random masks", "masks, 8 to 1e4"):
            assert mask.all()


def test_masks_without_known_branches_are_one_branch() -> None:
    odd = signature(spec("m", Role.MASKS, None, 5), branches=(2, 2))
    case = next(c for c in draw_cases(odd) if c.name == "all but one action masked")
    assert (case.feeds["m"].sum(axis=1) == 1).all()
    assert not case.feeds["m"][:2].all(axis=0).any()


# ------------------------------------------------------------------ rollouts


def test_an_episode_begins_with_an_empty_memory() -> None:
    steps = draw_rollout(EVERYTHING, seed=1, steps=5)
    assert len(steps) == 5
    assert not steps[0]["recurrent_in"].any()
    assert all(step["recurrent_in"].any() for step in steps[1:])
    assert {step["state"].shape for step in steps} == {(2, 4)}
    assert not (steps[1]["state"] == steps[2]["state"]).any()


def test_an_episode_depends_on_its_seed_and_not_on_its_length() -> None:
    long, short, other = (draw_rollout(EVERYTHING, seed=s, steps=n) for s, n in ((1, 5), (1, 2), (2, 2)))
    np.testing.assert_array_equal(long[1]["state"], short[1]["state"])
    assert not (other[1]["state"] == short[1]["state"]).any()


@pytest.mark.parametrize("memory", [None, Memory(8, None, "recurrent_out")])
def test_an_episode_without_a_memory_to_feed_is_just_steps(memory: Memory | None) -> None:
    plain = signature(spec("state", Role.VECTOR, None, 3), memory=memory)
    assert [set(step) for step in draw_rollout(plain, seed=0, steps=3, batch=4)] == [{"state"}] * 3


@pytest.mark.parametrize("width", [0, 1 << 15])
def test_a_wide_or_empty_observation_takes_memory_for_its_own_numbers(width: int) -> None:
    wide = signature(spec("state", Role.VECTOR, None, width))
    tracemalloc.start()
    feeds = sum(a.nbytes for case in draw_cases(wide) for a in case.feeds.values())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 4 * feeds + (1 << 20)


_BOUNDS = [(shape, high) for shape in ((3,), (3, 5, 4), ()) for high in (None, 6)] + [((3,), [6, None, 2])]


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize(("shape", "high"), _BOUNDS, ids=str)
def test_integers_of_any_size_are_drawn_wherever_they_stand(high: Any, place: int, shape: tuple[int, ...]) -> None:
    """A board of integers that nothing bounds ended an export in a traceback: it had no signs of its own."""
    low = [0 if n is not None else None for n in high] if isinstance(high, list) else None if high is None else 0
    board = TensorSpec(
        "board", Role.VECTOR, "int32", (None, *shape), distribution={"kind": "integer", "low": low, "high": high}
    )
    others = [TensorSpec(f"state_{i}", Role.VECTOR, "float32", (None, 4)) for i in range(2)]
    cases = draw_cases(signature(*others[:place], board, *others[place:]))
    drawn = np.concatenate([case.feeds["board"].reshape(-1, *shape) for case in cases])
    assert drawn.dtype == np.int32
    if high is None:
        assert drawn.min() < -100 < 100 < drawn.max()
    elif high == 6:
        assert drawn.min() >= 0
        assert drawn.max() <= 6
