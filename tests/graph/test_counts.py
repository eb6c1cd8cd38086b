"""An op that says how many inputs it has, and has another number, is refused, as every TensorFlow does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import TABLE
from export_model.signatures.errors import GraphError

#: Op → the attribute with how many, and how many other inputs stand behind them.
COUNTED = {
    name: (attr.name, int(attr.derive.partition(":")[2] or 0))
    for name, entry in TABLE.items()
    for attr in entry.attrs
    if attr.derive is not None and attr.derive.startswith("count")
}


def graph_of(op: str, stated: Any) -> Graph:
    name, others = COUNTED[op]
    values = [Node(f"v{i}", "Const", value=np.ones((2, 2), np.float32)) for i in range(3)]
    axes = [Node(f"a{i}", "Const", value=np.array(0, np.int32)) for i in range(others)]
    attrs = {} if stated is None else {name: stated}
    return Graph((*values, *axes, Node("op", op, tuple(n.name for n in (*values, *axes)), attrs)))


def test_ops_that_join_say_how_many() -> None:
    assert {"AddN", "ConcatV2", "Pack"} <= COUNTED.keys()


@pytest.mark.parametrize("op", COUNTED)
@pytest.mark.parametrize("stated", [0, 2, 4, -1, 2**62])
def test_another_number_is_refused(op: str, stated: int) -> None:
    with pytest.raises(GraphError, match=rf"node 'op' \({op}\) says \w+={stated}, and has 3 inputs"):
        normalise(graph_of(op, stated), ["op"])


@pytest.mark.parametrize("op", COUNTED)
@pytest.mark.parametrize("stated", [3, None])
def test_the_number_that_it_has_is_no_news(op: str, stated: int | None) -> None:
    (made,) = (n for n in normalise(graph_of(op, stated), ["op"]).nodes if n.name == "op")
    assert COUNTED[op][0] not in made.attrs
