"""Networks that value actions (DQN and its kin): the action is the largest value, and the values stay an output.

The oracle is onnxruntime on the file itself, and numpy's argmax of what it gives.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.policy.action_values import EVIDENCE
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.signatures.errors import ExportModelError, NotAPolicyError, SignatureError, UsageError
from export_model.signatures.roles import Role
from tests.exporting import load_policy
from tests.onnx_reader.models import Bench, floats, model, node, save

pytestmark = pytest.mark.xdist_group("onnx-policies")

OBS, ACTIONS = 6, 4


def network(
    output: str = "output", *, weights: str = "fc", end: str = "", size: int = ACTIONS, obs: str = "obs", **more: Any
) -> Any:
    """Two layers; ``end``: what follows the last."""
    last = f"{output}_in" if end else output
    nodes = [
        node("Gemm", [obs, f"{weights}.0.weight", f"{weights}.0.bias"], "h", transB=1), node("Relu", ["h"], "r"),
        node("Gemm", ["r", f"{weights}.2.weight", f"{weights}.2.bias"], last, transB=1),
    ]  # fmt: skip
    nodes += [node(end, [last], output)] if end else []
    constants = {
        f"{weights}.0.weight": floats(8, OBS, seed=1), f"{weights}.0.bias": floats(8, seed=2),
        f"{weights}.2.weight": floats(size, 8, seed=3), f"{weights}.2.bias": floats(size, seed=4),
    }  # fmt: skip
    kind = (np.float32, ["batch", OBS])
    return model(nodes, {obs: kind}, {output: (np.float32, ["batch", size])}, constants, **more)


def dueling(reduction: str = "ReduceMean") -> Any:
    nodes = [
        node("MatMul", ["obs", "w"], "h"), node("Relu", ["h"], "r"), node("MatMul", ["r", "v"], "value_of_state"),
        node("MatMul", ["r", "a"], "advantage"), node(reduction, ["advantage"], "m", axes=[1], keepdims=1),
        node("Sub", ["advantage", "m"], "centred"), node("Add", ["value_of_state", "centred"], "y"),
    ]  # fmt: skip
    constants = {"w": floats(OBS, 8), "v": floats(8, 1, seed=2), "a": floats(8, ACTIONS, seed=3)}
    return model(nodes, {"obs": (np.float32, ["batch", OBS])}, {"y": (np.float32, ["batch", ACTIONS])}, constants)


#: file, the name of its values, what the note says of why
VALUES: dict[str, tuple[Any, str, str]] = {
    "CleanRL": (network("q_values"), "q_values", ""),
    "a letter": (network("Q"), "Q", ""),
    "action values": (network("action_values"), "action_values", ""),
    "Keras by tf2onnx": (network("QValues", producer="tf2onnx"), "QValues", ""),
    "Stable-Baselines3": (network("13", weights="q_net.q_net"), "13", "named as one"),
    "Udacity": (network("y", weights="qnetwork_local.fc"), "y", "named as one"),
    "dueling": (dueling(), "y", "dueling"),
    "dueling by the largest": (dueling("ReduceMax"), "y", "dueling"),
}


def compiled(message: Any, folder: Path, **options: Any) -> Policy:
    (policy,) = read_source(save(message, folder)).policies(CompileOptions(**options))
    return policy


def assert_best(path: Path, values: str, bench: Bench, folder: Path, **options: Any) -> Policy:
    how = ExportOptions(folder, verify=("onnxruntime",), compile=CompileOptions(**options))
    (result,) = export([path], how, pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert result.report.reference == "source/onnxruntime"
    signature = result.policy.signature
    assert (signature.action_space, signature.branches, signature.algorithm) == ("discrete", (ACTIONS,), None)
    assert [(s.name, s.role, s.dtype) for s in signature.outputs] == [
        ("action", Role.DETERMINISTIC, "int64"),
        ("deterministic_action", Role.DETERMINISTIC, "int64"),
        ("q_values", Role.Q_VALUES, "float32"),
    ]
    assert signature.output("q_values").source == values
    observed = floats(40, OBS, seed=9, scale=3)
    (wanted,) = bench.onnxruntime(path, {signature.inputs[0].source: observed}, [values])
    assert len(np.unique(wanted.argmax(1))) > 1
    decision = load_policy(result.folder).decide(observed)
    assert decision.discrete is not None
    np.testing.assert_array_equal(decision.discrete[:, 0], wanted.argmax(1))
    np.testing.assert_allclose(decision.outputs["q_values"], wanted, rtol=1e-5, atol=1e-5)
    compared = {c.output for c in result.report.comparisons if getattr(c, "output", None)}
    assert {"action", "q_values"} <= compared
    return result.policy


@pytest.mark.parametrize("name", VALUES)
def test_the_action_is_the_largest_value(name: str, bench: Bench, tmp_path: Path) -> None:
    message, values, why = VALUES[name]
    policy = assert_best(bench.place(message), values, bench, tmp_path)
    notes = [n for n in policy.signature.notes if "Q-values" in n]
    assert bool(notes) is bool(why)
    assert all(why in note and f"--output {values}=action" in note for note in notes)


def test_the_user_says_what_nothing_tells(bench: Bench, tmp_path: Path) -> None:
    path = bench.place(network("y"))
    policy = assert_best(path, "y", bench, tmp_path, outputs={"y": Role.Q_VALUES})
    assert not policy.signature.notes


def test_where_nothing_tells_the_note_names_the_flag(tmp_path: Path) -> None:
    signature = compiled(network("y"), tmp_path).signature
    assert signature.output("action").role is Role.CONTINUOUS
    (note,) = signature.notes
    assert "--output y=q_values" in note


@pytest.mark.parametrize(
    "message",
    [network(n) for n in ("action", "actions", "mean", "mu", "policy", "continuous_actions")]
    + [network("y", end=e) for e in ("Tanh", "Sigmoid", "Softmax")],
)
def test_what_is_a_continuous_action_or_a_choice_is_not_asked_about(message: Any, tmp_path: Path) -> None:
    signature = compiled(message, tmp_path).signature
    assert not any("Q-values" in n for n in signature.notes)
    assert Role.Q_VALUES not in {s.role for s in signature.outputs}


@pytest.mark.parametrize("given", ["y=action", "q_values=action"])
def test_the_user_may_say_that_it_is_an_action(given: str, tmp_path: Path) -> None:
    name = given.partition("=")[0]
    signature = compiled(network(name, weights="q_net"), tmp_path, outputs={name: Role.ACTION}).signature
    assert signature.output("action").role is Role.CONTINUOUS
    assert not signature.notes


@pytest.mark.parametrize("weights", ["critic.2.weight", "agent.value_net.weight", "vf.weight", "baseline"])
def test_a_value_network_is_known_by_the_names_of_its_last_layer(weights: str, tmp_path: Path) -> None:
    """... as torch.onnx.export leaves them; an actor's are not, whatever it is part of."""
    with pytest.raises(NotAPolicyError, match="is a value"):
        compiled(network("output", size=1, weights=weights), tmp_path)
    for name, own in (("action", weights), ("output", f"critic.actor.{weights}"), ("output", "layers.2.weight")):
        signature = compiled(network(name, size=1, weights=own), tmp_path).signature
        assert signature.output("action").shape == (None, 1)


@pytest.mark.parametrize("name", ["value", "values", "critic", "v", "vf", "state_value", "q", "critic_value"])
def test_a_value_network_is_not_a_policy(name: str, tmp_path: Path) -> None:
    with pytest.raises(NotAPolicyError, match="is a value") as caught:
        compiled(network(name, size=1), tmp_path)
    assert f"--output {name}=action" in str(caught.value)
    signature = compiled(network(name, size=1), tmp_path, outputs={name: Role.ACTION}).signature
    assert signature.output("action").shape == (None, 1)


def test_values_beside_the_choice_are_values(tmp_path: Path) -> None:
    nodes = [node("MatMul", ["obs", "w"], "q_values"), node("ArgMax", ["q_values"], "action", axis=1, keepdims=0)]
    kind = (np.float32, ["batch", OBS])
    message = model(nodes, {"obs": kind}, ["action", "q_values"], {"w": floats(OBS, ACTIONS)})
    signature = compiled(message, tmp_path).signature
    assert signature.output("q_values").role is Role.Q_VALUES
    assert signature.output("action").source == "action"


def test_quantiles_are_no_values_of_actions(tmp_path: Path) -> None:
    nodes = [
        node("MatMul", ["obs", "w"], "flat"), node("Reshape", ["flat", "shape"], "q_values"),
        node("ReduceMean", ["q_values"], "mean_values", axes=[2], keepdims=0),
        node("ArgMax", ["mean_values"], "action", axis=1, keepdims=0),
    ]  # fmt: skip
    constants = {"w": floats(OBS, ACTIONS * 5), "shape": np.array([-1, ACTIONS, 5])}
    message = model(nodes, {"obs": (np.float32, ["batch", OBS])}, ["action", "q_values"], constants)
    signature = compiled(message, tmp_path).signature
    assert [s.role for s in signature.outputs if s.source == "q_values"] == [Role.OTHER]


@pytest.mark.parametrize(
    ("roles", "kind"),
    [({"a": Role.Q_VALUES, "b": Role.Q_VALUES}, UsageError), ({"a": Role.OTHER, "b": Role.Q_VALUES}, SignatureError)],
)
def test_what_cannot_be_values_is_refused(roles: dict[str, Role], kind: type[ExportModelError], tmp_path: Path) -> None:
    nodes = [node("MatMul", ["obs", n], o) for n, o in (("w", "a"), ("v", "b"))]
    weights = {"w": floats(OBS, 3), "v": floats(OBS, 1)}
    message = model(nodes, {"obs": (np.float32, ["batch", OBS])}, ["a", "b"], weights)
    with pytest.raises(kind, match="values of actions"):
        compiled(message, tmp_path, outputs=roles)


def test_a_recurrent_network_of_values_keeps_its_memory(bench: Bench, tmp_path: Path) -> None:
    nodes = [
        node("Concat", ["obs", "h_in"], "x", axis=1), node("MatMul", ["x", "w"], "z"), node("Tanh", ["z"], "h_out"),
        node("MatMul", ["h_out", "v"], "q"),
    ]  # fmt: skip
    inputs: dict[str, Any] = {"obs": (np.float32, ["batch", OBS]), "h_in": (np.float32, ["batch", 5])}
    constants = {"w": floats(OBS + 5, 5), "v": floats(5, ACTIONS, seed=2)}
    path = bench.place(model(nodes, inputs, ["q", "h_out"], constants))
    (result,) = export([path], ExportOptions(tmp_path, verify=("onnxruntime",)), pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert result.policy.signature.memory is not None
    assert result.policy.signature.branches == (ACTIONS,)


def test_every_sign_says_who_writes_such_files() -> None:
    assert all(len(e.seen) > 20 and e.said for e in EVIDENCE)
