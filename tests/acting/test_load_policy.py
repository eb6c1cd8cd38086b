"""``load_policy``: decisions in both runtimes, memory, masks, seeds, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from exporter import load_policy
from exporter.acting.policy import LoadedPolicy
from exporter.verify.statistics import FALSE_ALARM, fit
from fixtures import path as fixture
from signatures.errors import BundleError, RuntimeUnavailableError, UsageError
from signatures.roles import Role
from signatures.sampling import draw_cases
from tests.acting.bundles import Bundles

NAMES = ("continuous", "discrete", "sampled", "recurrent", "visual")
Load = Callable[..., LoadedPolicy]


def observed(policy: LoadedPolicy, rows: int = 3, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        s.name: rng.random((rows, *(n or 1 for n in s.shape[1:]))).astype(s.dtype)
        for s in policy.signature.observations
    }


@pytest.mark.parametrize("name", NAMES)
def test_both_runtimes_decide_alike(name: str, bundles: Bundles) -> None:
    decisions = []
    for runtime in ("onnxruntime", "numpy"):
        policy = load_policy(bundles(name), runtime=runtime, seed=3)
        decisions.append(policy.decide(observed(policy)))
    one, other = decisions
    if one.continuous is not None and other.continuous is not None:
        np.testing.assert_allclose(one.continuous, other.continuous, atol=1e-5, rtol=1e-5)
    np.testing.assert_array_equal(one.discrete, other.discrete)


@pytest.mark.parametrize("name", NAMES)
def test_without_chance_it_is_the_deterministic_action(name: str, bundles: Bundles) -> None:
    policy = load_policy(bundles(name))
    decision = policy.decide(observed(policy), deterministic=True)
    np.testing.assert_array_equal(decision.action, decision.outputs["deterministic_action"])
    again = policy.decide(observed(policy), deterministic=True, seed=99)
    np.testing.assert_array_equal(decision.action, again.action)


@pytest.mark.parametrize("runtime", ["onnxruntime", "numpy"])
def test_the_recorded_outputs_come_out(runtime: str, bundles: Bundles) -> None:
    """TensorFlow's own values, from the fixture's archive; four steps with the memory fed back."""
    policy = load_policy(bundles("recurrent"), runtime=runtime)
    with np.load(fixture("recurrent.npz")) as golden:
        memory = golden["step0/in/recurrent_in"]
        for step in range(4):
            given, expected = f"step{step}/in/", f"step{step}/out/"
            decision = policy.decide(
                golden[f"{given}state"],
                masks=golden[f"{given}action_masks"],
                previous=golden[f"{given}prev_action"],
                memory=memory,
            )
            for name in ("action", "recurrent_out"):
                np.testing.assert_allclose(decision.outputs[name], golden[expected + name], atol=1e-5, rtol=1e-5)
            assert decision.memory is not None
            memory = decision.memory


def test_a_single_agent_needs_no_axis(bundles: Bundles) -> None:
    policy = load_policy(bundles("continuous"))
    one = policy.decide(np.zeros(8), deterministic=True)
    batch = policy.decide({"state": np.zeros((1, 8))}, deterministic=True)
    assert one.action.shape == (1, 2)
    np.testing.assert_array_equal(one.action, batch.action)


def test_drawn_actions_have_the_policys_distribution(bundles: Bundles) -> None:
    policy = load_policy(bundles("discrete"), seed=5)
    row = {n: np.repeat(a[:1], 4000, axis=0) for n, a in observed(policy).items()}
    decision = policy.decide(row)
    assert decision.discrete is not None
    scores = decision.outputs["action"][0]
    start = 0
    for column, size in enumerate(policy.signature.branches):
        assert fit(decision.discrete[:, column], scores[start : start + size]) >= FALSE_ALARM
        start += size


@pytest.mark.parametrize("name", ["discrete", "recurrent"])
def test_a_forbidden_action_is_never_taken(name: str, bundles: Bundles) -> None:
    policy = load_policy(bundles(name), seed=6)
    case = next(c for c in draw_cases(policy.signature) if c.name == "all but one action masked")
    observations = {s.name: case.feeds[s.name] for s in policy.signature.observations}
    masks = case.feeds[next(s.name for s in policy.signature.inputs if s.role is Role.MASKS)]
    for deterministic in (True, False):
        decision = policy.decide(observations, masks=masks, deterministic=deterministic)
        assert decision.discrete is not None
        start = 0
        for column, size in enumerate(policy.signature.branches):
            allowed = masks[:, start : start + size].argmax(axis=1)
            np.testing.assert_array_equal(decision.discrete[:, column], allowed)
            start += size


def test_an_agent_threads_memory_and_previous_actions(bundles: Bundles) -> None:
    policy = load_policy(bundles("recurrent"))
    agent = policy.agent(deterministic=True)
    memory = previous = None
    for step in range(4):
        observations = observed(policy, rows=2, seed=step)
        by_agent = agent.decide(observations)
        by_hand = policy.decide(observations, memory=memory, previous=previous, deterministic=True)
        np.testing.assert_array_equal(by_agent.action, by_hand.action)
        assert by_agent.memory is not None
        np.testing.assert_array_equal(by_agent.memory, by_hand.memory)
        memory, previous = by_hand.memory, by_hand.discrete
    assert memory is not None
    assert memory.any()
    agent.reset()
    fresh = agent.decide(observed(policy, rows=2, seed=9))
    np.testing.assert_array_equal(
        fresh.memory, policy.decide(observed(policy, rows=2, seed=9), deterministic=True).memory
    )


def test_a_seed_starts_the_draws_anew(bundles: Bundles) -> None:
    policy = load_policy(bundles("continuous"), seed=1)
    observations = observed(policy)
    first, second = policy.decide(observations).action, policy.decide(observations).action
    assert not np.array_equal(first, second)
    policy.seed(1)
    np.testing.assert_array_equal(policy.decide(observations).action, first)
    np.testing.assert_array_equal(policy.decide(observations, seed=1).action, first)


def test_what_is_missing_or_wrong_is_named(bundles: Bundles) -> None:
    policy = load_policy(bundles("discrete"))
    name = policy.signature.observations[0].name
    for observations, words in (
        ({}, f"'{name}' is missing"),
        ({name: np.zeros((2, 99))}, r"has the shape \[2, 99\]"),
        ({name: observed(policy)[name], "stat": 0}, "no observation 'stat'"),
    ):
        with pytest.raises(UsageError, match=words):
            policy.decide(observations)
    with pytest.raises(UsageError, match="action_masks"):
        policy.decide(observed(policy, rows=2), masks=np.ones((3, sum(policy.signature.branches))))
    with pytest.raises(UsageError, match="observations"):
        load_policy(bundles("visual")).decide(np.zeros(3))  # it has two: which one is this?


def test_what_cannot_be_run_here_is_said(bundles: Bundles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import shutil

    folder = tmp_path / "continuous"
    shutil.copytree(bundles("continuous"), folder)
    with pytest.raises(UsageError, match="runtime='torch'"):
        load_policy(folder, runtime="torch")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert load_policy(folder).runtime == "numpy"
    with pytest.raises(RuntimeUnavailableError, match="onnxruntime is not installed"):
        load_policy(folder, runtime="onnxruntime")
    (folder / "continuous.bytes").unlink()
    with pytest.raises(BundleError, match=r"has no continuous\.bytes"):
        load_policy(folder, runtime="numpy")
    with pytest.raises(BundleError, match="nothing that can be run here"):
        load_policy(folder)
