"""The exported policies play as well as they were trained to, and the same in every format."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from export_model.exporter.play.environments import ENVIRONMENTS
from fixtures import trained
from fixtures.evaluate import Player, Score, play
from fixtures.goldens import read_npz
from fixtures.trained import TRAINED, weights_file
from fixtures.trained.forward import policy
from fixtures.trained.scores import EPISODES, SEED, decide, rally
from tests.trained.conftest import Array, Stage

REPORT = trained.report()["policies"]
#: share of the episodes, of the length or of the rallies that must be reached
ENOUGH = 0.95
FORMATS = [
    ("bytes", "numpy"),
    ("bytes", "tensorflow"),
    ("saved_model", "tensorflow"),
    ("tfjs", "tfjs-cpu"),
    ("onnx", "onnxruntime"),
]
#: What scores can differ by from one machine or runtime to the next. In Tennis, as on a billiard table, a difference in
#: the last bit is another rally after some returns; a crawler's steps part in the same way, and its pace stays.
NOISE = {"3DBall": 0.01, "GridWorld": 0.01, "Hallway": 0.01, "Tennis": 0.15, "Crawler2D": 0.02}
STEADY = ("3DBall", "GridWorld", "Hallway")


def by_onnx(stage: Stage, name: str, seed: int = SEED, **how: Any) -> Score:
    return play(ENVIRONMENTS[name](EPISODES), stage.decide(name, **how), seed=seed)


def test_3dball_stays_on_the_platform(stage: Stage) -> None:
    score = stage.score("3DBall")
    assert score.mean_length >= ENOUGH * 1000
    assert score.mean_return >= ENOUGH * 100


def test_gridworld_is_solved_and_no_forbidden_action_is_taken(stage: Stage) -> None:
    score = stage.score("GridWorld")
    assert score.success_rate >= ENOUGH
    assert score.forbidden == 0


def test_hallway_is_solved_and_without_memory_it_is_a_guess(stage: Stage) -> None:
    assert stage.score("Hallway").success_rate >= ENOUGH
    # 100 guesses: a share beyond these bounds has a probability of 1e-4.
    assert 0.3 <= by_onnx(stage, "Hallway", forgetful=True).success_rate <= 0.7
    assert 0.3 <= REPORT["Hallway"]["trained without memory, drawn"]["success"] <= 0.7


def test_tennis_keeps_the_ball_in_play(stage: Stage) -> None:
    score = stage.score("Tennis")
    assert rally(score) >= 20  # of 25
    assert score.forbidden == 0


def test_a_crawler_walks_at_its_pace(stage: Stage) -> None:
    score = stage.score("Crawler2D")
    assert score.success_rate >= ENOUGH
    assert score.mean_return >= 35  # of 40; 0 for standing still


@pytest.mark.parametrize("name", TRAINED)
def test_other_episodes_go_as_well(stage: Stage, name: str) -> None:
    score = by_onnx(stage, name, seed=SEED + 1)
    assert score.success_rate >= REPORT[name]["deterministic"]["success"] - 0.1


@pytest.mark.parametrize("name", TRAINED)
def test_the_report_is_what_the_weights_and_the_exported_policy_reach(stage: Stage, name: str) -> None:
    said = REPORT[name]["deterministic"]
    in_numpy = play(ENVIRONMENTS[name](EPISODES), decide(name, read_npz(weights_file(name))), seed=SEED)
    for score in (in_numpy, stage.score(name)):
        assert score.success_rate == pytest.approx(said["success"], abs=NOISE[name])
        assert score.mean_return == pytest.approx(said["return"], abs=NOISE[name] * max(1.0, abs(said["return"])))


@pytest.mark.parametrize("name", TRAINED)
def test_drawn_actions_play_too_and_none_is_forbidden(stage: Stage, name: str) -> None:
    score = by_onnx(stage, name, chance=np.random.default_rng(5))
    assert score.success_rate >= REPORT[name]["drawn"]["success"] - 0.15
    assert score.forbidden == 0


def test_drawn_actions_are_not_the_deterministic_ones(stage: Stage) -> None:
    drawn = by_onnx(stage, "GridWorld", chance=np.random.default_rng(5))
    first = stage.score("GridWorld").actions[0]
    assert 0 < (drawn.actions[0] != first).mean() < 0.5


def by_brain(actions: Any) -> Mapping[str, Array]:
    return actions if isinstance(actions, Mapping) else {"": actions}


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINED)
def test_every_format_decides_the_same_in_every_step(stage: Stage, name: str) -> None:
    """One plays, the others say what they would do."""
    others = {f"{kind} in {runtime}": stage.decide(name, kind, runtime) for kind, runtime in FORMATS[1:]}
    player = stage.decide(name, *FORMATS[0])

    def compared(observation: dict[str, Any]) -> Any:
        taken = player(observation)
        for where, decide_there in others.items():
            actions = by_brain(decide_there(observation))
            for brain, expected in by_brain(taken).items():
                assert actions[brain].dtype == expected.dtype
                np.testing.assert_allclose(actions[brain], expected, atol=1e-5, err_msg=f"{where} {brain}")
        return taken

    play(ENVIRONMENTS[name](6), compared, seed=3)


@pytest.mark.slow
@pytest.mark.parametrize("name", STEADY)
def test_every_format_plays_the_same_episodes(stage: Stage, name: str) -> None:
    """What one step rounds off, the next one sees: a policy that steers keeps it from growing."""
    scores = [play(ENVIRONMENTS[name](6), stage.decide(name, kind, runtime), seed=3) for kind, runtime in FORMATS]
    for (kind, runtime), score in zip(FORMATS, scores, strict=True):
        where = f"{kind} in {runtime}"
        assert np.array_equal(score.success, scores[0].success), where
        assert np.array_equal(score.lengths, scores[0].lengths), where
        np.testing.assert_allclose(score.returns, scores[0].returns, atol=1e-9, err_msg=where)
        for actions, expected in zip(score.actions, scores[0].actions, strict=True):
            np.testing.assert_allclose(actions, expected, atol=1e-4, err_msg=where)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "runtime"), FORMATS[:-1])
def test_every_format_plays_tennis_as_well(stage: Stage, kind: str, runtime: str) -> None:
    score = play(ENVIRONMENTS["Tennis"](EPISODES), stage.decide("Tennis", kind, runtime), seed=SEED)
    assert rally(score) == pytest.approx(rally(stage.score("Tennis")), abs=3.0)


def test_a_player_begins_with_no_memory_of_the_episode_before() -> None:
    run, contract = policy(read_npz(weights_file("Hallway")))
    environment = ENVIRONMENTS["Hallway"](5)
    memories: list[Array] = []

    def recorded(feeds: Mapping[str, Array], fetch: Sequence[str]) -> Mapping[str, Array]:
        memories.append(feeds["recurrent_in"])
        return run(feeds, fetch)

    player = Player(recorded, contract)
    observation, _ = environment.reset(seed=4)
    firsts = []
    for _ in range(30):
        firsts.append(observation["is_first"])
        observation, *_ = environment.step(player(observation))
    memory, first = np.stack(memories), np.stack(firsts)
    assert first.sum() > 10
    assert not memory[first].any()
    assert memory[~first].any(1).all()
