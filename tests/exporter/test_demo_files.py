"""``export-model demo --files``: what the pages of the documentation begin with."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from export_model.exporter.demo.files import FILES
from export_model.exporter.play.environments import ENVIRONMENTS
from export_model.exporter.play.environments.tennis import BRAINS, follow_ball
from tests.commands import export_model, files_in, is_refused


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_each_file_is_a_policy_that_is_read(there: Path) -> None:
    ran = export_model("demo", "--files")
    assert (ran.status, ran.err) == (0, "")
    assert [line.split()[0] for line in ran.out.splitlines()] == [*FILES, "next:"]
    assert {f for f in files_in(there) if (there / f).is_file()} == set(FILES)
    kinds = {}
    policies = [name for name in FILES if not name.endswith((".py", ".data"))]
    for name in policies:
        policy, *others = export_model("inspect", name, "--json").json["policies"]
        kinds[name] = policy["name"], bool(policy["memory"])
        assert [p["name"] for p in others] == (["Tennis-RightBrain"] if name == "Tennis.bytes" else [])
    assert len(kinds) == 13
    assert [kinds[name][0] for name in policies[:6]] == [*["3DBall"] * 3, "Hallway", "GridWorld", "Tennis-LeftBrain"]
    assert [name for name, (_, memory) in kinds.items() if memory] == [n for n in policies if "Hallway" in n]
    names = [p["name"] for p in export_model("inspect", "results/first_run", "--json").json["policies"]]
    assert names == ["3DBall", "Hallway"]


def test_it_may_be_run_again_and_overwrites_nothing_else(there: Path) -> None:
    assert export_model("demo", "--files").status == export_model("demo", "--files").status == 0
    (there / "3DBall.nn").write_text("mine")
    (there / "3DBall.bytes").unlink()
    is_refused(export_model("demo", "--files"), "3DBall.nn is another file", "-o names another folder")
    assert (there / "3DBall.nn").read_text() == "mine"
    assert not (there / "3DBall.bytes").exists()  # refused before anything is written
    assert export_model("demo", "--files", "-o", "new").status == 0
    assert {f for f in files_in(there / "new") if (there / "new" / f).is_file()} == set(FILES)


@pytest.mark.skipif(os.name != "posix", reason="links are POSIX's")
@pytest.mark.parametrize("name", ["3DBall.bytes", "results", "results/first_run"])
def test_no_link_is_written_through(name: str, there: Path) -> None:
    kept = there / "kept"
    (there / "out" / name).parent.mkdir(parents=True)
    (there / "out" / name).symlink_to(kept)
    kept.write_text("kept") if name.endswith(".bytes") else kept.mkdir()
    is_refused(export_model("demo", "--files", "-o", "out"), "is another file")
    assert kept.read_text() == "kept" if kept.is_file() else not list(kept.iterdir())


_PLAYS = """
import json, sys, warnings
import gymnasium, environments
from gymnasium.utils.env_checker import check_env

warnings.simplefilter("ignore")
told = {}
for form in environments.FORMS:
    env = gymnasium.make(form)
    check_env(env.unwrapped, skip_render_check=True)
    seen, info = env.reset(seed=5)
    env.action_space.seed(5)
    steps = [[seen.tolist(), info.get("action_mask", env.unwrapped.observation_space.low[:0]).tolist()]]
    actions, rewards, over = [], [], False
    while not over:
        action = env.action_space.sample()
        seen, reward, terminated, truncated, info = env.step(action)
        actions.append(action.tolist())
        rewards.append(reward)
        steps.append([seen.tolist(), info["action_mask"].tolist() if "action_mask" in info else []])
        over = terminated or truncated
    told[form] = [actions, steps, rewards, terminated, info["is_success"]]
assert not [name for name in sys.modules if name.split(".")[0] == "export_model"]
print(json.dumps(told))
"""


def test_other_programs_play_the_same_episodes(there: Path) -> None:
    """Gymnasium's own checker passes; seen, allowed and earned is what the environments of the package give."""
    pytest.importorskip("gymnasium")
    assert export_model("demo", "--files").status == 0
    ran = subprocess.run([sys.executable, "-c", _PLAYS], capture_output=True, text=True, check=True, cwd=there)
    told = json.loads(ran.stdout)
    assert {form.partition("-")[0] for form in told} == set(ENVIRONMENTS)
    for form, (actions, steps, rewards, terminated, success) in told.items():
        name, brain, _ = form.split("-") if form.count("-") > 1 else (form.partition("-")[0], None, "")
        own = ENVIRONMENTS[name](1)
        seen, info = own.reset(seed=5)
        for number, action in enumerate([*actions, None]):
            shown = info.get("final_obs", seen)
            mine = shown if brain is None else shown[brain]
            assert mine["state"][0].tolist() == steps[number][0]
            assert mine.get("action_masks", np.zeros((1, 0)))[0].tolist() == steps[number][1]
            if action is None:
                break
            taken: object = np.reshape(action, (1, -1))
            if brain is not None:
                other = BRAINS[1 - BRAINS.index(brain)]
                taken = {brain: taken, other: follow_ball(other, seen[other])}
            seen, earned, ended, _, info = own.step(taken)
            assert float(np.reshape(earned, -1)[BRAINS.index(brain) if brain else 0]) == rewards[number]
        assert (bool(ended[0]), bool(info["success"][0])) == (terminated, success)
