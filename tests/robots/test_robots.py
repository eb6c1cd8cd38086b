"""``--for isaac-lab`` and ``--for godot-rl``: files that those projects' loaders take, and that act as the original.

Oracles: what the trainers' own modules answered (../shared/foreign), onnxruntime, and the loaders' lines done again:
``OrtRunner`` multiplies lengths and takes the first output, sync.gd looks for the largest number above 0.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given
from hypothesis import strategies as st

import export_model as public
from export_model.converters.consumers.profiles import PROFILES, profile
from export_model.converters.consumers.robots.interface import FileInterface, FileTensor, interface_of
from export_model.converters.consumers.robots.loaders import LOADERS
from export_model.exporter.verify.checks.consumer import consumers
from export_model.signatures.contract import parse_signature
from export_model.signatures.errors import ProfileError, UsageError
from fixtures import path as fixture
from tests.commands import export_model as command
from tests.commands import is_refused
from tests.exporting import export_model, load_policy, verify_bundle
from tests.known import ABSENT, SHARED

pytestmark = pytest.mark.xdist_group("robots")

FOREIGN = SHARED / "foreign"
needs_shared = pytest.mark.skipif(not FOREIGN.is_dir(), reason=ABSENT)
ISAAC = ["rsl_mlp__legacy_fixed", "rsl_gru_1l__dynamo_fixed", "rsl_lstm_1l__dynamo_fixed"]
GODOT = ["sb3_ppo_mlp_box__legacy_dyn", "sb3_ppo_mlp_disc__dynamo_fixed", "sb3_ppo_mlp_multi__legacy_fixed"]


def session_of(path: Path) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


def rows_of(name: str) -> list[tuple[dict[str, np.ndarray], list[np.ndarray]]]:
    """(inputs of one agent, the original module's answers), row by row; states have their rows on the second axis."""
    recorded = np.load(FOREIGN / f"{name}.npz")
    found: dict[str, dict[str, np.ndarray]] = {}
    for key in recorded:
        number, label, side, what = key.split("|")
        if label not in ("big",):
            found.setdefault(number, {})[f"{side}|{what}"] = recorded[key]
    rows = []
    for case in found.values():
        count = len(next(a for k, a in case.items() if k.startswith("in|") and a.ndim < 3))
        for i in range(count):
            one = {k: a[:, i : i + 1] if a.ndim == 3 else a[i : i + 1] for k, a in case.items()}
            fed = {k[3:]: a for k, a in one.items() if k.startswith("in|")}
            rows.append((fed, [one[f"out|{n}"] for n in range(sum(k.startswith("out|") for k in one))]))
    return rows


Export = Callable[[str, str], Path]


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Export:
    """Export a foreign policy for a consumer, verified in onnxruntime, once; return its .onnx."""

    @cache
    def made(name: str, consumer: str) -> Path:
        out = tmp_path_factory.mktemp(consumer)
        (result,) = export_model(FOREIGN / f"{name}.onnx", out, for_=consumer, verify="onnxruntime")
        assert result.passed, result.report
        assert result.report is not None and result.report.original == "onnxruntime"
        return result.folder / f"{result.policy.name}.onnx"

    return made


@needs_shared
@pytest.mark.parametrize("name", ISAAC)
def test_a_robot_that_runs_the_file_as_unitree_does_gets_the_modules_own_actions(name: str, export: Export) -> None:
    session = session_of(export(name, "isaac-lab"))
    shapes = {i.name: i.shape for i in session.get_inputs()}
    assert all(isinstance(d, int) for dims in shapes.values() for d in dims)
    original = json.loads((FOREIGN / f"{name}.json").read_text())
    assert list(shapes) == original["onnx_inputs"]
    assert [o.name for o in session.get_outputs()] == original["onnx_outputs"]
    for fed, wanted in rows_of(name):
        feeds = {n: fed[n].reshape(-1)[: math.prod(dims)].reshape(dims) for n, dims in shapes.items()}
        for got, want in zip(session.run(None, feeds), wanted, strict=True):
            assert got.shape == want.shape
            np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-4)


@needs_shared
@pytest.mark.parametrize("name", ISAAC[1:])
def test_its_states_are_fed_back_as_the_original_feeds_them(name: str, export: Export) -> None:
    ours, theirs = session_of(export(name, "isaac-lab")), session_of(FOREIGN / f"{name}.onnx")
    states = {i.name: np.zeros(i.shape, np.float32) for i in ours.get_inputs() if i.name != "obs"}
    memory = [dict(states), dict(states)]
    rng = np.random.default_rng(1)
    agent = load_policy(export(name, "isaac-lab").parent).agent()
    for _ in range(6):
        obs = rng.standard_normal((1, 12)).astype(np.float32)
        answers = []
        for number, session in enumerate((ours, theirs)):
            given = dict(
                zip(
                    [o.name for o in session.get_outputs()],
                    session.run(None, {"obs": obs, **memory[number]}),
                    strict=True,
                )
            )
            answers.append(given["actions"])
            memory[number] = {n: given[n.replace("_in", "_out")] for n in states}
        np.testing.assert_allclose(answers[0], answers[1], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(agent.decide(obs).action, answers[1], rtol=1e-5, atol=1e-5)


@needs_shared
@pytest.mark.parametrize("name", GODOT)
def test_what_sync_gd_makes_of_the_file_is_what_the_module_decides(name: str, export: Export) -> None:
    session = session_of(export(name, "godot-rl"))
    branches = json.loads((export(name, "godot-rl").parent / "policy.json").read_text())["branches"]
    for fed, wanted in rows_of(name):
        (obs,) = fed.values()
        output, state = session.run(["output", "state_outs"], {"obs": obs, "state_ins": np.ones(1, np.float32)})
        assert state.tolist() == [1.0]
        if not branches:
            np.testing.assert_allclose(output, wanted[0], rtol=1e-4, atol=1e-4)
            continue
        assert session.get_outputs()[0].shape[1] == sum(branches)
        assert _decide(output[0].tolist(), branches) == wanted[0].reshape(-1).tolist()


def _decide(numbers: list[float], sizes: list[int]) -> list[int]:
    """As sync.gd's _extract_action_dict: it begins to look at 0.0, so that no number below is ever taken."""
    found, index = [], 0
    for size in sizes:
        largest, best = 0.0, 0
        for number in range(size):
            if numbers[index + number] > largest:
                largest, best = numbers[index + number], number
        found.append(best)
        index += size
    return found


@pytest.mark.parametrize("consumer", ["isaac-lab", "godot-rl"])
def test_the_mean_of_an_ml_agents_policy_is_what_its_graph_gives_without_noise(consumer: str, tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, for_=consumer, verify="none")
    own = load_policy(fixture("continuous"), runtime="numpy")
    (obs,) = own.signature.observations
    fed = np.random.default_rng(2).standard_normal((1, obs.shape[-1] or 0)).astype(np.float32)
    feeds = {"obs": fed, **({"state_ins": np.zeros(1, np.float32)} if consumer == "godot-rl" else {})}
    got = session_of(result.folder / "continuous.onnx").run(None, feeds)[0]
    np.testing.assert_allclose(got, own.decide(fed, deterministic=True).action, rtol=1e-5, atol=1e-5)


@needs_shared
@pytest.mark.parametrize(("name", "consumer"), [*((n, "isaac-lab") for n in ISAAC), *((n, "godot-rl") for n in GODOT)])
def test_the_file_read_back_is_the_policy_again(name: str, consumer: str, export: Export, tmp_path: Path) -> None:
    made = export(name, consumer)
    (again,) = export_model(made, tmp_path, to="onnx", verify="onnxruntime")
    assert again.passed
    whole = load_policy(FOREIGN / f"{name}.onnx").signature
    signature = again.policy.signature
    assert [s.name for s in signature.inputs] == [s.name for s in whole.inputs]
    assert signature.memory == whole.memory
    assert not [n for n in signature.notes if n.startswith("made for batches")]
    policies = [load_policy(p) for p in (again.folder, FOREIGN / f"{name}.onnx")]
    fed = np.random.default_rng(3).standard_normal((4, whole.observations[0].shape[-1] or 0)).astype(np.float32)
    decided = [p.decide(fed, deterministic=True).action for p in policies]
    np.testing.assert_allclose(decided[0], decided[1], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("source", "consumer", "words"),
    [
        ("discrete", "isaac-lab", "not continuous alone"),
        ("visual", "isaac-lab", "the loader feeds one row of numbers"),
        ("recurrent", "godot-rl", "state_ins at every step"),
        ("visual", "godot-rl", "the loader feeds one row of numbers"),
    ],
)
def test_what_a_loader_cannot_run_is_refused_with_its_reason(
    source: str, consumer: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(ProfileError, match="cannot be made for") as refused:
        export_model(fixture(source), tmp_path, for_=consumer, verify="none")
    assert words in f"{refused.value} {refused.value.why}"
    assert not any(tmp_path.iterdir())


@needs_shared
def test_two_layers_of_memory_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match="of 2 layers"):
        export_model(FOREIGN / "rsl_lstm_2l__legacy_fixed.onnx", tmp_path, for_="isaac-lab", verify="none")


#: What breaks one rule of a loader: a change of the ONNX, and words of the rule.
CHANGES: Mapping[str, tuple[str, Any, str]] = {
    "another input": ("isaac-lab", lambda m: setattr(m.graph.input[0], "name", "state"), "the inputs are obs"),
    "another output": ("isaac-lab", lambda m: setattr(m.graph.output[0], "name", "action"), "the outputs are actions"),
    "a free length": (
        "isaac-lab",
        lambda m: setattr(m.graph.input[0].type.tensor_type.shape.dim[0], "dim_param", "batch"),
        "every length is fixed",
    ),
    "float64": ("isaac-lab", lambda m: setattr(m.graph.input[0].type.tensor_type, "elem_type", 11), "all are float32"),
    "a newer opset": ("isaac-lab", lambda m: setattr(m.opset_import[0], "version", 12), "the opset is at most 11"),
    "no state": ("godot-rl", lambda m: m.graph.input.pop(), "the inputs are obs and state_ins"),
    "no state back": ("godot-rl", lambda m: m.graph.output.pop(), "output and state_outs are outputs"),
    "a newer IR": ("godot-rl", lambda m: setattr(m, "ir_version", 10), "the opset is at most 19"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_file_that_breaks_a_rule_is_a_finding_with_the_line_that_asks_for_it(change: str, tmp_path: Path) -> None:
    consumer, apply, words = CHANGES[change]
    (result,) = export_model(fixture("continuous"), tmp_path, for_=consumer, verify="none")
    path = result.folder / "continuous.onnx"
    assert [f.passed for f in consumers(consumer, {"onnx": path})] == [True]
    model = onnx.load(path)
    apply(model)
    onnx.save(model, path)
    (finding,) = consumers(consumer, {"onnx": path})
    assert not finding.passed
    assert words in finding.reason and "@" in finding.reason


def test_each_rule_names_a_file_of_the_project_that_it_is_of() -> None:
    for loader in LOADERS.values():
        for rule in loader.rules:
            assert "." in rule.evidence and rule.says == rule.says.strip()
    assert {name for p in PROFILES for name in p.loaders} == {*LOADERS}


@given(
    st.lists(st.tuples(st.sampled_from(["obs", "actions", "h_in", "state_ins", "x"]), st.booleans(),
                       st.lists(st.none() | st.integers(-1, 9), max_size=4)), max_size=4),
    st.lists(st.tuples(st.sampled_from(["actions", "output", "state_outs", "h_out"]), st.booleans(),
                       st.lists(st.none() | st.integers(-1, 9), max_size=4)), max_size=4),
    st.integers(-1, 99),
)  # fmt: skip
def test_any_file_is_judged(inputs: list[Any], outputs: list[Any], version: int) -> None:
    tensors = [tuple(FileTensor(n, f, tuple(d)) for n, f, d in some) for some in (inputs, outputs)]
    file = FileInterface(tensors[0], tensors[1], version, version)
    for loader in LOADERS.values():
        assert all(rule in loader.rules for rule in loader.faults(file))


def test_the_interface_is_what_onnx_says(tmp_path: Path) -> None:
    (result,) = export_model(fixture("continuous"), tmp_path, for_="godot-rl", verify="none")
    path = result.folder / "continuous.onnx"
    file = interface_of(onnx.load(path))
    session = session_of(path)
    for ours, theirs in ((file.inputs, session.get_inputs()), (file.outputs, session.get_outputs())):
        assert [t.name for t in ours] == [t.name for t in theirs]
        assert [len(t.dims) for t in ours] == [len(t.shape) for t in theirs]
    assert file.opset == profile("godot-rl").opset


@needs_shared
def test_verify_and_the_contract_know_a_memory_in_two_tensors(export: Export) -> None:
    made = export(ISAAC[2], "isaac-lab")
    contract = json.loads((made.parent / "policy.json").read_text())
    assert contract["memory"]["others"] == [["c_in", "c_out"]]
    assert contract["tool"]["batch"] == 1
    assert parse_signature(contract).recurrences == (("h_in", "h_out"), ("c_in", "c_out"))
    report = verify_bundle(made.parent, source=FOREIGN / f"{ISAAC[2]}.onnx", runtimes="onnxruntime")
    assert report.passed
    assert "Isaac Lab" in report.sentence and "Unity" not in report.sentence
    rolled = [c for c in report.comparisons if c.kind == "rollout"]
    assert {c.output for c in rolled} >= {"actions", "h_out", "c_out"}


def test_the_command_line_names_what_the_file_is_for(tmp_path: Path) -> None:
    done = command(fixture("continuous"), "-o", tmp_path, "--for", "godot", "--verify", "none")
    assert "give continuous.onnx of" in done.out and "to Godot RL Agents" in done.out
    shown = command("snippets", tmp_path / "continuous", "--for", "godot-rl")
    assert '"action_type": "continuous"' in shown.out and "res://continuous.onnx" in shown.out
    is_refused(
        command(fixture("continuous"), "-o", tmp_path, "--for", "isaac-lab", "--batch", "4"), "the consumer decides"
    )


def test_the_public_module_has_them(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="isaac-lab"):
        public.export(fixture("continuous"), tmp_path, for_="isaac-lap")
