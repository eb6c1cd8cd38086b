"""Policies of Stable-Baselines3, CleanRL, rsl_rl and plain PyTorch: by inference, or by what the user says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.errors import SignatureError, UsageError
from export_model.signatures.roles import Role
from fixtures.goldens import read_npz
from fixtures.sb3 import FOLDER, POLICIES
from tests.onnx_reader.models import Bench, floats, model, node, save

pytestmark = pytest.mark.xdist_group("onnx-policies")


def compiled(message: Any, folder: Path, **options: Any) -> Policy:
    (result,) = read_source(save(message, folder)).policies(CompileOptions(**options))
    return result


def agrees(path: Path, bench: Bench, folder: Path, runtimes: Any = ("onnxruntime",)) -> Policy:
    (result,) = export([path], ExportOptions(folder, verify=runtimes), pool=bench.pool)
    assert result.report is not None
    assert result.report.reference == "source/onnxruntime"
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    return result.policy


# ------------------------------------------------------------------ what their own code wrote


@pytest.mark.parametrize("name", POLICIES)
def test_goes_through_unchanged(name: str, bench: Bench, tmp_path: Path) -> None:
    for runtime in ("tensorflow", "tfjs-cpu", "tfjs-wasm"):
        bench.need(runtime)
    agrees(FOLDER / f"{name}.onnx", bench, tmp_path, "auto")


@pytest.mark.parametrize("name", POLICIES)
def test_gives_the_numbers_of_pytorch(name: str) -> None:
    (policy,) = read_source(FOLDER / f"{name}.onnx").policies()
    golden = read_npz(FOLDER / f"{name}.npz")
    inputs = golden["input"] if "input" in golden else golden["observation"]
    outputs = ["deterministic_action", *(["value_estimate"] if "value" in golden else [])]
    feeds = {"state": inputs, "epsilon": np.zeros((len(inputs), 1), np.float32)}
    results = run_graph(policy.graph, feeds, outputs)
    wanted = golden["deterministic_action"]
    np.testing.assert_allclose(results["deterministic_action"].reshape(wanted.shape), wanted, atol=1e-6)
    if "value" in golden:
        np.testing.assert_allclose(results["value_estimate"], golden["value"], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "role", "outputs"),
    [
        ("sb3_continuous", "continuous", {"action", "deterministic_action", "value_estimate", "action_log_prob"}),
        ("sb3_discrete", "deterministic", {"action", "deterministic_action", "value_estimate", "action_log_prob"}),
        ("sb3_stochastic", "continuous", {"action", "deterministic_action", "value_estimate", "action_log_prob"}),
        ("torch_actor", "continuous", {"action", "deterministic_action"}),
        ("torch_actor_legacy", "continuous", {"action", "deterministic_action"}),
    ],
)
def test_what_they_are(name: str, role: str, outputs: set[str]) -> None:
    (policy,) = read_source(FOLDER / f"{name}.onnx").policies()
    signature = policy.signature
    assert signature.family == ("Stable-Baselines3" if name.startswith("sb3") else "own model")
    assert signature.algorithm is None
    assert {s.name for s in signature.outputs} == outputs
    assert signature.output("action").role.value == role
    assert signature.input("state").shape[0] is None
    fixed = [note for note in signature.notes if "exported for 1 row only" in note]
    assert bool(fixed) == name.startswith("sb3")
    assert policy.source.rows == (1 if fixed else None)


def test_weights_in_another_file_belong_to_the_source() -> None:
    source = read_source(FOLDER / "torch_actor.onnx")
    assert {p.name for m in source.models for p in m.files} == {"torch_actor.onnx", "torch_actor.onnx.data"}
    assert source.size == sum((FOLDER / n).stat().st_size for n in ("torch_actor.onnx", "torch_actor.onnx.data"))


# ------------------------------------------------------------------ what they are known to write


def actor(inputs: str, outputs: str, *, rows: int | str = "batch") -> Any:
    return model(
        [node("Gemm", [inputs, "w"], "h"), node("Elu", ["h"], "e"), node("Gemm", ["e", "v"], outputs)],
        {inputs: (np.float32, [rows, 6])},
        {outputs: (np.float32, [rows, 3])},
        {"w": floats(6, 8, seed=1), "v": floats(8, 3, seed=2)},
        opset=11,
    )


@pytest.mark.parametrize("given", ["obs", "observation", "observations", "input", "input.1", "actor_obs", "whatever"])
@pytest.mark.parametrize("result", ["actions", "action", "output", "mean", "17"])
def test_names_of_other_trainers(given: str, result: str, tmp_path: Path) -> None:
    policy = compiled(actor(given, result), tmp_path)
    assert [(s.name, s.role, s.source) for s in policy.signature.inputs] == [("state", Role.VECTOR, given)]
    assert policy.signature.outputs[0].name == "action"
    assert policy.signature.outputs[0].source == result


def test_rsl_rl_fixes_one_row(bench: Bench, tmp_path: Path) -> None:
    policy = agrees(bench.place(actor("obs", "actions", rows=1)), bench, tmp_path)
    assert policy.source.rows == 1
    assert policy.signature.output("action").shape == (None, 3)


def test_another_fixed_number_of_rows(bench: Bench, tmp_path: Path) -> None:
    policy = agrees(bench.place(actor("obs", "actions", rows=4)), bench, tmp_path)
    assert policy.source.rows == 4


def test_a_shape_that_begins_with_the_fixed_number_of_rows(bench: Bench, tmp_path: Path) -> None:
    message = model(
        [
            node("Reshape", ["obs", "image"], "i"),
            node("Conv", ["i", "k"], "c"),
            node("Reshape", ["c", "flat"], "f"),
            node("Gemm", ["f", "w"], "actions"),
        ],
        {"obs": (np.float32, [1, 36])},
        ["actions"],
        {
            "image": np.array([1, 1, 6, 6]), "k": floats(2, 1, 3, 3), "flat": np.array([1, -1]),
            "w": floats(32, 2, seed=3),
        },
    )  # fmt: skip
    policy = agrees(bench.place(message), bench, tmp_path)
    assert policy.signature.input("state").shape == (None, 36)


def test_the_older_recipe_of_stable_baselines3(bench: Bench, tmp_path: Path) -> None:
    """(action, value) without names, opset 9, input.1."""
    message = model(
        [node("Gemm", ["input.1", "w", "a"], "21"), node("Gemm", ["input.1", "v", "b"], "22")],
        {"input.1": (np.float32, [1, 6])},
        {"21": (np.float32, [1, 3]), "22": (np.float32, [1, 1])},
        {"w": floats(6, 3, seed=1), "v": floats(6, 1, seed=2), "a": floats(3), "b": floats(1)},
        opset=9,
    )
    signature = agrees(bench.place(message), bench, tmp_path).signature
    assert signature.family == "Stable-Baselines3"
    assert signature.output("value_estimate").source == "22"


def test_numbers_are_no_names_to_keep(tmp_path: Path) -> None:
    """TensorFlow.js sorts keys that are numbers before all others."""
    policy = compiled(actor("obs", "17"), tmp_path, names="source")
    assert [s.name for s in policy.signature.inputs] == ["obs"]
    assert policy.signature.outputs[0].name == "action"


def test_values_by_name(tmp_path: Path) -> None:
    message = model(
        [node("MatMul", ["obs", "w"], "actions"), node("MatMul", ["obs", "v"], "values")],
        {"obs": (np.float32, ["batch", 6])},
        {"values": (np.float32, ["batch", 1]), "actions": (np.float32, ["batch", 3])},
        {"w": floats(6, 3), "v": floats(6, 1)},
    )
    signature = compiled(message, tmp_path).signature
    assert [(s.name, s.source) for s in signature.outputs if s.source] == [
        ("action", "actions"), ("value_estimate", "values")
    ]  # fmt: skip


# ------------------------------------------------------------------ what has to be said


def ambiguous() -> Any:
    return model(
        [node("Gemm", ["/left", "w"], "/a/out"), node("Gemm", ["right", "v"], "/b/out")],
        {"/left": (np.float32, ["batch", 6]), "right": (np.float32, ["batch", 5])},
        {"/a/out": (np.float32, ["batch", 3]), "/b/out": (np.float32, ["batch", 4])},
        {"w": floats(6, 3), "v": floats(5, 4)},
    )


def test_an_unclear_output_is_asked_for_with_its_candidates(tmp_path: Path) -> None:
    with pytest.raises(SignatureError) as caught:
        compiled(ambiguous(), tmp_path)
    text = str(caught.value)
    assert "--output NAME=action" in text
    assert "a/out" in text
    assert "b/out" in text


def test_what_the_user_says_goes_by_the_names_of_the_file(tmp_path: Path) -> None:
    policy = compiled(ambiguous(), tmp_path, outputs={"/b/out": Role.ACTION}, inputs={"right": Role.VECTOR})
    assert [(s.name, s.source) for s in policy.signature.inputs] == [("state", "right")]
    assert policy.signature.outputs[0].source == "/b/out"


def test_an_inner_value_may_be_the_action(tmp_path: Path) -> None:
    message = model(
        [node("MatMul", ["obs", "w"], "/net/mean"), node("Tanh", ["/net/mean"], "actions")],
        {"obs": (np.float32, ["batch", 6])},
        ["actions"],
        {"w": floats(6, 3)},
    )
    policy = compiled(message, tmp_path, outputs={"/net/mean": Role.ACTION})
    assert policy.signature.outputs[0].source == "/net/mean"


def test_what_each_agent_has_its_own_of_is_an_observation_or_asked_for(tmp_path: Path) -> None:
    """Beside another observation: one number, the row of an embedding; a bare number per agent may be anything."""
    joined = [node("Concat", ["p", "q"], "c", axis=1), node("MatMul", ["c", "w"], "action")]
    inputs: dict[str, Any] = {"p": (np.float32, ["batch", 2]), "q": (np.float32, ["batch", 1])}
    signature = compiled(model(joined, inputs, ["action"], {"w": floats(3, 3)}), tmp_path).signature
    assert [(s.name, s.source) for s in signature.inputs] == [("state", "p"), ("state_1", "q")]
    embedded = [node("Gather", ["table", "cell"], "q"), *joined]
    inputs = {"p": (np.float32, ["batch", 2]), "cell": (np.int64, ["batch"])}
    message = model(embedded, inputs, ["action"], {"w": floats(5, 3), "table": floats(7, 3)})
    assert {s.source: s.role for s in compiled(message, tmp_path).signature.inputs} == dict.fromkeys(
        inputs, Role.VECTOR
    )
    scaled = [node("Unsqueeze", ["gain", "one"], "g"), node("Mul", ["p", "g"], "action")]
    inputs = {"p": (np.float32, ["batch", 2]), "gain": (np.float32, ["batch"])}
    message = model(scaled, inputs, ["action"], {"one": np.array([1])})
    with pytest.raises(SignatureError, match="what the input 'gain' is for") as caught:
        compiled(message, tmp_path)
    assert "--input gain=parameter" in (caught.value.fix or "")
    assert compiled(message, tmp_path, inputs={"gain": Role.PARAMETER}).signature.input("gain").role is Role.PARAMETER


def test_logits_beside_a_value_are_the_action(tmp_path: Path) -> None:
    nodes = [node("MatMul", ["obs", "w"], "logits"), node("MatMul", ["obs", "v"], "value")]
    message = model(nodes, {"obs": (np.float32, ["b", 3])}, ["logits", "value"], {"w": floats(3, 4), "v": floats(3, 1)})
    signature = compiled(message, tmp_path).signature
    sources = {s.source: s.name for s in signature.outputs}
    assert (sources["logits"], sources["value"]) == ("action", "value_estimate")
    (note,) = signature.notes
    assert "scores of a choice" in note and "as continuous actions" in note
    chosen = compiled(message, tmp_path, outputs={"logits": Role.Q_VALUES, "value": Role.VALUE}).signature
    assert note.endswith("--output logits=q_values") and (chosen.action_space, chosen.branches) == ("discrete", (4,))
    assert not compiled(message, tmp_path, outputs={"logits": Role.ACTION}).signature.notes


@pytest.mark.parametrize("role", [Role.VALUE, Role.ACTION_PROBS, Role.OTHER])
def test_the_only_action_cannot_be_told_to_be_something_else(role: Role, tmp_path: Path) -> None:
    message = model(
        [node("MatMul", ["obs", "w"], "out")], {"obs": (np.float32, ["b", 3])}, ["out"], {"w": floats(3, 4)}
    )
    with pytest.raises(SignatureError, match=f"--output out={role} leaves no action"):
        compiled(message, tmp_path, outputs={"out": role})


@pytest.mark.parametrize("told", [{"value": Role.VALUE, "other": Role.VALUE}, {"other": Role.VALUE}])
def test_one_role_for_two_outputs_is_refused_by_name(told: dict[str, Role], tmp_path: Path) -> None:
    nodes = [node("MatMul", ["obs", n], o) for n, o in (("w", "action"), ("v", "value"), ("u", "other"))]
    weights = {"w": floats(3, 2), "u": floats(3, 1), "v": floats(3, 1)}
    message = model(nodes, {"obs": (np.float32, ["b", 3])}, ["action", "value", "other"], weights)
    for given in (told, {"action": Role.ACTION, "value": Role.VALUE} | told):
        with pytest.raises(SignatureError, match="gives one role to 2 outputs") as caught:
            compiled(message, tmp_path, outputs=given)
        assert "=other" in (caught.value.fix or "")


@pytest.mark.parametrize("other", ["logits", "mean", "policy"])
def test_beside_an_action_nothing_else_is_one_and_nothing_is_lost(other: str, tmp_path: Path) -> None:
    nodes = [node("MatMul", ["obs", n], o) for n, o in (("w", "action"), ("u", other), ("v", "value"))]
    weights = {"w": floats(3, 2), "u": floats(3, 2), "v": floats(3, 1)}
    message = model(nodes, {"obs": (np.float32, ["b", 3])}, ["action", other, "value"], weights)
    (policy,) = read_source(save(message, tmp_path)).policies()
    roles = {s.source: s.role.value for s in policy.signature.outputs if s.source is not None}
    assert roles == {"action": "continuous", "value": "value_estimate", other: "other"}


def test_a_file_that_nothing_marks_as_a_policy_says_so(tmp_path: Path) -> None:
    """As mnist-8.onnx: Input3 and Plus214_Output_0."""
    message = model(
        [node("MatMul", ["Input3", "w"], "Plus214")],
        {"Input3": (np.float32, ["b", 3])},
        ["Plus214"],
        {"w": floats(3, 4)},
    )
    assert any("nothing marks this file as a policy" in note for note in compiled(message, tmp_path).signature.notes)
    nodes = [node("MatMul", ["obs", "w"], "mu")]
    marked = model(nodes, {"obs": (np.float32, ["b", 3])}, ["mu"], {"w": floats(3, 4)})
    assert compiled(marked, tmp_path).signature.notes == ()


def test_a_constant_of_mlagents_that_nothing_makes_is_left_out(tmp_path: Path) -> None:
    """Unity's own SoccerTwos: an output by name alone."""
    nodes = [node("MatMul", ["obs_0", "w"], "action")]
    message = model(nodes, {"obs_0": (np.float32, ["b", 3])}, ["action", "memory_size"], {"w": floats(3, 2)})
    signature = compiled(message, tmp_path).signature
    assert [n for n in signature.notes if "memory_size" in n and "nothing in the file makes it" in n]


def test_a_value_may_be_set(tmp_path: Path) -> None:
    message = model(
        [node("Mul", ["obs", "/gain"], "action")],
        {"obs": (np.float32, ["batch", 2]), "/gain": (np.float32, [])},
        ["action"],
    )
    policy = compiled(message, tmp_path, values={"/gain": 3.0})
    assert [s.name for s in policy.signature.inputs] == ["state"]
    assert policy.source.fixed["/gain"] == 3.0
    feeds = {"state": np.ones((2, 2), np.float32)}
    np.testing.assert_array_equal(run_graph(policy.graph, feeds, ["action"])["action"], 3 * feeds["state"])


def test_a_name_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not in the graph"):
        compiled(ambiguous(), tmp_path, outputs={"/c/out": Role.ACTION})


def test_a_recurrent_actor_with_its_memory_named(bench: Bench, tmp_path: Path) -> None:
    """rsl_rl's recurrent actors: h_in and h_out are no names of ML-Agents."""
    message = model(
        [
            node("Unsqueeze", ["obs", "zero"], "steps"),
            node("GRU", ["steps", "w", "r", "b", "", "h_in"], ["y", "h_out"], hidden_size=4, linear_before_reset=1),
            node("Squeeze", ["y", "first"], "s"),
            node("MatMul", ["s", "v"], "actions"),
        ],
        {"obs": (np.float32, [1, 6]), "h_in": (np.float32, [1, 1, 4])},
        {"actions": (np.float32, [1, 3]), "h_out": (np.float32, [1, 1, 4])},
        {
            "zero": np.array([0]), "first": np.array([0, 1]), "w": floats(1, 12, 6), "r": floats(1, 12, 4),
            "b": floats(1, 24), "v": floats(4, 3),
        },
    )  # fmt: skip
    path = bench.place(message)
    given = CompileOptions(inputs={"h_in": Role.MEMORY_IN}, outputs={"actions": Role.ACTION, "h_out": Role.MEMORY_OUT})
    (result,) = export([path], ExportOptions(tmp_path, compile=given, verify=("onnxruntime",)), pool=bench.pool)
    memory = result.policy.signature.memory
    assert memory is not None
    assert (memory.input, memory.output, memory.size) == ("recurrent_in", "recurrent_out", 4)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
