"""Constants that are repeated for every agent, and a choice without Where: what an importer of 2020 can read."""

from __future__ import annotations

import numpy as np
import onnx
import pytest

from export_model.converters.compiler.passes.broadcast_constants import broadcast_rows
from export_model.converters.consumers.profiles import profile
from export_model.converters.formats.onnx.writer import write
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import BOOL, FLOAT32, INT32
from tests.graph.harness import policy_of

pytest.importorskip("onnxruntime")
STATE = Node("state", "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, 3))})
ROW = np.array([[0.5, -1, 2]], np.float32)


def repeated(*after: Node) -> Graph:
    """A constant row as often as there are agents, and ``after``."""
    lengths = [
        Node("lengths", "Shape", ("state",), {"out_type": INT32}),
        Node("zero", "Const", value=np.array([0], np.int32)),
        Node("one", "Const", value=np.array([1], np.int32)),
        Node(
            "agents",
            "StridedSlice",
            ("lengths", "zero", "one", "one"),
            {**dict.fromkeys(("begin_mask", "end_mask", "ellipsis_mask", "new_axis_mask"), 0), "shrink_axis_mask": 1},
        ),
        Node("columns", "Const", value=np.array(1, np.int32)),
        Node("times", "Pack", ("agents", "columns"), {"axis": 0}),
        Node("row", "Const", value=ROW),
    ]
    return Graph((STATE, *lengths, Node("rows", "Tile", ("row", "times")), *after))


@pytest.mark.parametrize("given", ["action", "spread"])
def test_a_row_is_broadcast_where_an_op_does_so_and_repeated_where_it_is_given(given: str) -> None:
    graph = repeated(Node("spread", "Exp", ("rows",)), Node("action", "Mul", ("state", "spread")))
    state = np.arange(6, dtype=np.float32).reshape(2, 3)
    made = broadcast_rows(graph, [given])
    assert any(n.op == "Tile" for n in made.nodes) == (given == "spread")
    found = run_graph(made, {"state": state}, [given])[given]
    np.testing.assert_array_equal(found, run_graph(graph, {"state": state}, [given])[given])


def test_a_choice_is_a_sum_of_products_that_outlives_what_is_not_chosen() -> None:
    """An infinite number that is not chosen leaves no trace; the importer of barracuda-1.0 has no Where."""
    nodes = [
        STATE,
        Node("bound", "Const", value=np.array(1, np.float32)),
        Node("large", "Greater", ("state", "bound")),
        Node("grown", "Exp", ("state",)),
        Node("none", "ZerosLike", ("grown",)),
        Node("shown", "Cast", ("large",), {"DstT": FLOAT32, "SrcT": BOOL}),
        Node("below", "Add", ("grown", "none")),
        Node("chosen", "Select", ("large", "state", "below")),
        Node("action", "Add", ("chosen", "shown")),
    ]
    state = np.array([[0, 1, 2], [-3, 500, 1.5]], np.float32)
    graph = Graph(tuple(nodes))
    files = write(policy_of(graph, ["action"]), profile("barracuda-1.0").write_options('{"tool": {"version": "test"}}'))
    model = onnx.ModelProto.FromString(next(iter(files.values())).to_bytes())
    assert not {"Where", "Shape", "Expand"}.intersection(n.op_type for n in model.graph.node)
    import onnxruntime

    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"state": state})
    np.testing.assert_allclose(found, run_graph(graph, {"state": state}, ["action"])["action"], rtol=1e-6)
