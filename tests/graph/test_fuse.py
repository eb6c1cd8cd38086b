"""Products, their bias and activation as one op."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.passes.fuse import fuse
from export_model.converters.graph.nodes import Graph
from tests.graph.making import const, graph, node, ops, placeholder
from tests.graph.running import value
from tests.graph.samples import floats

pytestmark = pytest.mark.xdist_group("graph-passes")


def layer(product: str, *tail: str, **attrs: Any) -> Graph:
    """A product with bias and what follows it; the last node is "y"."""
    x, weights = ((None, 3), (3, 4)) if product == "MatMul" else ((None, 5, 5, 3), (2, 2, 3, 4))
    names = ["product", "biased", *(f"t{i}" for i in range(len(tail)))]
    names[-1] = "y"
    return graph(
        placeholder("x", x),
        const("weights", floats(*weights)),
        const("bias", floats(4, seed=1)),
        node(names[0], product, "x", "weights", **attrs),
        node(names[1], "BiasAdd", names[0], "bias"),
        *(node(names[2 + i], op, names[1 + i]) for i, op in enumerate(tail)),
    )


CONV = {"strides": (1, 1, 1, 1), "padding": "SAME"}


@pytest.mark.parametrize(
    ("before", "expected"),
    [
        (layer("MatMul"), ["_FusedMatMul"]),
        (layer("MatMul", "Relu"), ["_FusedMatMul"]),
        (layer("MatMul", "Elu", "Relu"), ["_FusedMatMul", "Relu"]),
        (layer("MatMul", "Tanh"), ["_FusedMatMul", "Tanh"]),
        (layer("Conv2D", **CONV), ["_FusedConv2D"]),
        (layer("Conv2D", "Elu", **CONV), ["_FusedConv2D"]),
    ],
)
def test_a_product_its_bias_and_activation_are_one_op(before: Graph, expected: list[str]) -> None:
    made = fuse(before, ["y"], activations=True)
    assert ops(made) == expected
    x = floats(3, *before["x"].attrs["shape"].dims[1:])
    np.testing.assert_allclose(value(made, {"x": x}, "y"), value(before, {"x": x}, "y"), rtol=1e-6, atol=1e-6)
    assert made["y"].origin == "y:0"


def test_activations_are_fused_where_they_are_asked_for() -> None:
    made = fuse(layer("MatMul", "Relu"), ["y"], activations=False)
    assert ops(made) == ["_FusedMatMul", "Relu"]
    assert made["biased"].attrs["fused_ops"] == ("BiasAdd",)


@pytest.mark.parametrize(
    ("before", "roots"),
    [
        (graph(*layer("MatMul").nodes, node("z", "Neg", "product")), ["y", "z"]),
        (layer("MatMul"), ["product", "y"]),
        (layer("MatMul", transpose_a=True), ["y"]),
        (layer("MatMul", transpose_b=True), ["y"]),
        (
            graph(
                placeholder("x", (None, 3)),
                placeholder("bias", (4,)),
                const("weights", floats(3, 4)),
                node("product", "MatMul", "x", "weights"),
                node("y", "BiasAdd", "product", "bias"),
            ),
            ["y"],
        ),
    ],
    ids=["read twice", "an output", "transposed a", "transposed b", "bias not constant"],
)
def test_what_cannot_be_fused_stays(before: Graph, roots: list[str]) -> None:
    assert fuse(before, roots, activations=True) is before


def test_a_bias_that_is_an_output_is_not_swallowed() -> None:
    made = fuse(layer("MatMul", "Relu"), ["biased", "y"], activations=True)
    assert ops(made) == ["_FusedMatMul", "Relu"]
