"""The environments in JavaScript live the lives of those in Python: same seed, same actions, same numbers."""

from __future__ import annotations

import json
import subprocess
from typing import Any

import numpy as np
import pytest

from export_model.converters.runtimes.javascript.node import INSTALL_NODE, node_executable
from export_model.exporter.play.environments import ENVIRONMENTS
from export_model.exporter.serve.site import PAGE

AGENTS, STEPS = 5, 400
#: How many continuous actions.
CONTINUOUS = {"3DBall": 2, "Crawler2D": 8}
PROGRAM = """
import { readFileSync } from "node:fs";
const { file, name, agents, seed, actions } = JSON.parse(readFileSync(0));
const env = new (await import(file))[name](agents);
const lives = [{ observation: env.reset(seed), isFirst: [...env.isFirst] }];
for (const action of actions) lives.push({ ...env.step(action), isFirst: [...env.isFirst] });
console.log(JSON.stringify(lives));
"""


def in_node(name: str, seed: int, actions: list[Any]) -> list[dict[str, Any]]:
    node = node_executable()
    if node is None:
        pytest.skip(f"Node is not installed: {INSTALL_NODE}")
    exported = {"3DBall": "Ball3D"}.get(name, name)
    file = (PAGE / "scenes" / f"{exported.lower()}.mjs").as_uri()
    asked = {"file": file, "name": exported, "agents": AGENTS, "seed": seed, "actions": actions}
    command = [node, "--input-type=module", "-e", PROGRAM]
    done = subprocess.run(command, input=json.dumps(asked), capture_output=True, text=True, check=True)
    lives: list[dict[str, Any]] = json.loads(done.stdout)
    return lives


def drawn(name: str, rng: np.random.Generator) -> tuple[Any, dict[str, Any]]:
    """An action as Python takes it and as JavaScript does; beyond ±1 too, and masked moves."""
    if name in CONTINUOUS:
        both = rng.uniform(-1.3, 1.3, (AGENTS, CONTINUOUS[name]))
        return both, {"continuous": both.tolist()}
    if name == "Tennis":
        left, right = rng.integers(0, 3, (AGENTS, 1)), rng.uniform(-1.5, 1.5, (AGENTS, 1))
        return {"LeftBrain": left, "RightBrain": right}, {"discrete": left.tolist(), "continuous": right.tolist()}
    chosen = rng.integers(0, 4 if name == "GridWorld" else 3, (AGENTS, 1))
    if name == "Hallway":  # mostly forward, or no door is ever reached
        chosen = np.where(rng.random((AGENTS, 1)) < 0.7, 0, chosen)
    return chosen, {"discrete": chosen.tolist()}


def seen(name: str, observation: dict[str, Any]) -> dict[str, np.ndarray]:
    """Python's observation under the names of JavaScript's."""
    names = {"state": "state", "action_masks": "masks", "prev_action": "previous"}
    if name == "Tennis":
        sides = {"left": observation["LeftBrain"], "right": observation["RightBrain"]}
        return {f"{s}.{names[k]}": v for s, part in sides.items() for k, v in part.items() if k in names}
    return {names[k]: v for k, v in observation.items() if k in names}


def flat(observation: dict[str, Any]) -> dict[str, np.ndarray]:
    parts = {}
    for key, value in observation.items():
        parts.update({f"{key}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {key: value})
    return {k: np.array(v) for k, v in parts.items()}


#: Crawler2D's 3,200 substeps once: a seed is a seed.
LIVES = [
    (name, seed) for name in sorted(ENVIRONMENTS) for seed in (2**32 - 1, 0, 2026)[: 1 if name == "Crawler2D" else 3]
]


@pytest.mark.parametrize(("name", "seed"), LIVES)
def test_the_same_seed_and_actions_give_the_same_lives(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    actions = [drawn(name, rng) for _ in range(STEPS)]
    lives = in_node(name, seed, [theirs for _, theirs in actions])
    env = ENVIRONMENTS[name](AGENTS)
    observation, _ = env.reset(seed=seed)
    ends = 0
    for step, (ours, life) in enumerate(zip([None, *(a for a, _ in actions)], lives, strict=True)):
        if ours is not None:
            observation, rewards, terminated, truncated, info = env.step(ours)
            np.testing.assert_array_equal(life["rewards"], rewards, err_msg=f"step {step}")
            for key, value in (("terminated", terminated), ("truncated", truncated), ("success", info["success"])):
                np.testing.assert_array_equal(life[key], value, err_msg=f"{key}, step {step}")
            ends += int((terminated | truncated).sum())
        theirs = flat(life["observation"])
        assert theirs.keys() == seen(name, observation).keys()
        for key, value in seen(name, observation).items():
            # sin and tan are the processor's own business; all else is exact.
            atol = 1e-6 if name == "3DBall" else 0.0
            np.testing.assert_allclose(theirs[key], value, rtol=atol, atol=atol, err_msg=f"{key}, step {step}")
    assert ends > AGENTS, "no episode ended, so no new beginning was compared"
