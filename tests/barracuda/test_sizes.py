"""A graph of some hundred bytes that would fill the memory as a ``.nn`` is refused before anything of it is made."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence

import numpy as np
import pytest

from export_model.converters.compiler.compile import compile_graph
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.policy.policy import Policy
from export_model.signatures.errors import UnsupportedOpError
from tests.barracuda.nn_running import nn_model
from tests.handmade import NodeDef, constant, graph_bytes, node, placeholder

X = "vector_observation"
MODEST = 64 << 20


def policy(*nodes: NodeDef) -> Policy:
    (read,) = compile_graph(read_graph(graph_bytes(nodes)), "policy")
    return read


def index(value: int | Sequence[int]) -> np.ndarray:
    return np.array(value, np.int32)


def best_of(width: int) -> list[NodeDef]:
    return [
        *(placeholder(X, (None, width)), constant("axis", index(1)), constant("after", index(1))),
        node("best", "ArgMax", X, "axis", output_type=np.int64),
        node("real", "Cast", "best", SrcT=np.int64, DstT=np.float32),
        node("action", "ExpandDims", "real", "after"),
    ]


def hot(columns: int, depth: int) -> list[NodeDef]:
    return [
        *(placeholder(X, (None, columns)), node("class", "Cast", X, SrcT=np.float32, DstT=np.int32)),
        *(constant("depth", index(depth)), constant("on", 1.0), constant("off", 0.0)),
        node("hot", "OneHot", "class", "depth", "on", "off", axis=-1),
        *(constant("flat", index([-1, columns * depth])), node("action", "Reshape", "hot", "flat")),
    ]


def spread(count: int, side: int) -> list[NodeDef]:
    """Numbers repeated to squares that are larger than what is folded, and summed up again."""
    made = [placeholder(X), constant("dims", index([side, side])), constant("axes", index([0, 1]))]
    total = X
    for i in range(count):
        made += [
            *(constant(f"value{i}", 0.5 + i), node(f"square{i}", "BroadcastTo", f"value{i}", "dims")),
            node(f"sum{i}", "Sum", f"square{i}", "axes", keep_dims=False),
            node(f"added{i}", "Add", total, f"sum{i}"),
        ]
        total = f"added{i}"
    return [*made, node("action", "Tanh", total)]


def hot_constant(depth: int) -> list[NodeDef]:
    return [
        *(placeholder(X, (None, 2)), constant("class", index([0, 1])), constant("depth", index(depth))),
        *(constant("on", 1.0), constant("off", 0.0)),
        node("kernel", "OneHot", "class", "depth", "on", "off", axis=-1),
        *(node("action", "MatMul", X, "kernel"),),
    ]


@pytest.mark.parametrize(
    ("nodes", "words"),
    [
        pytest.param(best_of(12_000), "a table of 12000×12000 numbers", id="ArgMax"),
        pytest.param(hot(2, 1 << 24), "a table of 2×33554432 numbers", id="OneHot, deep"),
        pytest.param(hot(3_000, 10), "a table of 3000×30000 numbers", id="OneHot, wide"),
        pytest.param(spread(8, 1 << 13), "unfold to 67108864 numbers", id="large constants"),
        pytest.param(hot_constant(1 << 24), "unfold to 33554432 numbers", id="OneHot of constants"),
        pytest.param(spread(30, 1 << 11), "unfold to 4194304 numbers", id="many constants"),
    ],
)
def test_it_is_refused_before_it_is_made(nodes: list[NodeDef], words: str) -> None:
    read = policy(*nodes)
    limit = MODEST if "4194304" not in words else 3 * MODEST  # some of the many are made
    tracemalloc.start()
    try:
        with pytest.raises(UnsupportedOpError, match=words) as caught:
            nn_model(read)
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()
    assert caught.value.issues


@pytest.mark.parametrize(
    "nodes", [best_of(1024), hot(30, 10), spread(1, 1 << 11), hot_constant(64)], ids=["best", "hot", "spread", "kernel"]
)
def test_what_a_policy_has_of_these_is_written(nodes: list[NodeDef]) -> None:
    assert nn_model(policy(*nodes)).layers
