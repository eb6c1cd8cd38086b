"""While loops and branches: what is left when they are unrolled computes what TensorFlow's own loops compute."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.passes.fold import fold
from export_model.converters.compiler.passes.inputs import set_values
from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.compiler.passes.unroll import MAX_TURNS, unroll
from export_model.converters.formats.frozen_graph.reader import from_graph_def, read_graph
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import CONTROL_FLOW
from export_model.converters.graph.run import run_graph
from export_model.signatures.errors import GraphError, NotAPolicyError, UnsupportedOpError
from fixtures import path
from fixtures.goldens import read_npz
from tests import handmade
from tests.graph.harness import Array, Runtimes, difference
from tests.graph.samples import f32, floats, ints
from tests.handmade import constant, node, placeholder

pytestmark = pytest.mark.xdist_group("graph-passes")

F32, I32 = np.float32, np.int32


def straight(nodes: Sequence[Any], *outputs: str) -> Graph:
    """Read, normalised and unrolled, only what the outputs need; the outputs are called ``out:…``."""
    read = from_graph_def(handmade.graph_def(nodes, producer=24))
    pins = [Node(f"out:{name}", "Identity", (name,)) for name in outputs]
    made = unroll(normalise(Graph((*read.nodes, *pins)).prune([p.name for p in pins])))
    assert not {n.op for n in made.nodes} & CONTROL_FLOW.keys()
    return made


def agree(runtimes: Runtimes, nodes: Sequence[Any], feeds: Mapping[str, Array], *outputs: str) -> Graph:
    """The straight graph, after it has been held against TensorFlow running the loop."""
    expected = runtimes.tensorflow_message(handmade.graph_def(nodes, producer=24), feeds, outputs)
    made = straight(nodes, *outputs)
    results = run_graph(made, feeds, [f"out:{n}" for n in outputs])
    for name, wanted in zip(outputs, expected, strict=True):
        assert difference(wanted, results[f"out:{name}"]) is None
    return made


# ------------------------------------------------------------------ the recurrent fixture

OUTPUTS = ("action", "action_probs", "recurrent_out")


def recurrent(steps: int) -> Graph:
    """The fixture's LSTM for sequences of ``steps``, unrolled."""
    source = read_graph(path("recurrent").read_bytes()).prune(OUTPUTS)
    return unroll(normalise(set_values(source, {"sequence_length": steps})))


@pytest.mark.parametrize("run", ["b1", "b3", "b7", "step0", "step3"])
def test_an_lstm_of_one_step_is_its_cell(run: str) -> None:
    made = recurrent(1)
    assert not {n.op for n in made.nodes} & CONTROL_FLOW.keys()
    goldens = read_npz(path("recurrent.npz"))
    feeds = {n.name: goldens[f"{run}/in/{n.name}"] for n in made.nodes if n.op == "Placeholder"}
    results = run_graph(made, feeds, OUTPUTS)
    for name in OUTPUTS:
        assert difference(goldens[f"{run}/out/{name}"], results[name]) is None


@pytest.mark.parametrize("steps", [1, 3])
def test_an_lstm_of_more_steps_is_unrolled(steps: int, runtimes: Runtimes) -> None:
    source = handmade.schema.parse(handmade.schema.GraphDef, path("recurrent").read_bytes(), "fixture")
    rows = 2 * steps
    feeds = {
        "state": floats(rows, 6),
        "prev_action": ints(rows, 2, low=0, high=1),
        "action_masks": np.ones((rows, 5), F32),
        "recurrent_in": floats(2, 32, seed=1, low=-1, high=1),
    }
    fed = {**feeds, "sequence_length": np.array(steps, I32)}
    expected = runtimes.tensorflow_message(source, fed, OUTPUTS)
    made = recurrent(steps)
    results = run_graph(made, feeds, OUTPUTS)
    for name, wanted in zip(OUTPUTS, expected, strict=True):
        assert difference(wanted, results[name]) is None
    # i, f and o of a cell, once per turn
    assert [n.op for n in made.nodes if "while" in n.name].count("Sigmoid") == 3 * steps
    if steps == 1:
        before = {n.name for n in read_graph(path("recurrent").read_bytes()).nodes}
        inner = [n for n in made.nodes if "while" in n.name and n.op != "StridedSlice"]
        assert {n.name for n in inner if n.op in ("MatMul", "Sigmoid", "Tanh")} <= before
        assert all(n.origin == f"{n.name}:0" for n in inner if n.op in ("MatMul", "Sigmoid", "Tanh"))


# ------------------------------------------------------------------ loops by hand


def loop(limit: Any, *, compare: str = "Less", frame: str = "loop", step: str = "one") -> list[Any]:
    """``i = 0; while i < limit: x = 2x + i; i += 1``, of x [B, 2]; the results are "i" and "x"."""

    def entered(name: str, dtype: Any, *, constant_: bool = True) -> Any:
        attrs = {"T": dtype, "frame_name": frame, "is_constant": constant_, "parallel_iterations": 10}
        return node(f"{frame}/{name}", "Enter", name, **attrs)

    def at(name: str) -> str:
        return f"{frame}/{name}"

    return [
        placeholder("start", (None, 2)),
        constant("zero", 0),
        constant("one", 1),
        constant("two", f32(2).reshape(())),
        limit,
        entered("zero", I32, constant_=False),
        entered("start", F32, constant_=False),
        *(entered(n, t) for n, t in (("one", I32), ("two", F32), ("limit", I32))),
        node(at("i"), "Merge", at("zero"), at("next_i"), T=I32, N=2),
        node(at("x"), "Merge", at("start"), at("next_x"), T=F32, N=2),
        node(at("less"), compare, at("i"), at("limit"), T=I32),
        node(at("cond"), "LoopCond", at("less")),
        node(at("switch_i"), "Switch", at("i"), at("cond"), T=I32),
        node(at("switch_x"), "Switch", at("x"), at("cond"), T=F32),
        node(at("body_i"), "Identity", f"{at('switch_i')}:1", T=I32),
        node(at("body_x"), "Identity", f"{at('switch_x')}:1", T=F32),
        node(at("float"), "Cast", at("body_i"), SrcT=I32, DstT=F32),
        node(at("double"), "Mul", at("body_x"), at("two"), T=F32),
        node(at("sum"), "AddV2", at("double"), at("float"), T=F32),
        node(at("count"), "Add", at("body_i"), at(step), T=I32),
        node(at("next_i"), "NextIteration", at("count"), T=I32),
        node(at("next_x"), "NextIteration", at("sum"), T=F32),
        node("i", "Exit", at("switch_i"), T=I32),
        node("x", "Exit", at("switch_x"), T=F32),
    ]


@pytest.mark.parametrize("turns", [0, 1, 5, MAX_TURNS])
def test_a_counted_loop_is_unrolled(turns: int, runtimes: Runtimes) -> None:
    start = floats(3, 2) / 2.0**turns
    made = agree(runtimes, loop(constant("limit", turns)), {"start": start}, "x", "i")
    assert [n.op for n in made.nodes].count("Mul") == turns


def test_every_turn_has_a_node_of_its_own_name() -> None:
    made = straight(loop(constant("limit", 3)), "x")
    assert [n.name for n in made.nodes if n.op == "Mul"] == [
        f"loop/double{turn}" for turn in ("", "/turn_1", "/turn_2")
    ]
    assert all(n.origin == "loop/double:0" for n in made.nodes if n.op == "Mul")


def test_the_counter_of_a_loop_folds() -> None:
    made = fold(straight(loop(constant("limit", 4)), "i"))
    value = made.constant("out:i")
    assert value is not None
    assert value.tolist() == 4


def test_two_loops_in_a_row(runtimes: Runtimes) -> None:
    first = loop(constant("limit", 2))
    again = loop(constant("limit", 3), frame="again")
    shared = {n.name for n in first}
    second = []
    for each in again:
        if each.name in shared and each.op != "Exit":
            continue
        if each.op == "Exit":
            each.name = f"again_{each.name}"
        if each.name == "again/start":
            each.input[0] = "x"
        second.append(each)
    agree(runtimes, [*first, *second], {"start": floats(3, 2)}, "again_x", "x")


@pytest.mark.parametrize(
    ("limit", "turns"),
    [(placeholder("limit", (), I32), "is not known"), (constant("limit", MAX_TURNS + 1), "more than 64")],
)
def test_a_loop_without_a_known_end_names_its_condition(limit: Any, turns: str) -> None:
    with pytest.raises(UnsupportedOpError, match=rf"LoopCond \(node 'loop/cond'\).*{turns}") as caught:
        straight(loop(limit), "x")
    assert caught.value.issues == (("loop/cond", "LoopCond"),)
    assert "--set" in str(caught.value)


@pytest.mark.parametrize(
    "nodes",
    [
        loop(constant("limit", 0), compare="GreaterEqual"),
        loop(constant("limit", 1), step="body_i"),  # i + i: what was computed once is not computed 2⁶⁴ times
    ],
)
def test_a_loop_that_never_ends_is_refused(nodes: list[Any]) -> None:
    with pytest.raises(UnsupportedOpError, match="more than 64 turns"):
        straight(nodes, "x")


def test_a_loop_of_too_many_nodes_is_refused_before_they_are_made() -> None:
    """64 turns of 600 nodes; a few turns of them are nothing."""

    def wide(turns: int) -> list[Any]:
        nodes = loop(constant("limit", turns))
        last = next(n for n in nodes if n.name == "loop/next_x")
        negated = [node(f"loop/wide_{i}", "Neg", last.input[0], T=F32) for i in range(600)]
        last.input[0] = "loop/all"
        return [*nodes, *negated, node("loop/all", "AddN", *(n.name for n in negated), T=F32, N=600)]

    with pytest.raises(NotAPolicyError, match="unroll to more than 16384 nodes"):
        straight(wide(MAX_TURNS), "x")
    assert [n.op for n in straight(wide(2), "x").nodes].count("Neg") == 1200


def test_a_condition_of_two_numbers_is_refused() -> None:
    with pytest.raises(GraphError, match="no single whole number"):
        straight(loop(constant("limit", [1, 2])), "x")


def test_an_array_that_is_handed_on_again_and_again_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was written before was copied at every writing: 16,384 of them in a loop took hours."""
    flow = "array:1"
    nodes: list[Any] = [placeholder("x", (2,)), constant("size", 9)]
    nodes.append(node("array", "TensorArrayV3", "size", dtype=F32))
    for i in range(9):
        nodes += [constant(f"i{i}", i), node(f"w{i}", "TensorArrayWriteV3", "array", f"i{i}", "x", flow, T=F32)]
        flow = f"w{i}"
    nodes.append(node("read", "TensorArrayReadV3", "array", "i0", flow, dtype=F32))
    assert straight(nodes, "read").nodes
    monkeypatch.setattr("export_model.converters.compiler.passes.unroll.MAX_HANDED_ON", 44)
    with pytest.raises(NotAPolicyError, match="hand on more than 44"):
        straight(nodes, "read")


@pytest.mark.parametrize("inside", ["loop/x", "loop/next_x"])
def test_an_output_inside_of_a_loop_is_refused(inside: str) -> None:
    with pytest.raises(GraphError, match=inside):
        straight(loop(constant("limit", 2)), inside)


def test_a_loop_in_a_loop_names_the_inner_one() -> None:
    inner = node("loop/inner", "Enter", "loop/body_x", T=F32, frame_name="inner", is_constant=False)
    leave = node("left", "Exit", "loop/inner", T=F32)
    with pytest.raises(UnsupportedOpError, match=r"Enter \(node 'loop/inner'\): a loop inside a loop") as caught:
        straight([*loop(constant("limit", 2)), inner, leave], "x", "left")
    assert caught.value.issues == (("loop/inner", "Enter"),)


def test_a_frame_without_a_condition_is_refused() -> None:
    nodes = [n for n in loop(constant("limit", 2)) if n.name != "loop/cond"]
    for each in nodes:
        each.input[:] = ["loop/less" if i == "loop/cond" else i for i in each.input]
    with pytest.raises(UnsupportedOpError, match=r"a loop or branch is left"):
        straight(nodes, "x")


# ------------------------------------------------------------------ branches


def branch(predicate: Any) -> list[Any]:
    """``y = 2x if predicate else -x`` as tf.cond writes it, plus what only the first side computes."""
    return [
        placeholder("x", (None, 2)),
        constant("two", f32(2).reshape(())),
        predicate,
        node("switch", "Switch", "x", "p", T=F32),
        node("switch_two", "Switch", "two", "p", T=F32),
        node("then", "Mul", "switch:1", "switch_two:1", T=F32),
        node("else", "Neg", "switch", T=F32),
        node("y", "Merge", "else", "then", T=F32, N=2),
    ]


@pytest.mark.parametrize("predicate", [True, False])
def test_a_branch_that_is_decided_leaves_one_side(predicate: bool, runtimes: Runtimes) -> None:
    made = agree(runtimes, branch(constant("p", np.array(predicate))), {"x": floats(3, 2)}, "y")
    assert ("then" in made, "else" in made) == (predicate, not predicate)


def test_a_condition_may_be_computed_from_constants(runtimes: Runtimes) -> None:
    nodes = branch(node("p", "Less", "one", "five", T=I32))
    made = agree(runtimes, [constant("one", 1), constant("five", 5), *nodes], {"x": floats(3, 2)}, "y")
    assert "then" in made


def test_a_branch_that_an_input_decides_is_refused() -> None:
    with pytest.raises(UnsupportedOpError, match=r"Switch \(node 'switch'\): the condition of a branch") as caught:
        straight(branch(placeholder("p", (), np.bool_)), "y")
    assert caught.value.issues == (("switch", "Switch"),)


# ------------------------------------------------------------------ tensor arrays


def scan(indices: Sequence[int]) -> list[Any]:
    """A tensor array filled from the rows of x [3, 2] in one order, read out in another."""
    return [
        placeholder("x", (3, 2)),
        constant("size", 3),
        constant("rows", np.array([1, 2, 0], I32)),
        constant("order", np.array(indices, I32)),
        constant("last", 2),
        node("array", "TensorArrayV3", "size", dtype=F32, element_shape=handmade.TensorShape(None)),
        node("filled", "TensorArrayScatterV3", "array", "rows", "x", "array:1", T=F32),
        node("read", "TensorArrayReadV3", "array", "last", "filled", dtype=F32),
        node("gathered", "TensorArrayGatherV3", "array", "order", "filled", dtype=F32),
        node("length", "TensorArraySizeV3", "array", "filled"),
    ]


def test_tensor_arrays_become_their_elements(runtimes: Runtimes) -> None:
    nodes, feeds = scan([2, 0, 1]), {"x": floats(3, 2)}
    # TensorFlow closes an array that has been read; one output at a time
    for output in ("read", "gathered", "length"):
        agree(runtimes, nodes, feeds, output)


def test_a_tensor_array_of_unknown_indices_is_refused() -> None:
    nodes = [placeholder("order", (2,), I32) if n.name == "order" else n for n in scan([0])]
    with pytest.raises(UnsupportedOpError, match=r"TensorArrayGatherV3 \(node 'gathered'\): the indices"):
        straight(nodes, "gathered")


def test_a_graph_without_loops_stays_the_same_object() -> None:
    read = from_graph_def(handmade.graph_def([placeholder("x"), node("y", "Neg", "x", T=F32)]))
    assert unroll(read) is read
