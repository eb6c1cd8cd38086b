"""Environments with Gymnasium's interface: its own by id, and the user's code, which need not know Gymnasium."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.exporter.play.gymnasium_world import GymnasiumWorld, own_maker
from export_model.exporter.play.options import PlayOptions
from export_model.exporter.verify.options import VerifyOptions
from export_model.exporter.verify.plays import EQUIVALENT
from export_model.signatures.errors import UsageError
from fixtures import gym
from fixtures import path as fixture
from tests.commands import export_model, is_refused
from tests.play.conftest import FEW, Play

ONE = VerifyOptions(runtimes="onnxruntime")
INSTALLED = importlib.util.find_spec("gymnasium") is not None
needs_gymnasium = pytest.mark.skipif(not INSTALLED, reason="Gymnasium is not installed: pip install gymnasium")


@needs_gymnasium
@pytest.mark.filterwarnings("ignore")  # of Gymnasium, on its own environments
@pytest.mark.parametrize("env", gym.ENVIRONMENTS)
def test_trained_policies_play_as_their_reference(env: str, play: Play) -> None:
    if env == "InvertedPendulum-v5" and importlib.util.find_spec("mujoco") is None:
        pytest.skip("MuJoCo is not installed: pip install mujoco imageio")
    report = play(gym.path(env), env, options=PlayOptions(FEW), judging=ONE)
    assert report.passed is True, report.sentence
    assert [p.compared.verdict for p in report.played] == [EQUIVALENT]
    said = gym.report()[env]
    # A mean of 20 episodes beside one of 100.
    assert report.episodes.returns.mean() == pytest.approx(said["return"], abs=1 + said["deviation"])


@needs_gymnasium
def test_returns_are_those_of_the_environment_played_by_hand(play: Play) -> None:
    """An oracle of its own: onnxruntime's session and Gymnasium's loop."""
    import gymnasium
    import onnxruntime

    report = play(gym.path("Pendulum-v1"), "Pendulum-v1", options=PlayOptions(FEW, 3), judging=ONE)
    session = onnxruntime.InferenceSession(str(gym.path("Pendulum-v1")), providers=["CPUExecutionProvider"])
    own = int(np.random.SeedSequence((3, 0)).generate_state(1)[0])
    seeds = np.random.SeedSequence(own).generate_state(FEW) >> np.uint32(1)
    env = gymnasium.make("Pendulum-v1")
    for row in (0, 1, FEW - 1):
        observation, _ = env.reset(seed=int(seeds[row]))
        total, over = 0.0, False
        while not over:
            (action,) = session.run(["action"], {"obs": observation[None]})
            observation, reward, terminated, truncated, _ = env.step(np.clip(action[0], -2, 2))
            total, over = total + float(reward), terminated or truncated
        assert report.episodes.returns[row] == pytest.approx(total, rel=1e-9)


@needs_gymnasium
def test_what_gymnasium_lacks_or_does_not_fit_is_refused() -> None:
    is_refused(export_model("play", gym.path("CartPole-v1"), "--env", "CartPole-v99"), "unknown environment")
    ran = export_model("play", gym.path("CartPole-v1"), "--env", "Acrobot-v1")
    is_refused(ran, "the policy does not fit the environment")
    assert "Discrete(3)" in ran.err and "branches [2]" in ran.err
    ran = export_model("play", gym.path("Pendulum-v1"), "--env", "MountainCarContinuous-v0")
    is_refused(ran, "the policy does not fit the environment")
    assert "'state' [B, 3]" in ran.err


def test_without_gymnasium_its_ids_are_unknown_with_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    ran = export_model("play", gym.path("CartPole-v1"), "--env", "CartPole-v1")
    is_refused(ran, "unknown environment")
    assert "export-model[gym]" in ran.err


# ------------------------------------------------------------------ the user's own code

OWN = '''
"""A game of one's own: go to the sign that is shown. Without Gymnasium."""

import numpy as np


class Box:
    def __init__(self, size):
        self.shape, self.low, self.high, self.dtype = (size,), -1.0, 1.0, np.float32


class Follow:
    action_space = Box(2)

    def reset(self, seed=None):
        self.rng, self.left = np.random.default_rng(seed), 5
        return self.look(), {}

    def look(self):
        self.sign = self.rng.normal(size=8)
        return self.sign

    def step(self, action):
        assert action.dtype == np.float32 and action.shape == (2,) and abs(action).max() <= 1
        self.left -= 1
        return self.look(), float(action @ self.sign[:2]), False, self.left == 0, {"is_success": True}


class Raising(Follow):
    def step(self, action):
        raise RuntimeError("the motor is off")


number = 3
'''


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The user's module, in the current folder."""
    (tmp_path / "own_game.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "own_game", raising=False)
    return "own_game"


def test_code_of_the_users_own_plays_and_is_said_to_be(own: str) -> None:
    where = ("--runtimes", "onnxruntime", "--episodes", FEW)
    ran = export_model("play", fixture("continuous"), "--env", f"{own}:Follow", *where)
    assert ran.status == 0, ran.err
    assert f"the environment {own}:Follow is your own code; it ran in this process" in ran.out
    assert "EQUIVALENT" in ran.out.splitlines()[-1]
    told = export_model("play", fixture("continuous"), "--env", f"{own}:Follow", *where, "--json").json
    assert told["reference"]["success_rate"] == 1 and told["reference"]["mean_length"] == 5


@pytest.mark.parametrize(
    ("env", "says"),
    [
        ("own_game:Raising", "step failed"),
        ("own_game:nothing", "has no function 'nothing'"),
        ("own_game:number", "has no function 'number'"),
        ("no_such_module:make", "importing it failed"),
    ],
)
def test_what_goes_wrong_in_it_is_said_to_be_there(env: str, says: str, own: str) -> None:
    ran = export_model("play", fixture("continuous"), "--env", env, "--runtimes", "onnxruntime")
    is_refused(ran, says)


def test_a_file_of_the_current_folder_takes_no_modules_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "quopri.py").write_text("make = 'of the current folder'")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    monkeypatch.delitem(sys.modules, "quopri", raising=False)
    with pytest.raises(UsageError, match="has no function 'make'"):
        own_maker("quopri:make")
    assert Path(sys.modules["quopri"].__file__ or "").parent != tmp_path


# ------------------------------------------------------------------ observations, masks, actions


class Space:
    def __init__(self, **facts: Any) -> None:
        self.__dict__.update(facts)


class Told:
    """An environment that gives what it is told, and keeps what it is given."""

    def __init__(self, seen: Any, info: dict[str, Any], space: Space) -> None:
        self.seen, self.info, self.action_space = seen, info, space
        self.actions: list[Any] = []

    def reset(self, seed: int) -> tuple[Any, dict[str, Any]]:
        return self.seen, self.info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.actions.append(action)
        return self.seen, 1.0, False, True, self.info


def signature_of(name: str) -> Any:
    from tests.exporting import inspect_model

    return inspect_model(fixture(name)).policies[0].policy.signature


@pytest.mark.parametrize(
    "seen",
    [
        np.arange(6.0),
        np.arange(6.0).reshape(2, 3),
        {"state": np.arange(6.0), "other": np.zeros(3)},
        {"anything": np.arange(6.0)},
        {"anything": np.arange(6.0), "action_mask": np.array([1, 1, 0, 1, 1])},
    ],
)
def test_observations_are_found_by_name_or_by_being_the_only_one(seen: Any) -> None:
    signature = signature_of("recurrent")
    (name,) = (s.name for s in signature.observations)
    seen = {name if k == "state" else k: v for k, v in seen.items()} if isinstance(seen, dict) else seen
    space = Space(nvec=np.array(signature.branches))
    made: list[Told] = []

    def make() -> Told:
        made.append(Told(seen, {"action_mask": np.array([1, 1, 0, 1, 1])}, space))
        return made[-1]

    world = GymnasiumWorld("told", make, signature)
    view = world.begin(3, 0)
    np.testing.assert_array_equal(view.observations[name], np.tile(np.arange(6.0), (3, 1)))
    assert view.masks is not None and view.masks.tolist() == [[1, 1, 0, 1, 1]] * 3
    after = world.step(None, np.array([[1, 0], [0, 1], [2, 1]]))
    assert [e.actions[0].tolist() for e in made] == [[1, 0], [0, 1], [2, 1]]
    assert after.ended.all() and after.rewards.tolist() == [1, 1, 1]
    # An episode that has ended is left alone.
    world.step(None, np.zeros((3, 2), np.int64))
    assert all(len(e.actions) == 1 for e in made)


@pytest.mark.parametrize(
    ("seen", "info", "says"),
    [
        (np.zeros(5), {"action_mask": np.ones(5)}, "the environment gives"),
        ({"a": np.zeros(6), "b": np.zeros(6)}, {"action_mask": np.ones(5)}, "the environment gives a [6], b [6]"),
        (np.zeros(6), {}, "gives none"),
    ],
)
def test_what_does_not_fit_is_refused(seen: Any, info: dict[str, Any], says: str) -> None:
    signature = signature_of("recurrent")
    space = Space(nvec=np.array(signature.branches))
    with pytest.raises(UsageError) as raised:
        GymnasiumWorld("told", lambda: Told(seen, info, space), signature)
    assert says in raised.value.message


def test_a_number_is_a_vector_with_a_1_and_a_box_is_clipped() -> None:
    signature = signature_of("continuous")
    space = Space(shape=(2,), low=np.array([-0.5, -0.5]), high=np.array([0.5, 0.5]), dtype=np.dtype(np.float32))
    told = Told(np.int64(3), {}, space)
    world = GymnasiumWorld("told", lambda: told, signature)
    view = world.begin(1, 0)
    assert view.observations["state"].tolist() == [[0, 0, 0, 1, 0, 0, 0, 0]]
    world.step(np.array([[2.0, -0.1]], np.float32), None)
    np.testing.assert_allclose(told.actions[0], [0.5, -0.1])
    with pytest.raises(UsageError, match="does not fit"):
        GymnasiumWorld("told", lambda: Told(np.int64(8), {}, space), signature)


def test_choices_begin_where_the_space_says() -> None:
    from tests.exporting import inspect_model

    signature = inspect_model(gym.path("CartPole-v1")).policies[0].policy.signature
    told = Told(np.zeros(4), {}, Space(n=2, start=5))
    world = GymnasiumWorld("told", lambda: told, signature)
    world.begin(1, 0)
    world.step(None, np.array([[1]]))
    assert told.actions == [6]
