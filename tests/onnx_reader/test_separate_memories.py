"""Memories that are inputs and outputs of their own (rsl_rl, Isaac Lab, SB3-contrib): one memory in every format.

The models are what _OnnxPolicyExporter writes with opset 11; the oracle is onnxruntime, stepped by hand.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.formats.onnx.memories import FoundMemories, separate_memories
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, ExportResult, export
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.summary import failure_lines
from export_model.exporter.verify import original
from export_model.signatures.contract import parse_source_map
from export_model.signatures.errors import SignatureError
from export_model.signatures.memories import SourcePart, join_memory, split_memory
from export_model.signatures.roles import Role
from export_model.signatures.spec import Memory
from tests.exporting import verify_bundle
from tests.onnx_reader.models import Array, Bench, floats, model, node, save

pytestmark = pytest.mark.xdist_group("onnx-policies")

OBS, HIDDEN, ACTIONS, STEPS = 6, 5, 3, 4
Dim = int | str


#: inputs and outputs of an actor with one LSTM, as it declares them
SHAPES: tuple[dict[str, Any], dict[str, Any]] = (
    {"obs": (1, OBS), "h_in": (1, 1, HIDDEN), "c_in": (1, 1, HIDDEN)},
    {"actions": (1, ACTIONS), "h_out": (1, 1, HIDDEN), "c_out": (1, 1, HIDDEN)},
)


def recurrent(
    cell: str = "LSTM",
    layers: int = 1,
    *,
    batch: Dim = 1,
    rows: Dim | None = None,
    states: Mapping[str, tuple[str, str]] | None = None,
    result: str = "actions",
) -> Any:
    """Layers of a recurrent actor as torch.onnx.export writes them: states cut out by Slice, put together by Concat.

    ``batch`` is the states' declared batch, ``rows`` the others' where it is not the same; ``states`` their names.
    """
    gates, parts = (4, "hc") if cell == "LSTM" else (3, "h")
    rows = batch if rows is None else rows
    names = states or {p: (f"{p}_in", f"{p}_out") for p in parts}
    nodes, constants = [node("Unsqueeze", ["obs"], "sequence", axes=[0])], {}
    x = "sequence"
    for i in range(layers):
        width = OBS if i == 0 else HIDDEN
        constants |= {
            f"w{i}": floats(1, gates * HIDDEN, width, seed=10 * i + 1, scale=0.6),
            f"r{i}": floats(1, gates * HIDDEN, HIDDEN, seed=10 * i + 2, scale=0.6),
            f"b{i}": floats(1, 2 * gates * HIDDEN, seed=10 * i + 3, scale=0.3),
        }
        if layers > 1:
            constants |= {f"from{i}": np.array([i]), f"to{i}": np.array([i + 1]), "first": np.array([0])}
        begun, ended = [], []
        for part in parts:
            begun.append(names[part][0] if layers == 1 else f"{part}{i}")
            ended.append(names[part][1] if layers == 1 else f"{part}{i}_after")
            if layers > 1:
                nodes.append(node("Slice", [names[part][0], f"from{i}", f"to{i}", "first"], begun[-1]))
        attributes: dict[str, Any] = {"linear_before_reset": 1} if cell == "GRU" else {}
        operands = [x, f"w{i}", f"r{i}", f"b{i}", "", *begun]
        nodes.append(node(cell, operands, [f"y{i}", *ended], hidden_size=HIDDEN, **attributes))
        nodes.append(node("Squeeze", [f"y{i}"], f"x{i}", axes=[1]))
        x = f"x{i}"
    if layers > 1:
        nodes += [node("Concat", [f"{p}{i}_after" for i in range(layers)], names[p][1], axis=0) for p in parts]
    constants |= {"v": floats(HIDDEN, 8, seed=7), "u": floats(8, ACTIONS, seed=8)}
    nodes += [
        node("Squeeze", [x], "last", axes=[0]), node("Gemm", ["last", "v"], "hidden"), node("Elu", ["hidden"], "elu"),
        node("Gemm", ["elu", "u"], result),
    ]  # fmt: skip
    state = (np.float32, [layers, batch, HIDDEN])
    return model(
        nodes,
        {"obs": (np.float32, [rows, OBS]), **{names[p][0]: state for p in parts}},
        {result: (np.float32, [rows, ACTIONS]), **{names[p][1]: state for p in parts}},
        constants,
        opset=11,
    )


def stepped(path: Path, names: Mapping[str, tuple[str, str]], layers: int, observations: Array) -> list[Array]:
    """The actions of the file itself in onnxruntime, one agent at a time, its states fed back: [agents, actions]."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    result = session.get_outputs()[0].name
    columns = []
    for agent in range(observations.shape[1]):
        states = {taken: np.zeros((layers, 1, HIDDEN), np.float32) for taken, _ in names.values()}
        actions = []
        for step in observations:
            action, *after = session.run([result, *(g for _, g in names.values())], {"obs": step[[agent]], **states})
            states = dict(zip(states, after, strict=True))
            actions.append(action[0])
        columns.append(actions)
    return list(np.array(columns).transpose(1, 0, 2))


def compiled(message: Any, folder: Path, **options: Any) -> Policy:
    (policy,) = read_source(save(message, folder)).policies(CompileOptions(**options))
    return policy


def exported(path: Path, pool: RuntimePool, folder: Path, runtimes: Any = "auto", **options: Any) -> ExportResult:
    how = ExportOptions(folder, verify=runtimes, compile=CompileOptions(**options))
    (result,) = export([path], how, pool=pool)
    assert result.report is not None
    assert result.report.passed is True, "\n".join(failure_lines(result.report))
    assert result.report.reference == "source/onnxruntime"
    return result


# ------------------------------------------------------------------ what they become


@pytest.mark.parametrize(("cell", "layers"), [("LSTM", 1), ("LSTM", 2), ("GRU", 1), ("GRU", 2)])
@pytest.mark.parametrize("batch", [1, "batch"])
def test_four_formats_step_as_the_file_does(
    cell: str, layers: int, batch: Dim, pool: RuntimePool, tmp_path: Path
) -> None:
    parts = "hc" if cell == "LSTM" else "h"
    names = {p: (f"{p}_in", f"{p}_out") for p in parts}
    path = save(recurrent(cell, layers, batch=batch), tmp_path, "actor.onnx")
    result = exported(path, pool, tmp_path / "out", ("tensorflow", "onnxruntime", "tfjs-cpu"))
    report, policy = result.report, result.policy
    assert report is not None
    size = len(parts) * layers * HIDDEN
    assert policy.signature.memory == Memory(size, "recurrent_in", "recurrent_out", tuple(parts))
    assert policy.signature.input("recurrent_in").shape == (None, size)
    assert policy.signature.output("recurrent_out").shape == (None, size)
    assert policy.signature.input("recurrent_in").dtype == "float32"
    assert policy.signature.output("action").shape == (None, ACTIONS)
    assert policy.source.rows == (1 if batch == 1 else None)
    # Every format, its memory fed back, was held against the file, its own states fed back.
    rolled = {c.format for c in report.comparisons if c.kind == "rollout" and c.output == "recurrent_out"}
    assert rolled >= {"bytes", "saved_model", "onnx", "tfjs"}

    observations = floats(STEPS, 3, OBS, seed=5)
    wanted = stepped(path, names, layers, observations)
    forms = {
        "bytes": ("tensorflow", "{}.bytes", {"kind": "graph"}),
        "saved_model": ("tensorflow", "saved_model", {"kind": "saved_model", "signature": "serving_default"}),
        "onnx": ("onnxruntime", "{}.onnx", {"kind": "graph"}),
        "tfjs": ("tfjs-cpu", "tfjs", {"kind": "graph"}),
    }
    for form, (runtime, main, how) in forms.items():
        loaded = pool.process(runtime).load(str(result.folder / main.format(policy.name)), **how)
        memory = np.zeros((3, size), np.float32)
        for step, expected in zip(observations, wanted, strict=True):
            given = loaded.run({"state": step, "recurrent_in": memory}, ["action", "recurrent_out"])
            memory = given["recurrent_out"]
            np.testing.assert_allclose(given["action"], expected, atol=2e-6, err_msg=form)
        assert np.abs(memory).max() > 1e-2  # a memory that stays at zero would agree with anything
        loaded.unload()


def test_policy_json_says_what_was_joined_and_how_to_run_it_again(bench: Bench, tmp_path: Path) -> None:
    path = save(recurrent(layers=2), tmp_path, "actor.onnx")
    result = exported(path, bench.pool, tmp_path, ("onnxruntime",))
    content = json.loads((result.folder / "policy.json").read_text())
    sources = {entry["name"]: entry["source"] for entry in (*content["inputs"], *content["outputs"])}
    assert sources["recurrent_in"] == ["h_in", "c_in"]
    assert sources["recurrent_out"] == ["h_out", "c_out"]
    assert content["memory"]["layout"] == ["h", "c"]
    assert content["source"]["parts"]["recurrent_in"] == [
        {"tensor": "h_in", "shape": [2, None, HIDDEN]}, {"tensor": "c_in", "shape": [2, None, HIDDEN]},
    ]  # fmt: skip
    report = verify_bundle(result.folder, source=path, runtimes=["onnxruntime"])
    assert (report.reference, report.passed) == ("source/onnxruntime", True)


def test_a_source_that_is_run_with_its_states_mixed_up_disagrees(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = save(recurrent(layers=2), tmp_path, "actor.onnx")
    monkeypatch.setattr(original, "split_memory", lambda parts, memory: split_memory(parts[::-1], memory))
    (result,) = export([path], ExportOptions(tmp_path, verify=("onnxruntime",)), pool=bench.pool)
    assert result.report is not None
    assert result.report.passed is False
    assert {c.kind for c in result.report.comparisons if not c.passed} >= {"numbers", "rollout"}


def test_a_bundle_goes_through_again_as_one_memory(bench: Bench, tmp_path: Path) -> None:
    path = save(recurrent(layers=2), tmp_path, "actor.onnx")
    first = exported(path, bench.pool, tmp_path, ("onnxruntime",))
    (policy,) = read_source(first.folder / "actor.onnx").policies()
    assert policy.signature.memory == first.policy.signature.memory
    assert not policy.source.parts


# ------------------------------------------------------------------ what they are called, and how they are declared


@pytest.mark.parametrize(
    "names",
    [
        (("h0", "hn"), ("c0", "cn")),
        (("lstm_h", "new_lstm_h"), ("lstm_c", "new_lstm_c")),
        (("hidden_in", "hidden_out"), ("cell_in", "cell_out")),
        (("state.1", "17"), ("state.2", "18")),
    ],
)
def test_the_layer_says_what_is_memory_not_the_name(
    names: tuple[tuple[str, str], tuple[str, str]], bench: Bench, tmp_path: Path
) -> None:
    path = save(recurrent(batch="n", states=dict(zip("hc", names, strict=True))), tmp_path, "actor.onnx")
    policy = exported(path, bench.pool, tmp_path, ("onnxruntime",)).policy
    assert policy.signature.memory == Memory(2 * HIDDEN, "recurrent_in", "recurrent_out", ("h", "c"))
    assert policy.signature.input("recurrent_in").source == (names[0][0], names[1][0])
    assert policy.signature.output("recurrent_out").source == (names[0][1], names[1][1])


def test_the_order_is_that_of_the_file(bench: Bench, tmp_path: Path) -> None:
    message = recurrent(layers=2)
    inputs = list(message.graph.input)
    del message.graph.input[:]
    message.graph.input.extend([inputs[2], inputs[0], inputs[1]])
    policy = exported(bench.place(message), bench.pool, tmp_path, ("onnxruntime",)).policy
    assert policy.signature.memory == Memory(4 * HIDDEN, "recurrent_in", "recurrent_out", ("c", "h"))
    assert policy.signature.output("recurrent_out").source == ("c_out", "h_out")


def test_states_fixed_to_one_row_fix_the_model(bench: Bench, tmp_path: Path) -> None:
    """Recipes that name the batch of obs alone (seen with RecurrentPPO): the states still take one row."""
    path = bench.place(recurrent(rows="batch", result="logits"))
    policy = exported(path, bench.pool, tmp_path, ("onnxruntime",)).policy
    assert policy.source.rows == 1
    assert policy.signature.memory == Memory(2 * HIDDEN, "recurrent_in", "recurrent_out", ("h", "c"))
    assert policy.signature.outputs[0].source == "logits"


def test_what_has_another_length_than_the_batch_keeps_it(tmp_path: Path) -> None:
    message = recurrent(layers=2)
    message.graph.node[-1].output[0] = "raw"
    message.graph.node.append(node("Gemm", ["raw", "turn"], "actions"))
    message.graph.input.append(onnx.helper.make_tensor_value_info("turn", 1, [ACTIONS, ACTIONS]))
    signature = compiled(message, tmp_path, inputs={"turn": Role.PARAMETER}).signature
    assert signature.input("turn").shape == (ACTIONS, ACTIONS)
    assert signature.input("recurrent_in").shape == (None, 4 * HIDDEN)


def test_more_layers_than_a_policy_has_are_not_looked_through() -> None:
    message = recurrent()
    found = separate_memories(message.graph, SHAPES[0], SHAPES[1], frozenset(SHAPES[0]))
    assert [m.input for m in found.memories] == ["h_in", "c_in"]
    cell = next(n for n in message.graph.node if n.op_type == "LSTM")
    message.graph.node.extend([cell] * 64)
    assert separate_memories(message.graph, SHAPES[0], SHAPES[1], frozenset(SHAPES[0])) == FoundMemories()


def test_naming_the_action_alone_keeps_the_memory(tmp_path: Path) -> None:
    policy = compiled(recurrent(), tmp_path, outputs={"actions": Role.ACTION})
    assert policy.signature.memory == Memory(2 * HIDDEN, "recurrent_in", "recurrent_out", ("h", "c"))


def test_naming_what_is_known_changes_nothing(tmp_path: Path) -> None:
    given = {"h_out": Role.MEMORY_OUT, "c_out": Role.MEMORY_OUT}
    policy = compiled(recurrent(), tmp_path, inputs={"c_in": Role.MEMORY_IN, "h_in": Role.MEMORY_IN}, outputs=given)
    assert policy.signature == compiled(recurrent(), tmp_path).signature


def test_a_state_may_be_forgotten_where_an_episode_begins(bench: Bench, tmp_path: Path) -> None:
    """SB3-contrib: (1 - episode_starts) times the state, before the layer."""
    message = recurrent(batch="n")
    kept = [node("Mul", [name, "going_on"], f"{name}_kept") for name in ("h_in", "c_in")]
    cell = next(n for n in message.graph.node if n.op_type == "LSTM")
    cell.input[5], cell.input[6] = "h_in_kept", "c_in_kept"
    own = list(message.graph.node)
    del message.graph.node[:]
    message.graph.node.extend([*kept, *own])
    message.graph.input.append(onnx.helper.make_tensor_value_info("going_on", 1, ["n", 1]))
    signature = exported(bench.place(message), bench.pool, tmp_path, ("onnxruntime",)).policy.signature
    assert signature.memory == Memory(2 * HIDDEN, "recurrent_in", "recurrent_out", ("h", "c"))
    assert signature.input("going_on").role is Role.PARAMETER


def test_a_state_that_is_not_given_back_is_no_memory(tmp_path: Path) -> None:
    message = recurrent()
    del message.graph.output[2]
    given = {"inputs": {"h_in": Role.PARAMETER}}
    with pytest.raises(SignatureError, match="'h_out' looks like a memory"):
        compiled(message, tmp_path, **given)
    signature = compiled(message, tmp_path, **given, outputs={"h_out": Role.OTHER}).signature
    assert signature.memory is None
    assert signature.input("c_in").role is Role.PARAMETER


# ------------------------------------------------------------------ what the user says


def written_out(*, width: int = HIDDEN) -> Any:
    """Two states that no layer takes: the step is written out, as PyTorch does with an LSTMCell."""
    return model(
        [
            node("Gemm", ["obs", "w"], "x"),
            node("Add", ["x", "left"], "sum"),
            node("Tanh", ["sum"], "left_after"),
            node("Mul", ["left_after", "right"], "product"),
            node("Gemm", ["product", "v"], "right_after"),
            node("Gemm", ["right_after", "u"], "actions"),
        ],
        {"obs": (np.float32, ["n", OBS]), "left": (np.float32, ["n", HIDDEN]), "right": (np.float32, ["n", HIDDEN])},
        {
            "actions": (np.float32, ["n", 2]), "left_after": (np.float32, ["n", HIDDEN]),
            "right_after": (np.float32, ["n", width]),
        },
        {"w": floats(OBS, HIDDEN, seed=1), "v": floats(HIDDEN, width, seed=2), "u": floats(width, 2, seed=3)},
    )  # fmt: skip


@pytest.mark.parametrize("cell", ["LSTM", "GRU"])
@pytest.mark.parametrize("layers", [1, 2])
def test_roles_decide_where_two_outputs_could_be_meant(cell: str, layers: int, bench: Bench, tmp_path: Path) -> None:
    """The state once more as an output (features for another head): which of the two is fed back is not plain."""
    message = recurrent(cell, layers)
    message.graph.node.append(node("Identity", ["h_out"], "features"))
    message.graph.output.append(onnx.helper.make_tensor_value_info("features", 1, [layers, 1, HIDDEN]))
    parts = "hc" if cell == "LSTM" else "h"
    given = {f"{p}_in": Role.MEMORY_IN for p in parts}, {f"{p}_out": Role.MEMORY_OUT for p in parts}
    result = exported(bench.place(message), bench.pool, tmp_path, ("onnxruntime",), inputs=given[0], outputs=given[1])
    memory = result.policy.signature.memory
    assert memory is not None
    assert (memory.size, memory.input, memory.output) == (len(parts) * layers * HIDDEN, "recurrent_in", "recurrent_out")
    assert result.report is not None
    assert "rollout" in {c.kind for c in result.report.comparisons}


IN = {"left": Role.MEMORY_IN, "right": Role.MEMORY_IN}
OUT = {"right_after": Role.MEMORY_OUT, "left_after": Role.MEMORY_OUT}


def test_roles_join_what_no_layer_tells_of(bench: Bench, tmp_path: Path) -> None:
    path = bench.place(written_out())
    policy = exported(path, bench.pool, tmp_path, ("onnxruntime",), inputs=IN, outputs=OUT).policy
    memory = policy.signature.memory
    assert memory is not None
    assert (memory.size, memory.input, memory.output) == (2 * HIDDEN, "recurrent_in", "recurrent_out")
    assert policy.signature.input("recurrent_in").source == ("left", "right")
    assert policy.signature.output("recurrent_out").source == ("left_after", "right_after")
    feeds = {"state": floats(2, OBS), "recurrent_in": floats(2, 2 * HIDDEN, seed=4)}
    own = bench.onnxruntime(
        path,
        {"obs": feeds["state"], "left": feeds["recurrent_in"][:, :HIDDEN], "right": feeds["recurrent_in"][:, HIDDEN:]},
        ["left_after", "right_after"],
    )
    given = run_graph(policy.graph, feeds, ["recurrent_out"])["recurrent_out"]
    np.testing.assert_allclose(given, np.concatenate(own, axis=1), atol=2e-6)


def test_as_many_outputs_as_inputs_are_asked_for(tmp_path: Path) -> None:
    with pytest.raises(SignatureError, match=r"2 inputs are memories .* and 1 outputs"):
        compiled(written_out(), tmp_path, inputs=IN, outputs={"left_after": Role.MEMORY_OUT})


def test_memories_of_other_sizes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SignatureError, match=r"'right' takes 5 numbers a row, and 'right_after' gives 4"):
        compiled(written_out(width=4), tmp_path, inputs=IN, outputs=OUT)


# ------------------------------------------------------------------ the source's own tensors


@st.composite
def parts_and_memory(draw: st.DrawFn) -> tuple[tuple[SourcePart, ...], Array]:
    parts = []
    for number in range(draw(st.integers(1, 3))):
        shape: list[int | None] = [*draw(st.lists(st.integers(1, 3), min_size=1, max_size=3))]
        shape.insert(draw(st.integers(0, len(shape))), None)
        parts.append(SourcePart(f"part{number}", tuple(shape)))
    rows, size = draw(st.integers(1, 3)), sum(p.size for p in parts)
    return tuple(parts), np.arange(rows * size, dtype=np.float32).reshape(rows, size)


@given(parts_and_memory())
def test_what_is_divided_is_joined_again(case: tuple[Sequence[Any], Array]) -> None:
    parts, memory = case
    fed = split_memory(parts, memory)
    np.testing.assert_array_equal(join_memory(parts, fed), memory)
    begin = 0
    for part in parts:
        array = fed[part.tensor]
        assert array.shape == tuple(len(memory) if d is None else d for d in part.shape)
        for row in range(len(memory)):  # a row's numbers are its columns, in their order
            own = array.take(row, axis=part.shape.index(None)).reshape(-1)
            np.testing.assert_array_equal(own, memory[row, begin : begin + part.size])
        begin += part.size


def test_a_source_map_from_before_there_were_parts(tmp_path: Path) -> None:
    signature = compiled(recurrent("GRU"), tmp_path).signature
    assert parse_source_map({"rows": 1}, signature).parts == {}
    assert parse_source_map({"rows": 1}, signature).feeds["recurrent_in"] == "h_in"


@pytest.mark.parametrize("layers", [1, 2])
def test_a_source_map_comes_back_from_policy_json(layers: int, tmp_path: Path) -> None:
    policy = compiled(recurrent("GRU", layers), tmp_path)
    again = parse_source_map(json.loads(json.dumps(policy.source.to_dict())), policy.signature)
    assert again == policy.source
    assert "recurrent_in" not in again.feeds
