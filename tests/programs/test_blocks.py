"""Constants in blocks, which C# reads: the same bits as C's plain arrays give, whatever the lengths leave over."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.graph.blocks import LANES, TERMS
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.types import FLOAT32
from export_model.converters.runtimes.pool import RuntimePool
from export_model.signatures.code import CodeOptions
from tests.graph.harness import Array, Runtimes, policy_of

pytestmark = [pytest.mark.xdist_group("programs")]


def weights(*shape: int) -> Array:
    return np.random.default_rng(shape[0]).normal(size=shape).astype(np.float32)


def observed(*shape: int) -> Node:
    return Node("x", "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, *shape))})


def product(terms: int, lanes: int, turned: bool) -> Graph:
    w = Node("w", "Const", value=weights(lanes, terms) if turned else weights(terms, lanes))
    return Graph((observed(terms), w, Node("y", "MatMul", ("x", "w"), {"transpose_a": False, "transpose_b": turned})))


def convolution(channels: int, lanes: int, padding: str) -> Graph:
    w = Node("w", "Const", value=weights(3, 2, channels, lanes))
    how = {"strides": [1, 2, 1, 1], "padding": padding, "dilations": [1, 1, 1, 1]}
    return Graph((observed(5, 4, channels), w, Node("y", "Conv2D", ("x", "w"), how)))


def shared() -> Graph:
    """A constant that is read in blocks of two kinds, and as it is."""
    w = Node("w", "Const", value=weights(LANES, LANES))
    how = {"transpose_a": False, "transpose_b": False}
    first = Node("a", "MatMul", ("x", "w"), how)
    second = Node("b", "MatMul", ("a", "w"), {**how, "transpose_b": True})
    third = Node("c", "MatMul", ("b", "w"), how)
    added = (Node("rows", "Const", value=np.array([2], np.int32)), Node("row", "Gather", ("w", "rows")))
    return Graph((observed(LANES), w, first, second, third, *added, Node("y", "Add", ("c", "row"))))


GRAPHS = {
    **{
        f"{terms} by {lanes}{' turned' * turned}": product(terms, lanes, turned)
        for terms, lanes in ((2, LANES), (TERMS, LANES), (TERMS + 1, 2 * LANES), (3, LANES + 1), (2 * TERMS + 5, 47))
        for turned in (False, True)
    },
    **{f"{c} to {n} {p}": convolution(c, n, p) for c, n, p in ((3, LANES, "VALID"), (9, 2 * LANES + 3, "SAME"))},
    "shared": shared(),
}


@pytest.mark.parametrize("name", GRAPHS)
def test_bits_are_those_of_plain_arrays(name: str, tmp_path: Path, processes: RuntimePool) -> None:
    policy, runtimes = policy_of(GRAPHS[name], ["y"]), Runtimes(processes, tmp_path)
    shape = [1, *(n or 1 for n in policy.signature.inputs[0].shape[1:])]
    feeds = {"x": np.random.default_rng(5).normal(size=shape).astype(np.float32)}
    own = CodeOptions(math="own")
    (expected,), (found,) = (runtimes.program(key, policy, feeds, own) for key in ("c", "csharp"))
    assert np.array_equal(found.view(np.int32), expected.view(np.int32))
    text = next(tmp_path.rglob("*.cs")).read_text()
    assert "ref _Block" in text


def test_what_is_read_in_blocks_alone_is_not_kept_twice(tmp_path: Path, processes: RuntimePool) -> None:
    runtimes, feeds = Runtimes(processes, tmp_path), {"x": np.zeros((1, TERMS), np.float32)}
    runtimes.program("csharp", policy_of(GRAPHS[f"{TERMS} by {LANES}"], ["y"]), feeds)
    text = next(tmp_path.rglob("*.cs")).read_text()
    assert "static readonly _Block[] w_w_blocks = _Pack(new float[]" in text
    assert "float[] w_w " not in text
