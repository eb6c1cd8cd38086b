"""Graphs that decode but are wrong: each is refused with the file, the node and the reason, and nothing is written."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.nodes import TensorShape
from export_model.signatures.errors import (
    DamagedFileError,
    ExportModelError,
    GraphError,
    NotAPolicyError,
    UnsupportedOpError,
)
from tests.commands import export_model
from tests.handmade import (
    NodeDef,
    constant,
    continuous_policy,
    dense,
    graph_bytes,
    graph_def,
    node,
    placeholder,
    sampled_policy,
    weights,
)
from tests.robustness.refusing import refused


def test_the_graphs_that_are_damaged_here_are_right_at_first(tmp_path: Path) -> None:
    (tmp_path / "continuous.bytes").write_bytes(graph_bytes(continuous_policy()))
    (tmp_path / "sampled.bytes").write_bytes(graph_bytes(sampled_policy()))
    ran = export_model(
        tmp_path / "continuous.bytes", tmp_path / "sampled.bytes", "-o", tmp_path, "--verify", "none", "--json"
    )
    assert [p["name"] for p in ran.json["policies"]] == ["continuous", "sampled"]


# ------------------------------------------------------------------ no policy


def test_a_graph_of_constants_is_no_policy(tmp_path: Path) -> None:
    refused([constant("a", 1.0), node("action", "Identity", "a")], tmp_path, "no policy", "placeholder", "--output")


def test_a_placeholder_alone_is_no_policy(tmp_path: Path) -> None:
    refused([placeholder("action")], tmp_path, "action")


def test_a_graph_without_nodes_is_no_policy() -> None:
    with pytest.raises(NotAPolicyError, match="no nodes"):
        read_graph(graph_def([], producer=24).SerializeToString())


def test_a_graph_with_functions_says_how_to_freeze_it() -> None:
    message = graph_def([placeholder("x"), node("y", "__inference_call_12", "x")])
    message.library.function.add().signature.name = "__inference_call_12"
    with pytest.raises(NotAPolicyError, match="convert_variables_to_constants_v2"):
        read_graph(message.SerializeToString())
    with pytest.raises(NotAPolicyError, match="calls the function 'PartitionedCall'"):
        read_graph(graph_bytes([placeholder("x"), node("y", "PartitionedCall", "x")]))


# ------------------------------------------------------------------ ops


def test_an_unknown_op_is_named_with_its_node(tmp_path: Path) -> None:
    nodes = [*continuous_policy(), node("odd/one", "FancyNewOp", "mu")]
    nodes[-2].input[0] = "odd/one"
    refused(nodes, tmp_path, "FancyNewOp", "'odd/one'")


def test_all_unknown_ops_are_named_at_once(tmp_path: Path) -> None:
    nodes = [
        *continuous_policy(),
        *(node(f"odd/{i}", f"FancyOp{i}", "mu" if i == 0 else f"odd/{i - 1}") for i in (0, 1)),
    ]
    nodes[5].input[0] = "odd/1"
    assert nodes[5].name == "action"
    refused(nodes, tmp_path, "FancyOp0", "FancyOp1")


def test_an_unknown_op_beside_the_policy_does_not_matter(tmp_path: Path) -> None:
    file = tmp_path / "policy.bytes"
    file.write_bytes(graph_bytes([*continuous_policy(), node("train", "FancyNewOp", "mu")]))
    assert export_model(file, "-o", tmp_path / "out", "--verify", "none").status == 0


@pytest.mark.parametrize("op", ["ReadFile", "PyFunc", "WriteFile", "RestoreV2", "LoadLibrary", "EagerPyFunc"])
def test_an_op_that_reaches_outside_is_refused_by_name(op: str, tmp_path: Path) -> None:
    nodes = [*continuous_policy(), node("outside", op, "mu")]
    nodes[-2].input[0] = "outside"
    refused(nodes, tmp_path, op, "'outside'", "reaches outside the graph")


# ------------------------------------------------------------------ structure


def test_a_dangling_input_is_named(tmp_path: Path) -> None:
    nodes = continuous_policy()
    nodes[-1].input[0] = "mu/Relu"
    refused(nodes, tmp_path, "'action' (Tanh) reads 'mu/Relu', which is not in the graph")


@pytest.mark.parametrize("reference", ["", ":", ":0", "mu:²", f"mu:{'9' * 5000}", "mu:-1"])
def test_a_reference_that_is_none_dangles(reference: str, tmp_path: Path) -> None:
    nodes = continuous_policy()
    nodes[-1].input[0] = reference
    refused(nodes, tmp_path, "which is not in the graph")


def test_an_output_that_its_producer_does_not_have_is_named(tmp_path: Path) -> None:
    nodes = continuous_policy()
    nodes[-1].input[0] = "mu:1"
    refused(nodes, tmp_path, "'mu:1'", "an output that its producer does not have")


def test_two_nodes_with_one_name_are_refused(tmp_path: Path) -> None:
    refused([*continuous_policy(), constant("mu/bias", [1.0, 2.0])], tmp_path, "two nodes are called 'mu/bias'")


def test_a_cycle_is_refused(tmp_path: Path) -> None:
    nodes = continuous_policy()
    nodes[3].input[0] = "mu/add"
    nodes.append(node("mu/add", "Add", "mu", "mu/MatMul"))
    refused(nodes, tmp_path, "depends on itself", "cycle")


def test_a_node_that_reads_itself_is_refused(tmp_path: Path) -> None:
    nodes = continuous_policy()
    nodes[-1].input[0] = "action"
    refused(nodes, tmp_path, "'action' depends on itself")


def test_a_node_without_a_name_or_op_is_refused(tmp_path: Path) -> None:
    for broken in (node("", "Identity", "mu"), node("nameless", "", "mu")):
        refused([*continuous_policy(), broken], tmp_path, "no name or no op")


@pytest.mark.parametrize("name", [":0", "mu:1"])
def test_a_node_that_is_called_as_an_output_is_refused(name: str, tmp_path: Path) -> None:
    refused([*continuous_policy()[:-1], node(name, "Tanh", "mu", T=np.float32)], tmp_path, f"a node is called {name!r}")


def test_a_chain_of_thousands_of_nodes_is_no_trouble(tmp_path: Path) -> None:
    nodes = continuous_policy()
    last = nodes.pop()
    names = ["mu", *(f"chain/{i}" for i in range(3000))]
    nodes += [node(name, "Identity", before) for before, name in itertools.pairwise(names)]
    last.input[0] = names[-1]
    (tmp_path / "long.bytes").write_bytes(graph_bytes([*nodes, last]))
    assert export_model(tmp_path / "long.bytes", "-o", tmp_path / "out", "--verify", "none").status == 0


def test_a_join_that_doubles_at_every_step_ends_soon(tmp_path: Path) -> None:
    """Thirty joins of a tensor with itself have 2^30 parts."""
    nodes = [placeholder("vector_observation"), *dense("mu", "vector_observation", 3, 1), constant("axis", 1)]
    names = ["mu", *(f"join/{i}" for i in range(28)), "action"]
    nodes += [node(name, "ConcatV2", b, b, "axis") for b, name in itertools.pairwise(names)]
    (tmp_path / "joins.bytes").write_bytes(graph_bytes(nodes))
    ran = export_model("inspect", tmp_path / "joins.bytes", "--json")
    assert ran.status in (0, 2)
    assert ran.status == 2 or ran.json["policies"][0]["outputs"][0]["shape"] == [None, 2**29]


# ------------------------------------------------------------------ attributes, dtypes, shapes


def test_an_attribute_of_the_wrong_dtype_is_refused(tmp_path: Path) -> None:
    nodes = sampled_policy()
    draw = next(n for n in nodes if n.name == "draw")
    draw.attr["output_dtype"].type = 14  # bfloat16
    refused(nodes, tmp_path, "node 'draw', attribute 'output_dtype'", "dtype number 14")


@pytest.mark.parametrize("number", [0, 14, 99, -5, 2**30])
def test_a_dtype_that_does_not_exist_is_refused(number: int, tmp_path: Path) -> None:
    nodes = continuous_policy()
    nodes[0].attr["dtype"].type = number
    refused(nodes, tmp_path, "node 'vector_observation', attribute 'dtype'")


def _without_dtype(n: NodeDef) -> None:
    del n.attr["dtype"]


def _dtype_is_a_number(n: NodeDef) -> None:
    n.attr["dtype"].i = 1


def _shape_is_a_flag(n: NodeDef) -> None:
    n.attr["shape"].b = True


@pytest.mark.parametrize("damage", [_without_dtype, _dtype_is_a_number, _shape_is_a_flag])
def test_a_placeholder_that_does_not_say_what_it_takes_is_refused(
    damage: Callable[[NodeDef], None], tmp_path: Path
) -> None:
    nodes = continuous_policy()
    damage(nodes[0])
    refused(nodes, tmp_path, "the placeholder 'vector_observation' has")


def test_a_product_of_matrices_that_do_not_fit_is_refused(tmp_path: Path) -> None:
    nodes = [*continuous_policy(), constant("wrong", weights(5, 2))]
    nodes[3].input[1] = "wrong"
    refused(nodes, tmp_path, "'mu/MatMul' (MatMul)", "[5, 2]")


def test_a_bias_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    nodes = [*continuous_policy(), constant("wrong", [1.0, 2.0, 3.0])]
    nodes[4].input[1] = "wrong"
    refused(nodes, tmp_path, "'mu' (BiasAdd)")


@pytest.mark.parametrize("index", [3, 4], ids=["MatMul", "BiasAdd"])
def test_an_op_with_too_few_inputs_is_refused(index: int, tmp_path: Path) -> None:
    nodes = continuous_policy()
    del nodes[index].input[-1]
    refused(nodes, tmp_path, f"node {nodes[index].name!r} ({nodes[index].op})")


# ------------------------------------------------------------------ names


@pytest.mark.parametrize(
    ("brains", "called"),
    [
        (("Ball-A/B/", "Ball/A-B/"), ["policy-Ball-A-B", "policy-Ball-A-B-2"]),
        (("Ball/", "BALL/"), ["policy-BALL-2", "policy-Ball"]),
    ],
)
def test_two_brains_whose_names_become_one_are_numbered(
    brains: tuple[str, str], called: list[str], tmp_path: Path
) -> None:
    (tmp_path / "policy.bytes").write_bytes(graph_bytes([*continuous_policy(brains[0]), *continuous_policy(brains[1])]))
    ran = export_model(tmp_path / "policy.bytes", "-o", tmp_path / "out", "--verify", "none")
    assert ran.status == 0, ran.err
    assert "is another policy of" in ran.out
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == called


def test_names_of_nodes_may_be_anything(tmp_path: Path) -> None:
    nodes = continuous_policy()
    for broken, name in ((nodes[1], "ünï/кириллица"), (nodes[2], 'quo"te\n')):
        for reader in nodes:
            reader.input[:] = [name if r == broken.name else r for r in reader.input]
        broken.name = name
    (tmp_path / "a.bytes").write_bytes(graph_bytes(nodes))
    assert export_model(tmp_path / "a.bytes", "-o", tmp_path / "out", "--verify", "none").status == 0


# ------------------------------------------------------------------ what nobody foresaw


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        *((e("x"), ("cannot be understood", e.__name__)) for e in (IndexError, RecursionError, OverflowError)),
        (MemoryError("x"), ("memory",)),
    ],
)
def test_a_fault_of_a_pass_names_the_file_too(
    fault: Exception, said: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(*_: object) -> None:
        raise fault

    monkeypatch.setattr("export_model.exporter.export.sources.compile_graph", failing)
    message = refused(continuous_policy(), tmp_path, *said)
    assert "\n  why: " in message


def test_a_fault_of_a_writer_names_the_file_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(*_: object) -> None:
        raise TypeError("x")

    monkeypatch.setattr("export_model.converters.formats.onnx.writer.write", failing)
    refused(continuous_policy(), tmp_path, "cannot be understood", "TypeError")


def test_the_errors_are_of_their_kinds() -> None:
    def kind(nodes: list[NodeDef]) -> type[ExportModelError]:
        with pytest.raises(ExportModelError) as caught:
            read_graph(graph_bytes(nodes))
        return type(caught.value)

    assert kind([node("", "Identity")]) is DamagedFileError
    assert kind([node("a", "Identity", "b")]) is GraphError
    assert issubclass(UnsupportedOpError, GraphError)


def test_old_placeholders_with_an_empty_shape_have_an_unknown_one() -> None:
    """Before GraphDef version 24 ``shape {}`` meant unknown, not scalar."""
    made = [placeholder("a", shape=())]
    assert read_graph(graph_bytes(made))["a"].attrs["shape"] == TensorShape(None)
    assert read_graph(graph_bytes(made, producer=24))["a"].attrs["shape"] == TensorShape(())
