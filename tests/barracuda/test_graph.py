"""Inputs, outputs, memories and names: how a ``.nn`` becomes the graph that its policy is read off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.compiler.options import CompileOptions
from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.barracuda.format import NnModel, Trailer, parse
from export_model.converters.formats.barracuda.graph import to_graph
from export_model.converters.formats.barracuda.source import read
from export_model.converters.formats.source import ReadOptions
from export_model.converters.graph.nodes import Graph, TensorShape
from export_model.converters.graph.ops.samplers import reseed
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.signatures.errors import DamagedFileError, SignatureError
from export_model.signatures.roles import Role
from tests.barracuda.nn_files import Maker, write_nn
from tests.barracuda.reference import evaluate

X = "vector_observation"
RNG = np.random.default_rng(3)


def draw(*shape: int) -> np.ndarray:
    return RNG.uniform(-1, 1, shape).astype(np.float32)


def graph_of(model: NnModel) -> Graph:
    return to_graph(parse(write_nn(model))).graph


def policy_of(model: NnModel, **options: object) -> Policy:
    (policy,) = compile_graph(graph_of(model), "p", CompileOptions(**options))  # type: ignore[arg-type]
    return policy


def source_of(model: NnModel, folder: Path) -> tuple[Graph, object]:
    path = folder / "Brain.nn"
    path.write_bytes(write_nn(model))
    (source,) = read(Fetched(path), ReadOptions())
    assert source.original is None
    assert source.files == (path,)
    return source.graph, source.facts


def lstm(m: Maker, scope: str, x: str, width: int, size: int, taken: str, given: str) -> str:
    """The layers that ML-Agents' converter writes for a BasicLSTMCell; returns h'."""
    m.memory(size, f"{taken}_c", f"{given}_c")
    m.memory(size, f"{taken}_h", f"{given}_h")
    joined = m.layer(f"{scope}/Concat", 210, x, f"{taken}_h", axis=3)
    gates = {}
    for gate, number in (("i", 4), ("j", 3), ("f", 4), ("o", 4)):
        data = {f"kernel_{gate}": draw(width + size, 1, 1, size), f"bias_{gate}": draw(1, 1, 1, size)}
        product = m.layer(f"{scope}/Dense_{gate}", 1, joined, data=data)
        gates[gate] = m.layer(f"{scope}/Gate_{gate}", 50, product, activation=number)
    kept = m.layer(f"{scope}/Mul", 102, f"{taken}_c", gates["f"])
    added = m.layer(f"{scope}/Mul_1", 102, gates["i"], gates["j"])
    m.layer(f"{given}_c", 100, kept, added)
    squashed = m.layer(f"{scope}/Tanh", 50, f"{given}_c", activation=3)
    return m.layer(f"{given}_h", 102, gates["o"], squashed)


def two_lstms() -> NnModel:
    m = Maker()
    m.input(X, 1, 1, 4)
    m.input("recurrent_in", 1, 1, 14)
    m.layer("strided_slice", 211, "recurrent_in", pad=(0,) * 4, pool=(0, 0, 0, 8), stride=(1,) * 4)
    first = lstm(m, "lstm_policy", X, 4, 4, "strided_slice_1", "concat")
    second = lstm(m, "lstm_value", first, 4, 3, "strided_slice_3", "concat_1")
    m.layer("recurrent_out", 50, "concat_c")
    both = m.layer("both", 210, first, second, axis=3)
    m.layer("action", 1, both, data={"k": draw(7, 1, 1, 2), "b": draw(1, 1, 1, 2)})
    m.outputs = ["strided_slice", "recurrent_out", "action"]
    return m.model()


def test_memories_are_joined_in_file_order(tmp_path: Path) -> None:
    model = two_lstms()
    graph, facts = source_of(model, tmp_path)
    assert facts.memory_layout == ("c", "h", "c", "h")  # type: ignore[attr-defined]
    assert graph["recurrent_in"].op == "Placeholder"
    assert graph["recurrent_in"].attrs["shape"] == TensorShape((None, 14))
    names = ("strided_slice_1_c", "strided_slice_1_h", "strided_slice_3_c", "strided_slice_3_h")
    assert graph["recurrent_in"].origin == names
    assert graph["recurrent_out"].origin == ("concat_c", "concat_h", "concat_1_c", "concat_1_h")

    policy = policy_of(model)
    signature = policy.signature
    assert [s.name for s in signature.inputs] == ["state", "recurrent_in"]
    assert signature.memory is not None
    assert (signature.memory.size, signature.memory.layout) == (14, ("c", "h", "c", "h"))
    memory = draw(3, 14)
    for _ in range(3):
        state = draw(3, 4)
        parts = np.split(memory, np.cumsum([4, 4, 3]), axis=1)
        feeds = {name: part[:, None, None] for name, part in zip(names, parts, strict=True)}
        expected = evaluate(model, {**feeds, X: state[:, None, None], "recurrent_in": memory[:, None, None]})
        got = run_graph(policy.graph, {"state": state, "recurrent_in": memory}, ["action", "recurrent_out"])
        joined = np.concatenate([expected[m.output][:, 0, 0] for m in model.memories], axis=1)
        np.testing.assert_allclose(got["recurrent_out"], joined, atol=1e-6)
        np.testing.assert_allclose(got["action"], expected["action"][:, 0, 0], atol=1e-6)
        memory = got["recurrent_out"]


def test_a_gru_has_one_memory(tmp_path: Path) -> None:
    """new_h = u·h + c − u·c, as the converter's ``gru`` lays it out."""
    m = Maker()
    m.input(X, 1, 1, 3)
    m.memory(5, "state_h", "gru_cell_h")
    joined = m.layer("gru/Concat", 210, X, "state_h", axis=3)
    gates = {}
    for gate in ("u", "r"):
        data = {f"kernel_{gate}": draw(8, 1, 1, 5), f"bias_{gate}": draw(1, 1, 1, 5)}
        gates[gate] = m.layer(f"gru/{gate}", 50, m.layer(f"gru/{gate}d", 1, joined, data=data), activation=4)
    again = m.layer("gru/Concat_1", 210, X, m.layer("gru/rh", 102, gates["r"], "state_h"), axis=3)
    c = m.layer("gru/cd", 1, again, data={"kernel_c": draw(8, 1, 1, 5), "bias_c": draw(1, 1, 1, 5)})
    c = m.layer("gru/c", 50, c, activation=3)
    total = m.layer("gru/Add", 100, m.layer("gru/uh", 102, gates["u"], "state_h"), c)
    m.layer("gru_cell_h", 101, total, m.layer("gru/uc", 102, gates["u"], c))
    m.layer("action", 1, "gru_cell_h", data={"k": draw(5, 1, 1, 2), "b": draw(1, 1, 1, 2)})
    model = m.model()
    graph, facts = source_of(model, tmp_path)
    assert facts.memory_layout == ("h",)  # type: ignore[attr-defined]
    assert graph["recurrent_in"].origin == "state_h"
    assert graph["recurrent_out"].origin == "gru_cell_h"
    policy = policy_of(model)
    state, h = draw(2, 3), draw(2, 5)
    got = run_graph(policy.graph, {"state": state, "recurrent_in": h}, ["action", "recurrent_out"])
    expected = evaluate(model, {X: state[:, None, None], "state_h": h[:, None, None]})
    np.testing.assert_allclose(got["recurrent_out"], expected["gru_cell_h"][:, 0, 0], atol=1e-6)
    np.testing.assert_allclose(got["action"], expected["action"][:, 0, 0], atol=1e-6)


def test_a_memory_that_does_not_fit_is_refused() -> None:
    m = Maker()
    m.input(X, 1, 1, 3)
    m.memory(4, "a_h", "b_h")
    m.layer("b_h", 50, X)
    m.layer("action", 50, X)
    with pytest.raises(DamagedFileError, match="is fed 4 numbers"):
        graph_of(m.model())
    m = Maker()
    m.input(X, 1, 1, 3)
    m.memory(4, "a_h", "nowhere")
    m.layer("action", 50, X)
    with pytest.raises(DamagedFileError, match="'nowhere', which must be an input"):
        graph_of(m.model())


def test_constants_are_nodes_of_their_own_name(tmp_path: Path) -> None:
    m = Maker()
    m.input(X, 1, 1, 3)
    values = {"version_number": 2.0, "memory_size": 0.0, "is_continuous_control": 1.0, "action_output_shape": 3.0}
    m.layer("first", 255, data={k: np.full((1, 1, 1, 1), v) for k, v in values.items()})
    m.layer("lone", 255, data={"another": draw(1, 1, 1, 3)})
    m.layer("sum", 100, X, "lone")
    m.layer("action", 102, "sum", "another")
    model = m.model()
    graph, _ = source_of(model, tmp_path)
    for name, value in values.items():
        assert graph[name].op == "Const"
        assert graph[name].value is not None
        assert graph[name].value.tolist() == [value]
    signature = policy_of(model).signature
    assert signature.constants == {k: int(v) for k, v in values.items()}
    assert signature.family == "ML-Agents 0.7-0.16"


def test_a_previous_action_is_an_integer_again() -> None:
    m = Maker()
    m.input(X, 1, 1, 3)
    m.input("prev_action", 1, 1, 2)
    m.memory(3, "recurrent_in_h", "new_h")
    hot = []
    for i, depth in enumerate((3, 2)):
        cut = m.layer(f"cut_{i}", 211, "prev_action", pad=(0, 0, 0, i), pool=(0, 0, 0, i), stride=(1, 1, 1, 0))
        hot.append(m.layer(f"hot_{i}", 67, cut, pool=(depth,)))
    both = m.layer("both", 210, X, *hot, axis=3)
    m.layer("new_h", 1, both, data={"k": draw(8, 1, 1, 3), "b": draw(1, 1, 1, 3)})
    m.layer("action", 100, "new_h", "recurrent_in_h")
    model = m.model()
    policy = policy_of(model)
    spec = policy.signature.input("prev_action")
    assert (spec.role, spec.dtype, spec.shape) == (Role.PREV_ACTION, "int32", (None, 2))
    assert "Cast" not in {n.op for n in policy.graph.nodes}
    state, memory, previous = draw(3, 3), draw(3, 3), np.array([[2, 0], [0, 1], [1, 1]], np.int32)
    got = run_graph(policy.graph, {"state": state, "recurrent_in": memory, "prev_action": previous}, ["action"])
    feeds = {X: state, "recurrent_in_h": memory, "prev_action": previous}
    expected = evaluate(model, {k: v[:, None, None].astype(float) for k, v in feeds.items()})
    np.testing.assert_allclose(got["action"], expected["action"][:, 0, 0], atol=1e-6)


def test_a_drawn_action_is_an_integer_again() -> None:
    m = Maker(17)
    m.input(X, 1, 1, 4)
    parts = []
    for i, size in enumerate((3, 2)):
        logits = m.layer(f"logits_{i}", 1, X, data={"k": draw(4, 1, 1, size), "b": draw(1, 1, 1, size)})
        log_p = m.layer(f"log_p_{i}", 50, logits, activation=10)
        parts.append(m.layer(f"draw_{i}", 66, log_p, pool=(1,)))
    m.layer("joined", 210, *parts, axis=7)
    m.layer("discrete_actions", 50, "joined")
    signature = policy_of(m.model()).signature
    action = signature.output("action")
    assert (action.role, action.dtype, action.shape) == (Role.SAMPLED, "int64", (None, 2))
    assert action.source == "discrete_actions"
    assert signature.branches == (3, 2)
    assert signature.has_input("state")


def noisy(version: int = 16, **fields: object) -> Maker:
    m = Maker(version)
    m.input(X, 1, 1, 2)
    m.layer("policy/noise", 64, *(() if fields.get("pool") else (X,)), **fields)
    m.layer("action", 100, X, "policy/noise")
    return m


def test_drawn_noise_becomes_an_input() -> None:
    policy = policy_of(noisy(alpha=0.5, beta=-2.0).model())
    epsilon = policy.signature.input("epsilon")
    assert (epsilon.role, epsilon.shape, epsilon.source) == (Role.NOISE, (None, 2), "policy/noise")
    state, noise = draw(3, 2), draw(3, 2)
    got = run_graph(policy.graph, {"state": state, "epsilon": noise}, ["action", "deterministic_action"])
    np.testing.assert_allclose(got["action"], state + 0.5 * noise - 2, atol=1e-6)
    np.testing.assert_allclose(got["deterministic_action"], state - 2, atol=1e-6)


def test_noise_of_a_fixed_shape_is_shared_by_all_agents() -> None:
    reading = to_graph(parse(write_nn(noisy(pool=(1, 1, 1, 2)).model())))
    assert any("one row for all agents" in note for note in reading.notes)
    (policy,) = compile_graph(reading.graph, "p", CompileOptions(noise="zero"))
    state = draw(3, 2)
    np.testing.assert_array_equal(run_graph(policy.graph, {"state": state}, ["action"])["action"], state)


def test_uniform_noise_has_no_action_without_chance() -> None:
    """The reader keeps it as what it is; the compiler refuses, since no value of it stands for no chance."""
    m = Maker()
    m.input(X, 1, 1, 2)
    m.layer("noise", 65, X, alpha=3.0, beta=1.0)
    m.layer("zero", 102, X, m.load("nothing", 0.0))
    m.layer("action", 100, "zero", "noise")
    with pytest.raises(SignatureError, match="RandomUniform"):
        policy_of(m.model())
    reseed(0)
    graph = to_graph(m.model()).graph
    (placeholder,) = (n.name for n in graph.nodes if n.op == "Placeholder")
    drawn = run_graph(normalise(graph), {placeholder: draw(4000, 2)}, ["action"])["action"]
    assert 1 <= drawn.min() < 1.01
    assert 3.99 < drawn.max() <= 4
    assert abs(drawn.mean() - 2.5) < 0.05


def test_a_sensor_of_rank_2_is_given_as_entities() -> None:
    """[N, 1, W, C] in Unity, where C is the first dimension: the policy takes [B, first, second]."""
    m = Maker(18)
    m.input("obs_0", 1, 5, 3)
    m.layer("action", 1, "obs_0", data={"k": draw(15, 1, 1, 2), "b": draw(1, 1, 1, 2)})
    model = m.model()
    policy = policy_of(model)
    (spec,) = policy.signature.inputs
    assert (spec.name, spec.role, spec.shape) == ("entities_0", Role.ENTITIES, (None, 3, 5))
    array = draw(2, 3, 5)
    got = run_graph(policy.graph, {"entities_0": array}, ["action"])["action"]
    expected = evaluate(model, {"obs_0": array.transpose(0, 2, 1)[:, None]})["action"]
    np.testing.assert_allclose(got, expected[:, 0, 0], atol=1e-6)


def test_names_that_tensorflow_does_not_allow() -> None:
    m = Maker(18)
    m.input(X, 1, 1, 2)
    m.layer("/actor/MatMul:0", 50, X, activation=3)
    m.layer("_actor_MatMul_0", 50, "/actor/MatMul:0", activation=3)
    m.layer("дія 日", 50, "_actor_MatMul_0", activation=3)
    m.layer("action", 50, "дія 日")
    model = m.model()
    graph = graph_of(model)
    origins = {n.origin for n in graph.nodes if n.op == "Tanh"}
    assert origins == {"/actor/MatMul:0", "_actor_MatMul_0", "дія 日"}
    allowed = set("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_.-/")
    assert all(set(n.name) <= allowed and n.name[0] not in "_-/" for n in graph.nodes)
    state = draw(2, 2)
    got = run_graph(graph, {X: state}, ["action"])["action"]
    np.testing.assert_allclose(got, np.tanh(np.tanh(np.tanh(state))), atol=1e-6)


def test_a_layer_may_have_the_name_of_a_node_that_is_made() -> None:
    m = Maker()
    m.input(X, 1, 1, 2)
    m.layer("a", 50, X, activation=9)
    m.layer("a/Sigmoid", 50, "a", activation=1)
    m.layer("action", 100, "a", "a/Sigmoid")
    graph = graph_of(m.model())
    assert graph["a/Sigmoid"].op == "Relu"
    assert graph["a"].op == "Mul"


def test_reading_for_any_batch_is_said() -> None:
    m = Maker(17)
    m.input(X, 1, 1, 4)
    m.layer("one", 201, X, pool=(1, 1, 1, 4))
    m.layer("action", 50, "one")
    reading = to_graph(parse(write_nn(m.model())))
    assert any("batch of 1" in note for note in reading.notes)
    got = run_graph(reading.graph, {X: np.ones((3, 4), np.float32)}, ["action"])["action"]
    assert got.shape == (3, 4)


def test_strides_that_the_converter_wrote_the_other_way_round_are_said() -> None:
    m = Maker()
    m.input("visual_observation_0", 8, 8, 1)
    data = {"k": draw(2, 2, 1, 2), "b": draw(1, 1, 1, 2)}
    m.layer("conv", 20, "visual_observation_0", pad=(0,) * 4, stride=(1, 2), data=data)
    m.layer("action", 200, "conv")
    reading = to_graph(parse(write_nn(m.model())))
    assert any("[height, width]" in note for note in reading.notes)


def test_what_the_source_says_of_itself(tmp_path: Path) -> None:
    m = Maker()
    m.input(X, 1, 1, 2)
    m.load("version_number", 1.0)
    m.layer("action", 50, X)
    _, facts = source_of(m.model(), tmp_path)
    assert facts.family == "ML-Agents 0.7 (preview)"  # type: ignore[attr-defined]
    assert any("self-consistent" in note for note in facts.notes)  # type: ignore[attr-defined]
    _, facts = source_of(m.model(trailer=Trailer("ONNX", "6", "pytorch")), tmp_path)
    assert any("a model of pytorch" in note for note in facts.notes)  # type: ignore[attr-defined]


def test_a_model_without_an_action_names_its_candidates(tmp_path: Path) -> None:
    m = Maker()
    m.input(X, 1, 1, 2)
    m.layer("left", 50, X, activation=3)
    m.layer("right", 50, X, activation=4)
    m.outputs = ["left", "right"]
    model = m.model()
    _, facts = source_of(model, tmp_path)
    assert any("no layer of the .nn is called action" in note for note in facts.notes)  # type: ignore[attr-defined]
    with pytest.raises(SignatureError, match=r"left .*right"):
        policy_of(model)
    policy = policy_of(model, outputs={"right": Role.ACTION})
    assert policy.signature.output("action").source == "right"


def test_a_depthwise_convolution_of_uneven_strides_has_no_op_that_tensorflow_refuses() -> None:
    """TensorFlow's CPU kernel of DepthwiseConv2dNative takes equal strides alone; the ONNX reader knew."""
    for stride, op in (((2, 2), "DepthwiseConv2dNative"), ((2, 1), "Conv2D")):
        m = Maker()
        m.input("visual_observation_0", 6, 6, 3)
        data = {"k": draw(2, 2, 1, 3), "b": draw(1, 1, 1, 3)}
        m.layer("seen", 21, "visual_observation_0", stride=stride, pad=(0, 0, 0, 0), data=data)
        m.layer("action", 200, "seen")
        found = {n.op for n in graph_of(m.model()).nodes if "Conv" in n.op}
        assert found == {op}
