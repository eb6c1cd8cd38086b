"""The environments: the same episodes for the same seed, rules and physics that hold, masks that are true."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from export_model.exporter.play.environments import (
    ENVIRONMENTS,
    Ball3D,
    Crawler2D,
    GridWorld,
    Hallway,
    Tennis,
    ball3d,
    crawler2d,
    gridworld,
    tennis,
)
from export_model.exporter.play.environments.base import Environment, Streams
from fixtures.evaluate import play, together

Array = np.ndarray[Any, Any]
NAMES = tuple(ENVIRONMENTS)
SEEDS = st.integers(0, 2**32 - 1)


def some_actions(environment: Environment, chance: np.random.Generator) -> Any:
    agents = environment.num_envs
    if isinstance(environment, Tennis):
        return {"LeftBrain": chance.integers(0, 3, (agents, 1)), "RightBrain": chance.uniform(-1, 1, (agents, 1))}
    if environment.branches:
        return chance.integers(0, environment.branches[0], (agents, 1))
    return chance.uniform(-1, 1, (agents, environment.action_size))


def only(actions: Any, rows: int) -> Any:
    if isinstance(actions, Mapping):
        return {brain: taken[:rows] for brain, taken in actions.items()}
    return actions[:rows]


def flat(observation: Mapping[str, Any], rows: int | None = None) -> dict[str, Array]:
    found = {}
    for name, value in observation.items():
        inner = flat(value, rows) if isinstance(value, Mapping) else {"": value[:rows]}
        found.update({f"{name}/{key}": array for key, array in inner.items()})
    return found


# ------------------------------------------------------------------ chance


def test_the_stream_is_mulberry32() -> None:
    """What the well-known five lines of JavaScript give for the seeds 12345 and 0, times 2^32."""
    streams = Streams(0, 2)
    streams._state = np.array([12345, 0], np.uint32)
    drawn = np.stack([streams.uniform(np.ones(2, bool)) for _ in range(3)]) * 2**32
    assert drawn[:, 0].tolist() == [4207900869, 1317490944, 2079646450]
    assert drawn[:2, 1].tolist() == [1144304738, 1416247]


def test_draws_are_uniform_and_only_the_rows_asked_for_move() -> None:
    streams = Streams(7, 20_000)
    drawn = streams.uniform(np.ones(20_000, bool), -2.0, 2.0)
    assert abs(drawn.mean()) < 0.03
    assert drawn.std() == pytest.approx(4 / math.sqrt(12), rel=0.02)
    one, other = Streams(7, 2), Streams(7, 2)
    one.uniform(np.array([True, False]))
    assert one.uniform(np.array([False, True])) == other.uniform(np.array([False, True]))


# ------------------------------------------------------------------ what all of them keep


@pytest.mark.parametrize("name", NAMES)
@given(seed=SEEDS, rows=st.integers(1, 6))
@settings(max_examples=4, deadline=None)
def test_an_agent_lives_the_same_life_alone_and_among_others(name: str, seed: int, rows: int) -> None:
    few, many = ENVIRONMENTS[name](rows), ENVIRONMENTS[name](7)
    here, there = few.reset(seed=seed)[0], many.reset(seed=seed)[0]
    chance = np.random.default_rng(seed)
    for _ in range(60):
        np.testing.assert_equal(flat(here), flat(there, rows))
        actions = some_actions(many, chance)
        here, *mine, _ = few.step(only(actions, rows))
        there, *theirs, _ = many.step(actions)
        for one, other in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(one, other[:rows])


@pytest.mark.parametrize("name", NAMES)
def test_other_seeds_and_other_agents_begin_otherwise(name: str) -> None:
    starts = []
    for seed in (0, 1, 2):
        observation, _ = ENVIRONMENTS[name](4).reset(seed=seed)
        starts += list((observation["LeftBrain"] if name == "Tennis" else observation)["state"])
    assert len(np.unique(np.stack(starts), axis=0)) >= (2 if name == "Hallway" else 8)


@pytest.mark.parametrize("name", NAMES)
def test_episodes_end_and_begin_anew(name: str) -> None:
    environment = ENVIRONMENTS[name](9)
    observation, _ = environment.reset(seed=3)
    chance = np.random.default_rng(0)
    age, ends = np.zeros(9, int), 0
    for _ in range(300):
        first = (observation["LeftBrain"] if name == "Tennis" else observation)["is_first"]
        np.testing.assert_array_equal(first, age == 0)
        observation, _, terminated, truncated, info = environment.step(some_actions(environment, chance))
        age += 1
        ended = terminated | truncated
        assert not (terminated & truncated).any()
        assert not truncated[age < environment.max_steps].any()
        assert (ended | (age < environment.max_steps)).all()
        assert ("final_obs" in info) == ended.any()
        assert not info["success"][~ended].any()
        if ended.any():  # those that go on see now what they saw then
            now, then = flat(observation), flat(info["final_obs"])
            for key in (k for k in now if not k.endswith("is_first/")):
                np.testing.assert_array_equal(now[key][~ended], then[key][~ended])
        age[ended] = 0
        ends += int(ended.sum())
    assert ends > 10


@pytest.mark.parametrize("name", NAMES)
def test_a_step_before_reset_is_refused(name: str) -> None:
    with pytest.raises(RuntimeError, match="reset comes before step"):
        ENVIRONMENTS[name](1).step(np.zeros((1, 1)))


# ------------------------------------------------------------------ 3DBall


def level(position: tuple[float, float] = (0.0, 0.0), tilt: tuple[float, float] = (0.0, 0.0)) -> Ball3D:
    environment = Ball3D(1)
    environment.reset(seed=0)
    environment.position[:], environment.tilt[:], environment.velocity[:] = position, tilt, 0.0
    return environment


def test_a_ball_at_rest_on_a_level_platform_rests_for_20_s() -> None:
    environment = level((1.0, -1.0))
    total = 0.0
    for step in range(1000):
        _, rewards, terminated, truncated, _ = environment.step(np.zeros((1, 2)))
        total += rewards[0]
        assert not terminated[0]
        assert truncated[0] == (step == 999)
    assert total == pytest.approx(100.0)


@pytest.mark.parametrize(("axis", "sign"), [(0, -1.0), (1, 1.0)])
def test_a_ball_rolls_down_as_a_solid_sphere_does(axis: int, sign: float) -> None:
    tilt = 0.1
    environment = level(tilt=(tilt, 0.0) if axis == 0 else (0.0, tilt))
    steps = 50
    for _ in range(steps):
        environment.step(np.zeros((1, 2)))
    time = steps * ball3d.TIME_STEP
    expected = sign * 0.5 * 5 / 7 * 9.81 * math.sin(tilt) * time**2
    assert environment.position[0, axis] == pytest.approx(expected, rel=0.03)
    assert environment.position[0, 1 - axis] == 0.0


@given(action=st.tuples(*[st.floats(-3, 3)] * 2), seed=SEEDS)
@settings(max_examples=50, deadline=None)
def test_tilts_are_bounded_and_the_ball_lies_on_the_platform(action: tuple[float, float], seed: int) -> None:
    environment = Ball3D(1)
    environment.reset(seed=seed)
    for _ in range(20):
        before = environment.tilt.copy()
        observation, _, terminated, _, _ = environment.step(np.array([action]))
        if terminated[0]:
            break
        assert np.abs(environment.tilt).max() <= ball3d.MAX_TILT
        assert np.abs(environment.tilt - before).max() <= ball3d.TURN + 1e-12
        rz, rx, x, y, z, vx, vy, vz = observation["state"][0].astype(float)
        assert y - ball3d.RADIUS == pytest.approx(x * math.tan(rz) - z * math.tan(rx), abs=1e-5)
        assert vy == pytest.approx(vx * math.tan(rz) - vz * math.tan(rx), abs=1e-5)


def test_a_ball_that_rolls_off_ends_the_episode() -> None:
    environment = level((2.49, 0.0))
    environment.velocity[:] = 1.0, 0.0
    _, rewards, terminated, truncated, info = environment.step(np.zeros((1, 2)))
    assert (rewards[0], terminated[0], truncated[0], info["success"][0]) == (-1.0, True, False, False)
    assert info["final_obs"]["state"][0, 2] > ball3d.HALF_SIDE
    assert abs(environment.position[0, 0]) <= ball3d.START_POSITION


# ------------------------------------------------------------------ GridWorld


def cells(state: Array) -> Array:
    """(column, row) of agent, goal and pit, from what is seen."""
    return np.asarray(np.rint((state.reshape(-1, 3, 2) + 1) * 2), int)


@given(seed=SEEDS)
@settings(max_examples=25, deadline=None)
def test_masks_say_what_moves(seed: int) -> None:
    environment = GridWorld(16)
    observation, _ = environment.reset(seed=seed)
    chance = np.random.default_rng(seed)
    for _ in range(20):
        before, masks = cells(observation["state"]), observation["action_masks"]
        assert (masks.sum(1) >= 1).all()
        assert not {tuple(c) for c in before.reshape(-1, 2).tolist()} & set(gridworld.WALLS)
        assert ((before >= 0) & (before < gridworld.SIZE)).all()
        move = chance.integers(0, 4, (16, 1))
        observation, rewards, terminated, _, info = environment.step(move)
        after = cells(info.get("final_obs", observation)["state"])
        moved = after[:, 0] - before[:, 0]
        allowed = np.take_along_axis(masks, move, 1)[:, 0] == 1
        np.testing.assert_array_equal(moved, gridworld.MOVES[move[:, 0]] * allowed[:, None])
        at_goal, in_pit = ((after[:, 0] == after[:, i]).all(1) for i in (1, 2))
        np.testing.assert_array_equal(terminated, at_goal | in_pit)
        np.testing.assert_array_equal(info["success"], at_goal)
        np.testing.assert_array_equal(rewards, np.where(at_goal, 1.0, np.where(in_pit, -1.0, -0.01)))


def test_every_start_can_be_solved() -> None:
    free = {(int(x), int(y)) for x, y in gridworld.FREE}
    for pit in free:
        reached, edge = set(), [next(iter(free - {pit}))]
        while edge:
            cell = edge.pop()
            reached.add(cell)
            steps = {(cell[0] + int(dx), cell[1] + int(dy)) for dx, dy in gridworld.MOVES}
            edge += list((steps & free) - {pit} - reached)
        assert reached == free - {pit}


def test_agent_goal_and_pit_start_in_different_cells_and_everywhere() -> None:
    observation, _ = GridWorld(5000).reset(seed=1)
    places = cells(observation["state"])
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert (places[:, one] != places[:, other]).any(1).all()
    for which in range(3):
        cell, count = np.unique(places[:, which], axis=0, return_counts=True)
        assert len(cell) == len(gridworld.FREE)
        assert count.min() > 0.7 * 5000 / len(gridworld.FREE)


# ------------------------------------------------------------------ Hallway


@given(seed=SEEDS)
@settings(max_examples=25, deadline=None)
def test_the_cue_is_seen_once_and_says_the_door(seed: int) -> None:
    environment = Hallway(12)
    observation, _ = environment.reset(seed=seed)
    cue = observation["state"][:, :2].copy()
    assert (cue.sum(1) == 1).all()
    length = np.rint(observation["state"][:, 2] * 8).astype(int)
    assert ((length >= 4) & (length <= 8)).all()
    score_steps = 0
    waiting = np.ones(12, bool)
    while waiting.any():
        at_doors = observation["state"][:, 3] == 1
        action = np.where(at_doors, 1 + cue.argmax(1), 0)
        observation, rewards, terminated, _, info = environment.step(action[:, None])
        score_steps += 1
        np.testing.assert_array_equal(terminated[waiting], at_doors[waiting])
        np.testing.assert_array_equal(terminated[waiting], (length + 1 == score_steps)[waiting])
        assert (rewards[waiting & at_doors] == 1).all()
        assert info["success"][waiting & at_doors].all()
        waiting &= ~terminated
        assert not observation["state"][waiting, :2].any()
        assert (observation["prev_action"][waiting, 0] == 0).all()


def test_the_wrong_door_ends_badly_and_dawdling_is_cut_off() -> None:
    environment = Hallway(40)
    environment.reset(seed=0)
    environment.ahead[:] = 0
    _, rewards, terminated, _, info = environment.step((3 - environment.door)[:, None])
    assert (rewards == -1).all()
    assert terminated.all()
    assert not info["success"].any()
    for step in range(40):
        observation, _, terminated, truncated, _ = environment.step(np.full((40, 1), 1 + step % 2))
        assert not terminated.any()
    assert truncated.all()
    assert (observation["prev_action"] == 0).all()


# ------------------------------------------------------------------ Tennis


def follow(observation: dict[str, Any]) -> Array:
    return np.asarray(observation["state"][:, 2:3] - observation["state"][:, 0:1])


def left_follows(observation: dict[str, Any]) -> Array:
    away = follow(observation)
    return np.where(np.abs(away) < 0.05, 0, np.where(away > 0, 1, 2))


def right_follows(observation: dict[str, Any]) -> Array:
    return np.clip(follow(observation) / 0.05, -1, 1)


def test_brains_that_follow_the_ball_never_miss() -> None:
    score = play(Tennis(20), together({"LeftBrain": left_follows, "RightBrain": right_follows}), seed=5)
    assert score.success.all()
    assert (score.lengths == 1000).all()
    np.testing.assert_allclose(score.returns.sum(1), 2.5)  # 25 crossings


def test_a_brain_that_stands_still_is_the_one_that_misses() -> None:
    still = lambda observation: np.zeros((len(observation["is_first"]), 1), int)  # noqa: E731
    score = play(Tennis(20), together({"LeftBrain": still, "RightBrain": right_follows}), seed=5)
    assert not score.success.any()
    assert (score.returns[:, 0] < 0).all()
    assert (score.returns[:, 1] >= 0).all()


@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_ball_and_rackets_stay_on_the_court_and_each_brain_sees_its_side(seed: int) -> None:
    environment = Tennis(8)
    observation, _ = environment.reset(seed=seed)
    chance = np.random.default_rng(seed)
    for _ in range(100):
        left, right = (observation[b]["state"].astype(float) for b in tennis.BRAINS)
        np.testing.assert_allclose(left[:, 1] + right[:, 1], 2.0, atol=1e-6)
        np.testing.assert_allclose(left[:, 3], -right[:, 3])
        np.testing.assert_array_equal(left[:, [2, 4]], right[:, [2, 4]])
        np.testing.assert_array_equal(np.stack([left[:, 0], right[:, 0]], 1), environment.racket.astype(np.float32))
        assert (np.abs(left[:, [0, 2]]) <= 1.0).all()
        assert ((left[:, 1] > -1e-6) & (left[:, 1] < 2 + 1e-6)).all()
        assert (np.abs(left[:, 4]) <= tennis.MAX_SLANT).all()
        masks = observation["LeftBrain"]["action_masks"]
        before = environment.racket[:, 0].copy()
        assert (masks[:, 0] == 1).all()
        np.testing.assert_array_equal(masks[:, 1] == 0, before == 1.0)
        np.testing.assert_array_equal(masks[:, 2] == 0, before == -1.0)
        observation, _, terminated, _, _ = environment.step(some_actions(environment, chance))
        speed = np.abs(environment.racket[~terminated, 0] - before[~terminated]) / tennis.TIME_STEP
        assert (speed <= tennis.RACKET_SPEED + 1e-9).all()


# ------------------------------------------------------------------ Crawler2D

MASS = np.array([crawler2d.HIP_MASS] * 2 + [crawler2d.KNEE_MASS] * 4 + [crawler2d.FOOT_MASS] * 4)


def test_what_a_crawler_does_in_the_air_moves_its_middle_nowhere() -> None:
    """Torques come in pairs, and rods pull both ends: the centre of mass falls as a stone does."""
    environment = Crawler2D(3)
    environment.reset(seed=1)
    environment.place[1] += 50.0
    momentum = (environment.speed * MASS[:, None]).sum(1)
    chance = np.random.default_rng(0)
    for _ in range(20):
        _, _, terminated, *_ = environment.step(chance.uniform(-1, 1, (3, 8)))
        assert not terminated.any()
    momentum[1] -= MASS.sum() * crawler2d.GRAVITY * 20 * crawler2d.TIME_STEP
    np.testing.assert_allclose((environment.speed * MASS[:, None]).sum(1), momentum, atol=1e-9)


def test_a_crawler_that_does_nothing_stands_where_it_is() -> None:
    score = play(environment := Crawler2D(2), lambda _: np.zeros((2, 8)), seed=2)
    assert score.success.all()
    assert np.abs(score.returns).max() < 0.2
    assert environment.place.shape == (2, 10, 2)


def test_rods_come_back_to_their_lengths_and_nothing_is_below_the_ground() -> None:
    environment = Crawler2D(6)
    environment.reset(seed=3)
    chance = np.random.default_rng(3)
    legs = (([0, 1] * 2, range(2, 6), crawler2d.THIGH), (range(2, 6), range(6, 10), crawler2d.SHIN))
    off = []
    for _ in range(60):
        environment.step(chance.uniform(-1, 1, (6, 8)))
        x, y = environment.place
        np.testing.assert_allclose(np.hypot(x[1] - x[0], y[1] - y[0]), crawler2d.BODY, rtol=1e-9)
        off += [np.abs(np.hypot(x[b] - x[a], y[b] - y[a]) / length - 1.0) for a, b, length in legs]
        assert y.min() >= 0.0
    assert np.mean(off) < 0.02  # an impact is felt for a substep or two


def test_a_crawler_that_turns_over_has_fallen() -> None:
    environment = Crawler2D(1)
    environment.reset(seed=0)
    environment.place[0] *= -1.0
    environment.place[1] += 2.0
    _, _, terminated, _, info = environment.step(np.zeros((1, 8)))
    assert (terminated[0], info["success"][0]) == (True, False)
