"""policy.mjs in Node, in TensorFlow.js and onnxruntime-web: it decides what Python decides, seeds included."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.runtimes.javascript.node import js_home, node_executable
from export_model.converters.runtimes.registry import available_runtimes
from export_model.exporter.acting.generator import Generator
from export_model.exporter.acting.policy import Decision, LoadedPolicy
from export_model.signatures.roles import Role
from tests.acting.bundles import Bundles
from tests.acting.test_load_policy import NAMES, observed
from tests.exporting import load_policy

DRIVER = Path(__file__).with_name("drive.mjs")
KINDS = {"tfjs": "tfjs-cpu", "onnx": "onnxruntime-web"}
pytestmark = pytest.mark.slow


def drive(folder: Path, kind: str, requests: list[dict[str, Any]]) -> list[Any]:
    info = next(i for i in available_runtimes() if i.name == KINDS[kind])
    if not info.installed:
        pytest.skip(f"{info.name} is not installed: {info.how}")
    node = node_executable()
    assert node is not None
    command = [node, str(DRIVER), str(js_home()), str(folder), folder.name, kind]
    done = subprocess.run(command, input=json.dumps(requests), capture_output=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr[-2000:]
    answers: list[Any] = json.loads(done.stdout)
    return answers


def listed(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    return {name: array.tolist() for name, array in arrays.items()}


def agrees(answer: Any, decision: Decision) -> None:
    assert "error" not in answer, answer
    if decision.continuous is not None:
        np.testing.assert_allclose(answer["continuous"], decision.continuous, atol=1e-5, rtol=1e-5)
    if decision.discrete is not None:
        np.testing.assert_array_equal(answer["discrete"], decision.discrete)
    if decision.memory is not None:
        kept = np.array(answer["memory"]["data"]).reshape(answer["memory"]["shape"])
        np.testing.assert_allclose(kept, decision.memory, atol=1e-5, rtol=1e-5)


def masks_of(policy: LoadedPolicy, rows: int) -> np.ndarray:
    masks = np.ones((rows, sum(policy.signature.branches)), np.float32)
    masks[:, 0] = 0
    return masks


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_it_decides_as_python_does(name: str, kind: str, bundles: Bundles) -> None:
    folder = bundles(name)
    policy = load_policy(folder)
    rows = 2 if name == "visual" else 5
    observations = observed(policy, rows=rows)
    options: list[dict[str, Any]] = [{"seed": 7}, {"deterministic": True}, {"seed": 2**40 + 3}, {}]
    if policy.signature.has_input("action_masks"):
        options.append({"seed": 8, "masks": masks_of(policy, rows).tolist()})
    answers = drive(folder, kind, [{"observations": listed(observations), "options": o} for o in options])
    for option, answer in zip(options, answers, strict=True):
        agrees(answer, policy.decide(observations, **option))


@pytest.mark.parametrize("kind", KINDS)
def test_an_agent_threads_its_memory(kind: str, bundles: Bundles) -> None:
    folder = bundles("recurrent")
    policy = load_policy(folder)
    episodes = [observed(policy, rows=2, seed=step) for step in range(4)]
    steps = [{"observations": listed(o)} for o in episodes]
    (answers,) = drive(folder, kind, [{"how": "agent", "options": {"deterministic": True}, "steps": steps}])
    agent = policy.agent(deterministic=True)
    for observations, answer in zip(episodes, answers, strict=True):
        agrees(answer, agent.decide(observations))


@pytest.mark.parametrize("seed", [0, 1, 2**31, 2**32, 2**53 - 1])
def test_the_generator_draws_the_same(seed: int, bundles: Bundles) -> None:
    (answer,) = drive(bundles("continuous"), "tfjs", [{"how": "generator", "options": {"seed": seed}}])
    generator = Generator(seed)
    np.testing.assert_array_equal(answer[:5], generator.uniform((5,)))
    np.testing.assert_allclose(answer[5:], generator.normals((5,)), rtol=1e-7)


def test_one_of_several_agents_begins_anew(bundles: Bundles) -> None:
    folder = bundles("recurrent")
    policy = load_policy(folder)
    episodes = [observed(policy, rows=3, seed=step) for step in range(3)]
    steps = [{"observations": listed(o), "reset": [1] if i == 2 else None} for i, o in enumerate(episodes)]
    (answers,) = drive(folder, "tfjs", [{"how": "agent", "options": {"deterministic": True}, "steps": steps}])
    agent = policy.agent(deterministic=True)
    for index, (observations, answer) in enumerate(zip(episodes, answers, strict=True)):
        if index == 2:
            agent.reset([1])
        agrees(answer, agent.decide(observations))


def test_bytes_of_an_image_are_scaled(bundles: Bundles) -> None:
    policy = load_policy(bundles("visual"))
    observations: dict[str, Any] = observed(policy, rows=1)
    name = next(s.name for s in policy.signature.observations if s.role is Role.VISUAL)
    observations[name] = np.random.default_rng(4).integers(0, 256, observations[name].shape, np.uint8)
    given = {**listed(observations), name: {"bytes": observations[name].ravel().tolist()}}
    (answer,) = drive(bundles("visual"), "tfjs", [{"observations": given, "options": {"deterministic": True}}])
    agrees(answer, policy.decide(observations, deterministic=True))


def test_masks_that_forbid_everything_and_masks_for_nothing(bundles: Bundles) -> None:
    policy = load_policy(bundles("discrete"))
    masks = np.ones((1, sum(policy.signature.branches)))
    masks[0, : policy.signature.branches[0]] = 0
    request = {"observations": listed(observed(policy, rows=1)), "options": {"masks": masks.tolist()}}
    (answer,) = drive(bundles("discrete"), "tfjs", [request])
    assert "forbid every action of branch 0 to agent 0" in answer["error"]
    (answer,) = drive(bundles("continuous"), "tfjs", [{"observations": [0.0] * 8, "options": {"masks": [1, 1]}}])
    assert "takes no masks" in answer["error"]


@pytest.mark.parametrize("kind", KINDS)
def test_where_nothing_can_be_drawn_it_says_so(kind: str, bundles: Bundles) -> None:
    """A NaN in the observation: no action at all, not the number -1."""
    width = load_policy(bundles("discrete")).signature.observations[0].shape[1]
    nan = {"state": {"data": [1e39] * (width or 1), "shape": [1, width]}}  # JSON has no NaN; infinities make one
    requests = [{"observations": nan, "options": o} for o in ({"seed": 1}, {})]
    requests.append({"observations": {"state": [0.0] * (width or 1)}, "options": {"parameters": {"gaol": 1}}})
    *empty, unknown = drive(bundles("discrete"), kind, requests)
    for answer in empty:
        assert "nothing can be drawn" in answer.get("error", ""), answer
    assert "unknown parameter 'gaol'" in unknown["error"]


def test_flat_and_nested_numbers_are_one(bundles: Bundles) -> None:
    forms: list[Any] = [[0.5] * 8, [[0.5] * 8], {"state": [0.5] * 8}, {"state": {"data": [0.5] * 8, "shape": [1, 8]}}]
    answers = drive(
        bundles("continuous"), "tfjs", [{"observations": f, "options": {"deterministic": True}} for f in forms]
    )
    assert all(a == answers[0] for a in answers)
    assert "error" not in answers[0]


def test_what_is_missing_or_wrong_is_named(bundles: Bundles) -> None:
    requests: list[tuple[dict[str, Any], str]] = [
        ({"observations": {}}, "the observation 'state' is missing"),
        ({"observations": {"state": [0.0] * 7}}, "'state' has 7 numbers; [agents, 8] is wanted"),
        ({"observations": {"state": [0.0] * 8, "stat": 1}}, "unknown observation 'stat'"),
        ({"observations": {"stat": [0.0] * 8}}, "unknown observation 'stat'"),
        ({"observations": [0.0] * 8, "options": {"seed": -1}}, "the seed is -1"),
        ({"observations": {"state": [[0.0] * 6] * 4}}, "[agents, 8] is wanted"),
        ({"observations": {"state": [[0.0] * 4] * 2}}, "[agents, 8] is wanted"),
        ({"observations": {"state": [[0.0] * 7 + ["0"]]}}, "'state' holds a string"),
        ({"observations": {"state": [[0.0] * 7 + [None]]}}, "'state' holds an object"),
    ]
    answers = drive(bundles("continuous"), "tfjs", [r for r, _ in requests])
    for answer, (_, words) in zip(answers, requests, strict=True):
        assert words in answer["error"]
