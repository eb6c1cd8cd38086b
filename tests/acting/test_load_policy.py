"""``load_policy``: decisions in both runtimes, memory, masks, seeds, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from onnx import helper, numpy_helper

from export_model.exporter.acting.policy import LoadedPolicy
from export_model.exporter.verify.statistics import FALSE_ALARM, fit
from export_model.signatures.errors import BundleError, RuntimeUnavailableError, UsageError
from export_model.signatures.roles import Role
from export_model.signatures.sampling import draw_cases
from export_model.signatures.spec import PolicySignature, TensorSpec
from fixtures import path as fixture
from tests.acting.bundles import Bundles
from tests.exporting import export_model, load_policy

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
        ({name: observed(policy)[name], "stat": 0}, "unknown observation 'stat'"),
        ({"stat": 0}, "unknown observation 'stat'"),
    ):
        with pytest.raises(UsageError, match=words):
            policy.decide(observations)
    with pytest.raises(UsageError, match="action_masks"):
        policy.decide(observed(policy, rows=2), masks=np.ones((3, sum(policy.signature.branches))))
    with pytest.raises(UsageError, match="observations"):
        load_policy(bundles("visual")).decide(np.zeros(3))  # it has two: which one is this?


def test_what_cannot_be_run_here_is_said(bundles: Bundles, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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


def stub(inputs: list[TensorSpec], outputs: list[TensorSpec], answers: dict[str, np.ndarray], **more: object) -> Stub:
    """A policy of this interface that answers what it is told, and keeps what it was fed."""
    fed: list[dict[str, np.ndarray]] = []

    def run(feeds: Mapping[str, np.ndarray], fetch: Sequence[str]) -> dict[str, np.ndarray]:
        fed.append(dict(feeds))
        return answers

    signature = PolicySignature(inputs=tuple(inputs), outputs=tuple(outputs), family="test", **more)  # type: ignore[arg-type]
    return Stub(LoadedPolicy("stub", signature, run, "numpy"), fed)


@dataclass
class Stub:
    policy: LoadedPolicy
    fed: list[dict[str, np.ndarray]]


STATE = TensorSpec("state", Role.VECTOR, "float32", (None, 2))


def test_the_second_step_of_old_discrete_policies_feeds_the_previous_action() -> None:
    """ML-Agents 0.3 and 0.4 take prev_action as [agents], not [agents, branches]."""
    inputs = [STATE, TensorSpec("prev_action", Role.PREV_ACTION, "int32", (None,))]
    outputs = [TensorSpec("action", Role.SAMPLED, "int64", (None, 1))]
    made = stub(inputs, outputs, {"action": np.array([[1], [2]])}, action_space="discrete", branches=(3,))
    agent = made.policy.agent()
    for _ in range(2):
        agent.decide(np.zeros((2, 2)))
    np.testing.assert_array_equal(made.fed[0]["prev_action"], [0, 0])
    np.testing.assert_array_equal(made.fed[1]["prev_action"], [1, 2])


@pytest.mark.corpus
@pytest.mark.parametrize("case", ["0.3.0-ppo-discrete-recurrent", "ua0.4.0-ppo-discrete-recurrent"])
def test_genuine_recurrent_policies_of_0_3_act_on(case: str, tmp_path: Path) -> None:
    (source,) = genuine(case)
    (result,) = export_model(source, tmp_path, to="bytes,onnx", verify="none")
    policy = load_policy(result.folder)
    agent = policy.agent()
    for step in range(3):
        decision = agent.decide(observed(policy, rows=2, seed=step))
    assert decision.memory is not None
    assert decision.memory.any()


def genuine(case: str) -> list[Path]:
    folder = Path(__file__).resolve().parents[3] / "shared" / "genuine" / case
    if not folder.is_dir():
        pytest.skip("../shared is not here: graphs of the original trainers")
    return sorted(folder.glob("*.bytes")) or sorted(folder.glob("frozen*.pb"))


@pytest.mark.parametrize(("range_", "expected"), [([0, 1], 1.0), ([0, 255], 255.0)])
def test_bytes_of_an_image_are_brought_to_the_range_that_the_policy_takes(range_: list[int], expected: float) -> None:
    camera = TensorSpec("observation_0", Role.VISUAL, "float32", (None, 1, 1, 3))
    outputs = [TensorSpec("action", Role.CONTINUOUS, "float32", (None, 1))]
    answers = {"action": np.zeros((1, 1), np.float32)}
    how = {"observation_0": {"layout": "NHWC", "range": range_}}
    made = stub([camera], outputs, answers, action_space="continuous", preprocess=how)
    made.policy.decide(np.full((1, 1, 1, 3), 255, np.uint8))
    made.policy.decide(np.full((1, 1, 1, 3), 0.5, np.float32))
    np.testing.assert_allclose(made.fed[0]["observation_0"], expected)
    np.testing.assert_allclose(made.fed[1]["observation_0"], 0.5)


def test_outputs_hold_the_action_that_was_taken(bundles: Bundles) -> None:
    """A graph that draws has drawn another one: it must not be shown as what the agent does."""
    policy = load_policy(bundles("sampled"), seed=11)
    decision = policy.decide(observed(policy, rows=64))
    np.testing.assert_array_equal(decision.outputs["action"], decision.discrete)
    continuous = load_policy(bundles("continuous"))
    decision = continuous.decide(observed(continuous), deterministic=True)
    np.testing.assert_array_equal(decision.outputs["action"], decision.continuous)


@pytest.mark.parametrize("missing", ["deterministic_continuous_actions", "deterministic_discrete_actions"])
def test_a_hybrid_with_one_companion_missing_pairs_the_other_rightly(missing: str) -> None:
    outputs = [
        TensorSpec("continuous_actions", Role.CONTINUOUS, "float32", (None, 1)),
        TensorSpec("discrete_actions", Role.SAMPLED, "int64", (None, 1)),
        TensorSpec("deterministic_continuous_actions", Role.DETERMINISTIC, "float32", (None, 1)),
        TensorSpec("deterministic_discrete_actions", Role.DETERMINISTIC, "int64", (None, 1)),
    ]
    values = {s.name: np.full((1, 1), i, s.dtype) for i, s in enumerate(outputs)}
    kept = [s for s in outputs if s.name != missing]
    made = stub([STATE], kept, values, action_space="hybrid", branches=(4,))
    pairs = {h.name: None if h.plain is None else h.plain.name for h in made.policy.signature.heads}
    names = ("continuous_actions", "discrete_actions")
    assert pairs == {n: None if n in missing else f"deterministic_{n}" for n in names}
    if "discrete" in missing:
        with pytest.raises(UsageError, match="'discrete_actions' cannot be had without chance"):
            made.policy.decide(np.zeros((1, 2)), deterministic=True)
        return
    decision = made.policy.decide(np.zeros((1, 2)), deterministic=True)
    assert decision.continuous is not None
    assert decision.discrete is not None
    assert decision.continuous.dtype == np.float32
    assert decision.continuous.item() == 0
    assert decision.discrete.item() == 3


def test_masks_that_forbid_everything_and_arguments_for_nothing_are_refused(bundles: Bundles) -> None:
    policy = load_policy(bundles("discrete"))
    masks = np.ones((2, sum(policy.signature.branches)))
    masks[1, : policy.signature.branches[0]] = 0
    with pytest.raises(UsageError, match="every action of branch 0 to agent 1"):
        policy.decide(observed(policy, rows=2), masks=masks)
    plain = load_policy(bundles("continuous"))
    for word in ("masks", "memory", "previous"):
        with pytest.raises(UsageError, match=f"takes no {word}"):
            plain.decide(np.zeros(8), **{word: np.ones((1, 2))})


def test_one_of_several_agents_begins_anew(bundles: Bundles) -> None:
    policy = load_policy(bundles("recurrent"))
    agent = policy.agent(deterministic=True)
    before = agent.decide(observed(policy, rows=3))
    agent.reset([1])
    after = agent.decide(observed(policy, rows=3, seed=1))
    assert before.memory is not None
    assert before.discrete is not None
    memory, previous = before.memory.copy(), before.discrete.copy()
    memory[1], previous[1] = 0, 0
    expected = policy.decide(observed(policy, rows=3, seed=1), memory=memory, previous=previous, deterministic=True)
    np.testing.assert_array_equal(after.memory, expected.memory)
    assert before.memory[1].any()  # a decision that was given away is not changed
    with pytest.raises(UsageError, match="unknown agent 3"):
        agent.reset(3)


def test_a_single_step_may_be_without_chance(bundles: Bundles) -> None:
    policy = load_policy(bundles("continuous"), seed=2)
    agent = policy.agent()
    best = policy.decide(np.zeros(8), deterministic=True)
    np.testing.assert_array_equal(agent.decide(np.zeros(8), deterministic=True).action, best.action)
    assert not np.array_equal(agent.decide(np.zeros(8)).action, best.action)


@pytest.mark.parametrize(("role", "value"), [(Role.STD, 0.5), (Role.LOG_STD, np.log(0.5))])
def test_a_mean_with_its_spread_is_drawn_from(role: Role, value: float) -> None:
    rows = 4000
    outputs = [
        TensorSpec("action", Role.CONTINUOUS, "float32", (None, 1)),
        TensorSpec(f"action_{role.value}", role, "float32", (None, 1)),
    ]
    mean, spread = np.full((rows, 1), 3, np.float32), np.full((rows, 1), value, np.float32)
    answers = {"action": mean, f"action_{role.value}": spread}
    made = stub([STATE], outputs, answers, action_space="continuous")
    drawn = made.policy.decide(np.zeros((rows, 2)))
    assert drawn.continuous is not None
    assert abs(drawn.continuous.mean() - 3) < 4 * 0.5 / rows**0.5
    assert abs(drawn.continuous.std() - 0.5) < 0.03
    np.testing.assert_array_equal(drawn.outputs["action"], drawn.continuous)
    best = made.policy.decide(np.zeros((rows, 2)), deterministic=True)
    np.testing.assert_array_equal(best.continuous, answers["action"])


def test_noise_that_was_kept_is_not_drawn_again(tmp_path: Path) -> None:
    """The graph draws with σ = 0.5 and gives σ beside the action: drawing once more would make it 0.71."""
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["mean"]),
        helper.make_node("MatMul", ["obs", "zero"], ["nothing"]),
        helper.make_node("Add", ["nothing", "log_half"], ["log_sigma"]),
        helper.make_node("Exp", ["log_sigma"], ["sigma"]),
        helper.make_node("RandomNormalLike", ["mean"], ["unit"], dtype=1),
        helper.make_node("Mul", ["unit", "sigma"], ["noise"]),
        helper.make_node("Add", ["mean", "noise"], ["action"]),
    ]
    weights = {
        "w": np.ones((2, 1), np.float32),
        "zero": np.zeros((2, 1), np.float32),
        "log_half": np.log(np.full(1, 0.5, np.float32)),
    }
    graph = helper.make_graph(
        nodes,
        "drawn",
        [helper.make_tensor_value_info("obs", 1, ["batch", 2])],
        [helper.make_tensor_value_info(n, 1, ["batch", 1]) for n in ("action", "log_sigma")],
        [numpy_helper.from_array(a, n) for n, a in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    (tmp_path / "drawn.onnx").write_bytes(model.SerializeToString())
    (result,) = export_model(
        tmp_path / "drawn.onnx", tmp_path / "out", noise="keep", outputs={"log_sigma": "log_std"}, verify="none"
    )
    rows = 20_000
    drawn = load_policy(result.folder).decide(np.zeros((rows, 2))).action
    assert abs(drawn.std() - 0.5) < 0.02


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({}, "the parameter 'goal' is missing"),
        ({"goal": [0, 0], "gaol": 1}, "unknown parameter 'gaol'"),
        ({"goal": [0, 0, 0]}, r"the parameter 'goal' has the shape \[3\]"),
    ],
)
def test_parameters_are_those_of_the_policy(given: dict[str, object], words: str) -> None:
    goal = TensorSpec("goal", Role.PARAMETER, "float32", (2,))
    outputs = [TensorSpec("action", Role.CONTINUOUS, "float32", (None, 1))]
    made = stub([STATE, goal], outputs, {"action": np.zeros((1, 1), np.float32)}, action_space="continuous")
    assert made.policy.decide(np.zeros(2), parameters={"goal": [1, 2]}).action.shape == (1, 1)
    with pytest.raises(UsageError, match=words):
        made.policy.decide(np.zeros(2), parameters=given)  # type: ignore[arg-type]


def test_a_file_that_was_changed_is_not_run(bundles: Bundles, tmp_path: Path) -> None:
    folder = tmp_path / "continuous"
    shutil.copytree(bundles("continuous"), folder)
    for name in ("continuous.onnx", "continuous.bytes"):
        with (folder / name).open("ab") as file:
            file.write(b"\0")
    for runtime in ("onnxruntime", "numpy"):
        with pytest.raises(BundleError, match="continuous"):
            load_policy(folder, runtime=runtime)


@pytest.mark.parametrize("runtime", ["onnxruntime", "numpy"])
def test_a_source_acts_as_its_bundle_does(runtime: str, bundles: Bundles) -> None:
    """An .onnx, and what anybody may have: converted in memory, nothing written."""
    folder = bundles("recurrent")
    want = load_policy(folder, runtime=runtime, seed=4)
    feeds = observed(want)
    for source in (folder / "recurrent.onnx", str(fixture("recurrent"))):
        policy = load_policy(source, runtime=runtime, seed=4)
        decision, expected = policy.decide(feeds, seed=4), want.decide(feeds, seed=4)
        np.testing.assert_array_equal(decision.discrete, expected.discrete)
        np.testing.assert_allclose(decision.memory, expected.memory, atol=1e-6)  # type: ignore[arg-type]


def test_of_several_policies_one_is_chosen() -> None:
    with pytest.raises(UsageError, match="holds 2 policies"):
        load_policy(fixture("twobrains"))
    assert load_policy(fixture("twobrains"), brain="StrikerBrain").signature.action_space == "continuous"


def test_a_trainer_that_gives_no_axis_of_branches_gets_one() -> None:
    policy = load_policy(Path(fixture("continuous")).parent / "sb3" / "sb3_discrete.onnx", runtime="numpy")
    decision = policy.decide(np.zeros((3, 4)))
    assert decision.action.shape == (3, 1)
