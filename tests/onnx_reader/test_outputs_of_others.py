"""What other trainers' models give beside the action is kept: memories by name, spreads, and the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from export_model.converters.graph.run import run_graph
from export_model.converters.policy.memories import looks_like_state, stem_of
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import SignatureError
from export_model.signatures.roles import Role
from tests.exporting import export_model, load_policy

WEIGHTS = np.random.default_rng(0).normal(size=(3, 3)).astype(np.float32)


def model(
    path: Path,
    inputs: dict[str, list[int | str]],
    nodes: list[onnx.NodeProto],
    outputs: list[str],
    constants: dict[str, np.ndarray] | None = None,
) -> Path:
    """An ONNX model of these nodes; ``w`` is a 3 x 3 matrix."""
    arrays = {"w": WEIGHTS, **(constants or {})}
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in inputs.items()],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, None) for n in outputs],
        [numpy_helper.from_array(a, n) for n, a in arrays.items()],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 15)], ir_version=8)
    path.write_bytes(made.SerializeToString())
    return path


def only(path: Path) -> Policy:
    (policy,) = read_source(path).policies()
    return policy


CELL = [
    helper.make_node("MatMul", ["obs", "w"], ["x"]),
    helper.make_node("Add", ["x", "IN"], ["sum"]),
    helper.make_node("Tanh", ["sum"], ["OUT"]),
    helper.make_node("MatMul", ["OUT", "w"], ["action"]),
]


def cell(path: Path, given: str, taken: str, width: int = 3) -> Path:
    names = {"IN": taken, "OUT": given}
    nodes = []
    for node in CELL:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        for field in (copy.input, copy.output):
            field[:] = [names.get(n, n) for n in field]
        nodes.append(copy)
    return model(path, {"obs": ["batch", 3], taken: ["batch", width]}, nodes, ["action", given])


@pytest.mark.parametrize(
    ("taken", "given"),
    [
        *(("h_in", "h_out"), ("hx", "new_hx"), ("h0", "hn"), ("state_in_0", "state_out_0"), ("hidden", "next_hidden")),
        *(("rnn_state_in", "rnn_state_out"), ("hiddenIn", "hiddenOut"), ("memory", "memory_out")),
    ],
)
def test_a_cell_without_a_recurrent_op_keeps_its_memory(taken: str, given: str, tmp_path: Path) -> None:
    policy = only(cell(tmp_path / "cell.onnx", given, taken))
    memory = policy.signature.memory
    assert memory is not None
    assert (memory.input, memory.output, memory.size) == ("recurrent_in", "recurrent_out", 3)
    assert [s.role for s in policy.signature.inputs] == [Role.VECTOR, Role.MEMORY_IN]
    obs, state = np.ones((2, 3), np.float32), np.full((2, 3), 0.25, np.float32)
    out = run_graph(policy.graph, {"state": obs, "recurrent_in": state}, ["recurrent_out"])["recurrent_out"]
    np.testing.assert_allclose(out, np.tanh(obs @ WEIGHTS + state), rtol=1e-5)


def test_a_state_without_its_input_is_an_error(tmp_path: Path) -> None:
    path = model(
        tmp_path / "lost.onnx",
        {"obs": ["batch", 3]},
        [helper.make_node("MatMul", ["obs", "w"], ["action"]), helper.make_node("Tanh", ["action"], ["h_out"])],
        ["action", "h_out"],
    )
    with pytest.raises(SignatureError, match="'h_out' looks like a memory"):
        only(path)
    (result,) = export_model(path, tmp_path / "out", outputs={"h_out": "other"}, verify="none")
    assert [s.name for s in result.policy.signature.outputs if s.role is Role.OTHER] == ["h_out"]


@pytest.mark.parametrize("given", ["kept", "s_1", "1"])
def test_an_output_that_is_made_of_an_input_and_has_its_shape_is_asked_for(given: str, tmp_path: Path) -> None:
    """No name says so, but it may be the memory: dropped or kept as another output, the policy forgets."""
    path = cell(tmp_path / "cell.onnx", given, "s")
    for named in ({}, {"action": "action"}):  # naming the action leaves the rest out
        with pytest.raises(SignatureError, match=rf"'{given}' may be a memory: .* \(obs, s\)"):
            export_model(path, tmp_path / "out", outputs=named, verify="none")
    (kept,) = export_model(
        path, tmp_path / "out", inputs={"s": "memory_in"}, outputs={given: "memory_out"}, verify="none"
    )
    assert kept.policy.signature.memory is not None
    (other,) = export_model(path, tmp_path / "out", outputs={given: "other"}, verify="none")
    assert [s.role for s in other.policy.signature.inputs] == [Role.VECTOR, Role.VECTOR]


def test_numbered_memories_are_told_apart(tmp_path: Path) -> None:
    """h1 and h2, given in the other order: both are fed back, each to its own."""
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["x"]),
        *(helper.make_node("Add", ["x", "h1_in"], ["a"]), helper.make_node("Tanh", ["a"], ["h1_out"])),
        *(helper.make_node("Add", ["h1_out", "h2_in"], ["b"]), helper.make_node("Tanh", ["b"], ["h2_out"])),
        helper.make_node("MatMul", ["h2_out", "w"], ["action"]),
    ]
    inputs: dict[str, list[int | str]] = {n: ["batch", 3] for n in ("obs", "h1_in", "h2_in")}
    policy = only(model(tmp_path / "two.onnx", inputs, nodes, ["action", "h2_out", "h1_out"]))
    memory = np.array([[0.1, 0.2, 0.3, -1, -2, -3]], np.float32)
    feeds = {"state": np.ones((1, 3), np.float32), "recurrent_in": memory}
    out = run_graph(policy.graph, feeds, ["recurrent_out"])["recurrent_out"]
    first = np.tanh(np.ones((1, 3)) @ WEIGHTS + memory[:, :3])
    np.testing.assert_allclose(out, np.concatenate([first, np.tanh(first + memory[:, 3:])], 1), rtol=1e-5)


@pytest.mark.parametrize("name", ["sigma", "std", "action_std"])
@pytest.mark.parametrize("shape", [(3,), (1, 3)])
def test_a_spread_that_is_a_parameter_of_the_network_is_kept_for_every_row(
    name: str, shape: tuple[int, ...], tmp_path: Path
) -> None:
    spread = np.array([0.1, 0.2, 0.3], np.float32).reshape(shape)
    path = model(
        tmp_path / "gauss.onnx",
        {"obs": ["batch", 3]},
        [helper.make_node("MatMul", ["obs", "w"], ["mean"]), helper.make_node("Identity", ["sigma0"], [name])],
        ["mean", name],
        {"sigma0": spread},
    )
    policy = only(path)
    assert policy.signature.output("action_std").role is Role.STD
    out = run_graph(policy.graph, {"state": np.zeros((4, 3), np.float32)}, ["action_std"])["action_std"]
    np.testing.assert_array_equal(out, np.repeat(spread.reshape(1, 3), 4, axis=0))
    (result,) = export_model(path, tmp_path / "out", verify="none")
    acting = load_policy(result.folder, runtime="numpy", seed=1)
    first, second = (acting.decide(np.zeros((1, 3))).action for _ in range(2))
    assert not np.array_equal(first, second)


def test_outputs_that_no_name_explains_are_kept_under_names_of_their_own(tmp_path: Path) -> None:
    names = ["logits_0", "state_1", "7"]
    path = model(
        tmp_path / "more.onnx",
        {"obs": ["batch", 3]},
        [
            helper.make_node("MatMul", ["obs", "w"], ["action"]),
            *(helper.make_node(op, ["action"], [n]) for op, n in zip(("Tanh", "Sigmoid", "Neg"), names, strict=True)),
        ],
        ["action", *names[:1], *names[2:]],
    )
    policy = only(path)
    others = {s.name: s.source for s in policy.signature.outputs if s.role is Role.OTHER}
    assert others == {"logits_0": "logits_0", "output_7": "7"}
    assert not [n for n in policy.signature.notes if "not exported" in n]


def test_two_vectors_are_two_observations(tmp_path: Path) -> None:
    path = model(
        tmp_path / "goal.onnx",
        {"vec": ["batch", 3], "goal": ["batch", 3]},
        [helper.make_node("Add", ["vec", "goal"], ["sum"]), helper.make_node("MatMul", ["sum", "w"], ["action"])],
        ["action"],
    )
    assert [(s.name, s.source) for s in only(path).signature.inputs] == [("state", "vec"), ("state_1", "goal")]


def test_a_batch_that_was_baked_in_is_freed_only_where_the_numbers_stay_right(tmp_path: Path) -> None:
    """A Reshape to [1, 3] in a model that says its batch is free: torch wrote the 1 of its example."""
    target = numpy_helper.from_array(np.array([1, 3]), "target")
    right = [
        helper.make_node("MatMul", ["obs", "w"], ["x"]),
        helper.make_node("Reshape", ["x", "target"], ["action"]),
    ]
    constants = {"target": numpy_helper.to_array(target)}
    path = model(tmp_path / "right.onnx", {"obs": ["batch", 3]}, right, ["action"], constants)
    free(path, "action", 2)
    policy = only(path)
    assert policy.source.rows == 1
    wrong = [
        right[0],
        helper.make_node("Reshape", ["x", "target"], ["r"]),
        helper.make_node("Gather", ["r", "zero"], ["g"], axis=0),
        helper.make_node("Add", ["r", "g"], ["action"]),
    ]
    path = model(
        tmp_path / "wrong.onnx",
        {"obs": ["batch", 3]},
        wrong,
        ["action"],
        {"target": numpy_helper.to_array(target), "zero": np.array([0])},
    )
    free(path, "action", 2)
    policy = only(path)  # r[0] is that of each agent's own row
    assert any("row by row" in note for note in policy.signature.notes)
    rows = np.arange(6, dtype=np.float32).reshape(2, 3)
    product = rows @ WEIGHTS
    got = run_graph(policy.graph, {"state": rows}, ["action"])["action"]
    np.testing.assert_allclose(got, product + product, atol=1e-5)


def test_a_batch_that_was_baked_in_is_not_tried_at_any_size(tmp_path: Path) -> None:
    """A file of some hundred bytes whose row has as many numbers as a tensor may: the trial would take gigabytes."""
    nodes = [
        helper.make_node("ReduceSum", ["obs", "axes"], ["x"], keepdims=1),
        helper.make_node("Reshape", ["x", "target"], ["action"]),
    ]
    constants = {"axes": np.array([1]), "target": np.array([1, 1])}
    path = model(tmp_path / "huge.onnx", {"obs": ["batch", 2**26]}, nodes, ["action"], constants)
    free(path, "action", 1)
    made = onnx.load(path)
    made.graph.output[0].type.tensor_type.shape.dim.add().dim_value = 1
    path.write_bytes(made.SerializeToString())
    with pytest.raises(SignatureError, match="too large to be tried"):
        only(path)


def free(path: Path, output: str, rank: int) -> None:
    """Declare an output with a free batch."""
    made = onnx.load(path)
    shape = ["batch", *([3] * (rank - 1))]
    value = helper.make_tensor_value_info(output, TensorProto.FLOAT, shape)
    made.graph.output[0].CopyFrom(value)
    path.write_bytes(made.SerializeToString())


@pytest.mark.parametrize("name", ["action", "value", "logits", "next_obs", "observation"])
def test_other_names_are_no_states(name: str) -> None:
    assert not looks_like_state(name)


def test_a_stem_is_what_both_ends_share() -> None:
    assert stem_of("lstm_h_in") == stem_of("lstm_h_out") == ("lstm", "h")
    assert stem_of("scope/c0") == stem_of("cn") == ("c",)


def test_an_output_that_no_input_changes_is_left_out_with_a_note(tmp_path: Path) -> None:
    nodes = [helper.make_node("MatMul", ["obs", "w"], ["mean"]), helper.make_node("Identity", ["c"], ["out1"])]
    path = model(tmp_path / "still.onnx", {"obs": ["batch", 3]}, nodes, ["mean", "out1"], {"c": np.ones(3, np.float32)})
    assert any("out1 is the same for every input" in n and "log_std" in n for n in only(path).signature.notes)
