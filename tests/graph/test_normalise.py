"""Spellings of all TensorFlow generations: what normalise makes of them computes what TensorFlow computes of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.passes.normalise import as_placeholder, normalise
from export_model.converters.formats.frozen_graph.reader import from_graph_def
from export_model.converters.graph.nodes import Graph, Node, TensorShape, topological
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import GraphError, UnsupportedOpError
from tests import handmade
from tests.graph.harness import Runtimes, difference
from tests.graph.samples import f32, floats, ints
from tests.graph.spellings import CASES, F32, IMAGE, batch_norm, binary, layer_norm, summed, unary
from tests.handmade import constant, node, placeholder

pytestmark = pytest.mark.xdist_group("graph-passes")


def normalised(nodes: Sequence[Any]) -> Graph:
    """The nodes as the reader reads them, normalised, with their "y" behind a node that nothing redirects."""
    read = from_graph_def(handmade.graph_def(nodes, producer=24))
    return normalise(Graph((*read.nodes, Node("out", "Identity", ("y",)))))


@pytest.mark.parametrize("name", CASES)
def test_a_spelling_means_the_same(name: str, runtimes: Runtimes) -> None:
    nodes, feeds, oracle = CASES[name]
    (expected,) = runtimes.tensorflow_message(handmade.graph_def(oracle or nodes, producer=24), feeds, ["y"])
    made = normalised(nodes)
    assert difference(expected, run_graph(made, feeds, ["out"])["out"]) is None
    # and in the words of TensorFlow 1.4
    assert difference(expected, runtimes.tensorflow(made, feeds, ["out"])[0]) is None


@pytest.mark.parametrize("name", CASES)
def test_one_spelling_is_left(name: str) -> None:
    made = normalised(CASES[name][0])
    for each in made.nodes:
        assert each.op in TABLE
        assert TABLE[each.op].older is None
        assert each.attrs.get("data_format", "NHWC") == "NHWC"
        assert each.attrs.get("padding") != "EXPLICIT"
        wanted = {a.name for a in TABLE[each.op].attrs if a.derive is None}
        assert each.op == "Const" or each.attrs.keys() == wanted
    again = normalise(made)
    assert [(n.name, n.op, n.inputs) for n in again.nodes] == [(n.name, n.op, n.inputs) for n in made.nodes]


def test_old_division_of_integers_cuts_off(runtimes: Runtimes) -> None:
    nodes, feeds, _ = binary("Div", ints(3, 4), np.array([1, -2, 3, -4], np.int32))
    (expected,) = runtimes.tensorflow_message(handmade.graph_def(nodes, producer=24), feeds, ["y"])
    assert difference(expected, run_graph(normalised(nodes), feeds, ["out"])["out"]) is None


def test_origins_follow_what_an_op_becomes() -> None:
    nodes, _, _ = CASES["DivNoNan"]
    made = normalised(nodes)
    assert made.producer(made["out"].inputs[0]).origin == "y:0"


def test_a_default_that_the_signature_names_becomes_a_placeholder() -> None:
    attrs = {"dtype": FLOAT32, "shape": TensorShape((None, 2))}
    made = as_placeholder(Node("p", "PlaceholderWithDefault", ("d",), attrs, origin="p:0"))
    assert made == Node("p", "Placeholder", (), attrs, origin="p:0")


# ------------------------------------------------------------------ refusals

REFUSED: Mapping[str, Sequence[Any]] = {
    "NHWC_VECT_C": binary("BiasAdd", IMAGE, f32(1, 2, 3), data_format="NHWC_VECT_C")[0],
    "explicit padding": unary(
        "MaxPool",
        IMAGE,
        padding="EXPLICIT",
        explicit_paddings=(0, 0, 1, 1, 1, 1, 0, 0),
        strides=(1, 2, 2, 1),
        ksize=(1, 2, 2, 1),
    )[0],
    "Truncate": unary("Cast", floats(2, 3), SrcT=F32, DstT=np.int32, Truncate=True)[0],
    "batch_dims": [
        placeholder("x", (None, 3)),
        constant("i", np.array([[0], [1]], np.int32)),
        constant("axis", 1),
        node("y", "GatherV2", "x", "i", "axis", batch_dims=1),
    ],
    "incompatible_shape_error": binary("Equal", floats(2, 3), f32(1, 2, 3), incompatible_shape_error=False)[0],
    "plain product": summed("aa->a", floats(2, 2))[0],
    "axes that are computed": [
        placeholder("x", (None, 3)),
        placeholder("i", (1,), np.int32),
        node("y", "ReverseV2", "x", "i"),
    ],
    "its blocks are": [
        placeholder("x", (None, 2, 2, 3)),
        constant("block", np.array([0, 2], np.int32)),
        constant("crops", np.zeros((2, 2), np.int32)),
        node("y", "BatchToSpaceND", "x", "block", "crops", T=F32, Tblock_shape=np.int32, Tcrops=np.int32),
    ],
    "training mode": batch_norm("FusedBatchNormV3", IMAGE, is_training=True)[0],
}


@pytest.mark.parametrize("said", REFUSED)
def test_other_meanings_are_refused(said: str) -> None:
    nodes = REFUSED[said]
    with pytest.raises(UnsupportedOpError, match=said) as caught:
        normalised(nodes)
    assert caught.value.issues == (("y", nodes[-1].op),)


def test_statistics_of_a_batch_are_told_from_those_of_a_row() -> None:
    with pytest.raises(UnsupportedOpError, match="in training mode"):
        normalised(layer_norm(scale=2.0)[0])


def rows_as_channels(turned: bool) -> list[Any]:
    """The image [1, rows, n, 1] of x [B, 2], whose lengths are computed; or [1, n, rows, 1] of x turned round."""
    zero, one = constant("zero", [0]), constant("next", [1])
    return [
        placeholder("x", (None, 2)),
        *(zero, one, constant("past", [2]), constant("one", 1), constant("order", [1, 0])),
        *(constant("empty", np.zeros(0, F32)), constant("f1", 1.0), constant("f0", 0.0)),
        node("turned", "Transpose", "x", "order", T=F32, Tperm=np.int32),
        node("lengths", "Shape", "x", T=F32, out_type=np.int32),
        *(node(n, "StridedSlice", "lengths", a, b, "next", T=np.int32, Index=np.int32, shrink_axis_mask=1)
          for n, a, b in (("rows", "zero", "next"), ("n", "next", "past"))),
        node("shape", "Pack", "one", *(("n", "rows") if turned else ("rows", "n")), "one", T=np.int32, N=4, axis=0),
        node("image", "Reshape", "turned" if turned else "x", "shape", T=F32, Tshape=np.int32),
        node("count", "Pack", "n" if turned else "rows", T=np.int32, N=1, axis=0),
        *(node(n, "Fill", "count", v, T=F32, index_type=np.int32) for n, v in (("scale", "f1"), ("offset", "f0"))),
        node("y", "FusedBatchNormV3", "image", "scale", "offset", "empty", "empty", T=F32, U=F32, epsilon=0.001,
             data_format="NCHW", is_training=True, exponential_avg_factor=1.0),
    ]  # fmt: skip


def test_agents_are_told_from_what_a_row_has() -> None:
    x = floats(5, 2)
    made = run_graph(normalised(rows_as_channels(turned=False)), {"x": x}, ["out"])["out"]
    centred = x - x.mean(1, keepdims=True)
    expected = centred / np.sqrt(x.var(1, keepdims=True) + 0.001)
    np.testing.assert_allclose(made, expected[None, :, :, None], 1e-5, 1e-6)
    with pytest.raises(UnsupportedOpError, match="in training mode"):
        normalised(rows_as_channels(turned=True))


def test_channels_that_mix_agents_are_no_rows() -> None:
    nodes = rows_as_channels(turned=False)
    mixed = [
        node("image", "Reshape", "turned", "shape", T=F32, Tshape=np.int32) if n.name == "image" else n for n in nodes
    ]
    with pytest.raises(UnsupportedOpError, match="in training mode"):
        normalised(mixed)


def test_all_unknown_ops_are_named() -> None:
    nodes = [placeholder("x"), node("a", "Cholesky", "x"), node("b", "Lu", "a"), node("y", "Neg", "b", T=F32)]
    with pytest.raises(UnsupportedOpError, match=r"Cholesky \(node 'a'\), Lu \(node 'b'\)") as caught:
        normalised(nodes)
    assert caught.value.issues == (("a", "Cholesky"), ("b", "Lu"))


def test_ops_that_reach_outside_are_refused_as_such() -> None:
    with pytest.raises(UnsupportedOpError, match="reaches outside"):
        normalised([constant("file", 1), node("y", "ReadFile", "file")])


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (node("y", "MaxPool", "x", strides=(1, 2, 2, 1), padding="SAME"), "lacks the attribute 'ksize'"),
        (node("y", "Cast", "x", SrcT=F32, DstT=3), "DstT=3; it must be a dtype"),
    ],
)
def test_damaged_attributes_are_named(made: Any, said: str) -> None:
    with pytest.raises(GraphError, match=said):
        normalised([placeholder("x"), made])


def test_a_graph_in_the_common_spelling_stays_as_it_is() -> None:
    nodes = [placeholder("x"), *handmade.dense("d", "x", 3, 2), node("y", "Tanh", "d", T=F32)]
    read = from_graph_def(handmade.graph_def(nodes, producer=24))
    made = normalise(read)
    assert [(n.name, n.op, n.inputs, n.origin) for n in made.nodes] == [
        (n.name, n.op, n.inputs, n.origin) for n in topological(read.nodes)
    ]


def test_what_jax_wrote_says_how_to_export_it() -> None:
    with pytest.raises(UnsupportedOpError, match=r"XlaCallModule \(node 'y'\)(?s:.)*jax2onnx"):
        normalised([placeholder("x"), node("y", "XlaCallModule", "x")])
