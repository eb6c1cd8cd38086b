"""What is kept of a node's types from graph to graph is what would be inferred anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import BOOL, FLOAT32
from export_model.exporter.export.sources import read_source
from export_model.signatures.errors import GraphError, UnsupportedOpError
from fixtures import path as fixture
from tests.handmade import constant, graph_bytes, node, placeholder


def test_a_node_that_reads_something_else_is_inferred_anew() -> None:
    relu = Node("relu", "Relu", ("x",))
    for width in (3, 5):
        x = Node("x", "Placeholder", (), {"dtype": FLOAT32, "shape": TensorShape((None, width))})
        assert infer_types(Graph((x, relu)))["relu"].shape == ("batch", width)


def test_symbols_of_two_graphs_do_not_meet() -> None:
    """A free axis behind the batch gets a symbol of its own in every graph, whatever was inferred before."""

    def free(name: str) -> Node:
        return Node(name, "Placeholder", (), {"dtype": FLOAT32, "shape": TensorShape((None, None))})

    one, other = free("one"), free("other")
    first, second = Node("first", "Relu", ("one",)), Node("second", "Relu", ("other",))
    infer_types(Graph((one, first)))
    infer_types(Graph((other, second)))
    types = infer_types(Graph((one, other, first, second)))
    assert types["first"].shape == types["one"].shape
    assert types["first"].shape != types["second"].shape


def test_types_of_a_compiled_graph_are_those_of_new_nodes() -> None:
    for policy in read_source(fixture("recurrent")).policies():
        graph = normalise(policy.graph)
        assert graph is policy.graph  # so that nothing is inferred again
        anew = Graph(tuple(Node(n.name, n.op, n.inputs, n.attrs, n.value, n.origin) for n in graph.nodes))
        kept, fresh = infer_types(graph), infer_types(anew)
        assert kept.keys() == fresh.keys()
        for name, kind in kept.items():
            assert (kind.dtype, kind.shape) == (fresh[name].dtype, fresh[name].shape)
            assert (kind.value is None) == (fresh[name].value is None)
            if kind.value is not None:
                assert np.array_equal(kind.value, fresh[name].value)


@pytest.mark.parametrize("op", ["MatMul", "BiasAdd", "Add", "Maximum", "Less", "AddN", "Select", "SelectV2"])
def test_operands_of_several_dtypes_are_refused(op: str) -> None:
    """TensorFlow does not load such a node. As bool, a placeholder of a damaged file went through into five formats."""
    x, y = (
        Node(name, "Placeholder", (), {"dtype": dtype, "shape": TensorShape(shape)})
        for name, dtype, shape in (("x", BOOL, (None, 3)), ("y", FLOAT32, (3,) if op == "BiasAdd" else (3, 3)))
    )
    inputs = ("x", "x", "y") if op.startswith("Select") else ("x", "y")
    with pytest.raises(GraphError) as refused:
        infer_types(Graph((x, y, Node("z", op, inputs))))
    assert "they are of bool and float32, and must be of one dtype" in (refused.value.why or "")


def test_a_target_shape_of_floats_is_refused() -> None:
    x = Node("x", "Placeholder", (), {"dtype": FLOAT32, "shape": TensorShape((2,))})
    with pytest.raises(GraphError) as refused:
        infer_types(Graph((x, Node("z", "Reshape", ("x", "x")))))
    assert "the target shape is of float32" in (refused.value.why or "")


@pytest.mark.parametrize("op", ["Mean", "Sum", "Max", "Squeeze", "SplitV"])
def test_an_operand_of_a_computed_rank_is_not_written(op: str, tmp_path: Path) -> None:
    """It had ended in an assertion of the ONNX writer."""
    nodes = [
        placeholder("vector_observation"),
        node("long", "Cast", "vector_observation", DstT=np.int64),
        constant("one", 1),
        constant("row", [-1]),
        constant("sizes", [1, 2]),
        node("flat", "Reshape", "long", "row"),
        node("shaped", "Reshape", "vector_observation", "flat"),
        node("z", op, "shaped", *{"Squeeze": [], "SplitV": ["sizes", "one"]}.get(op, ["one"]),
             **{"Squeeze": {"squeeze_dims": (1,)}, "SplitV": {"num_split": 2}}.get(op, {"keep_dims": False})),
        node("action", "Tanh", "z"),
    ]  # fmt: skip
    source = tmp_path / "ranks.bytes"
    source.write_bytes(graph_bytes(nodes))
    with pytest.raises(UnsupportedOpError, match="an operand of a rank that is computed"):
        WRITTEN["onnx"].artifact(read_source(source).policies()[0], WriteOptions("{}"))
