"""``snippets --for recorder``: what is recorded by the printed code is a log that ``verify --log`` reads and judges."""

from __future__ import annotations

import subprocess
import sys
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.runtimes.csharp import tools
from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.logs.check import check_log
from export_model.exporter.snippets.contract import read_bundle
from export_model.exporter.snippets.registry import snippets
from export_model.signatures.roles import Role
from tests.commands import ROOT
from tests.exporting import load_policy

TRAINED = ROOT / "fixtures" / "trained"
EPISODES, LENGTH = 4, 25
Array = np.ndarray


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    for name in ("3DBall", "GridWorld"):
        list(export([TRAINED / name], ExportOptions(folder, ("bytes",), verify="none")))
    return folder


def code_of(out: Path, name: str, target: str) -> str:
    ((made,), _) = snippets(read_bundle(out / name), target)
    return made.code


class Acting:
    """A policy as an agent's code runs it: ``decide`` is given what it sees, changed by a fault."""

    def __init__(self, folder: Path, factor: float = 1.0) -> None:
        self.policy: LoadedPolicy = load_policy(folder, runtime="numpy")
        (self.spec,) = self.policy.signature.observations
        self.masks = next((s for s in self.policy.signature.inputs if s.role is Role.MASKS), None)
        self.factor = np.ones(self.spec.shape[-1] or 1, np.float32)
        self.factor[1] = factor
        self.rng = np.random.default_rng(0)

    def look(self, rows: int = 1) -> Array:
        return self.rng.normal(0, 0.4, (rows, len(self.factor))).astype(np.float32)

    def allowed(self, rows: int = 1) -> Array:
        masks = np.ones((rows, (self.masks.shape[-1] if self.masks else 0) or 0), np.float32)
        if masks.size:
            masks[:, self.rng.integers(masks.shape[1])] = 0
        return masks

    def decide(self, seen: Array, masks: Array) -> Array:
        given = None if self.masks is None else masks
        return self.policy.decide(seen * self.factor, masks=given, deterministic=True).action

    def check(self, log: Path) -> None:
        """Fits where nothing is wrong, else is explained by the sign of column 1."""
        report = check_log(self.policy, log)
        assert (report.steps, report.episodes) == (EPISODES * LENGTH, EPISODES)
        if self.factor[1] == 1:
            assert report.fits
        else:
            assert [(c.kind, c.where) for c in report.causes] == [("unit", f"{self.spec.name}[1]")]


def modules(monkeypatch: pytest.MonkeyPatch, **made: dict[str, Any]) -> None:
    for name, content in made.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name.replace("_in_", "."), module)


def run_code(code: str) -> dict[str, Any]:
    names: dict[str, Any] = {"__name__": "recorder"}
    exec(compile(code, "recorder", "exec"), names)
    return names


each = pytest.mark.parametrize(("name", "factor"), [("3DBall", 1.0), ("3DBall", -1.0), ("GridWorld", 1.0)])


@each
def test_a_gymnasium_environment_is_recorded(name: str, factor: float, out: Path, tmp_path: Path) -> None:
    gymnasium = pytest.importorskip("gymnasium")
    acting = Acting(out / name, factor)

    class World(gymnasium.Env):  # type: ignore[misc, name-defined]
        def reset(self, *, seed: int | None = None, options: object = None) -> tuple[Array, dict[str, Any]]:
            self.age = 0
            return self.look()

        def look(self) -> tuple[Array, dict[str, Any]]:
            self.masks = acting.allowed()
            return acting.look()[0], {"action_mask": self.masks[0]}

        def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
            self.age += 1
            seen, info = self.look()
            return seen, 0.0, False, self.age == LENGTH, info

    env = run_code(code_of(out, name, "recorder-gymnasium"))["Recorder"](World())
    for _ in range(EPISODES):
        seen, info = env.reset(seed=1)
        ended = False
        while not ended:
            action = acting.decide(seen[None], info["action_mask"][None])[0]
            seen, _, _, ended, info = env.step(int(action[0]) if acting.masks else action)
    env.save(str(tmp_path / "run.npz"))
    acting.check(tmp_path / "run.npz")


@pytest.mark.parametrize("factor", [1.0, -1.0])
def test_a_controllers_topics_are_recorded(
    factor: float, out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Node:
        def __init__(self, name: str) -> None:
            self.topics: dict[str, Callable[[Any], None]] = {}

        def create_subscription(self, kind: object, topic: str, called: Callable[[Any], None], depth: int) -> None:
            self.topics[topic] = called

    kinds = {n: type(n, (), {}) for n in ("Empty", "Float32MultiArray", "Int32MultiArray")}
    modules(monkeypatch, rclpy={}, rclpy_in_node={"Node": Node}, std_msgs={}, std_msgs_in_msg=kinds)
    acting = Acting(out / "3DBall", factor)
    recorder = run_code(code_of(out, "3DBall", "recorder-ros2"))["Recorder"]()
    for _ in range(EPISODES):
        recorder.topics["episode"](kinds["Empty"]())
        for _ in range(LENGTH):
            seen = acting.look()
            action = acting.decide(seen, acting.allowed())
            recorder.topics["state"](types.SimpleNamespace(data=seen[0].tolist()))
            recorder.topics["action"](types.SimpleNamespace(data=action[0].tolist()))
    recorder.save(str(tmp_path / "run.npz"))
    acting.check(tmp_path / "run.npz")


@pytest.mark.parametrize("grouped", [True, False])
def test_environments_of_isaac_lab_are_recorded(grouped: bool, out: Path, tmp_path: Path) -> None:
    class Tensor:
        def __init__(self, array: Array) -> None:
            self.array = array

        def detach(self) -> Tensor:
            return self

        cpu = detach

        def numpy(self) -> Array:
            return self.array

    acting, envs = Acting(out / "3DBall"), EPISODES // 2
    recorder = run_code(code_of(out, "3DBall", "recorder-isaac-lab"))["Recorder"](envs)
    for step in range(2 * LENGTH):
        seen = acting.look(envs)
        action = acting.decide(seen, acting.allowed(envs))
        dones = np.full(envs, (step + 1) % LENGTH == 0)
        recorder.add({"policy": Tensor(seen)} if grouped else Tensor(seen), Tensor(action), Tensor(dones))
    recorder.save(str(tmp_path / "run.npz"))
    acting.check(tmp_path / "run.npz")


_MAIN = """
class Program
{{
    static void Main()
    {{
        var agent = new Unity.MLAgents.Agent();
        UnityEngine.MonoBehaviour.There = agent;
        var recorder = new {type}();
        var own = System.Reflection.BindingFlags.NonPublic | System.Reflection.BindingFlags.Instance;
        typeof({type}).GetMethod("Awake", own).Invoke(recorder, null);
{steps}
        typeof({type}).GetMethod("OnDestroy", own).Invoke(recorder, null);
    }}
}}
"""


@each
def test_an_agent_of_unity_is_recorded(name: str, factor: float, out: Path, tmp_path: Path) -> None:
    """Compiled and run by Mono with stubs of Unity; between decisions the action of the decision before comes again."""
    found = tools()
    if found is None:
        pytest.skip("mono is not installed")
    acting, code = Acting(out / name, factor), code_of(out, name, "recorder-unity")
    steps = []
    for row in range(EPISODES * LENGTH):
        seen, masks = acting.look(), acting.allowed()
        action = acting.decide(seen, masks)[0]
        steps.append(f"agent.Seen = new[] {{ {', '.join(f'{x!r}f' for x in seen[0].tolist())} }};")
        steps.append(f"agent.Episodes = {row // LENGTH}; recorder.Observed();")
        steps += [f"recorder.Forbid(0, {i});" for i in np.flatnonzero(masks[0] == 0)] if acting.masks else []
        continuous, discrete = ("", action.tolist()) if acting.masks else ([f"{x!r}f" for x in action.tolist()], "")
        given = f"new float[] {{ {', '.join(continuous)} }}, new int[] {{ {', '.join(map(str, discrete))} }}"
        steps += [f"recorder.Acted(new Unity.MLAgents.Actuators.ActionBuffers({given}));"] * (1 + row % 2)
    (tmp_path / "recorder.cs").write_text(code)
    kind = code.split("public class ")[1].split()[0]
    main = _MAIN.format(type=kind, steps="\n".join(f"        {s}" for s in steps))
    (tmp_path / "main.cs").write_text(main)
    mcs, mono = found
    stubs = str(Path(__file__).parent / "stubs" / "ml_agents.cs")
    command = [mcs, "-langversion:7", "-warnaserror", "-nowarn:0649", "-out:main.exe", "main.cs", "recorder.cs", stubs]
    subprocess.run(command, check=True, cwd=tmp_path)
    subprocess.run([mono, "main.exe"], check=True, cwd=tmp_path)
    acting.check(tmp_path / "run.jsonl")
