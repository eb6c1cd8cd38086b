"""Ops that choose and put by place, and equations with ``…``, on many random arguments against TensorFlow.

The reshapes are node for node what onnx-tf's SavedModels have.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from export_model.converters.compiler.passes.fold import fold
from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.formats.frozen_graph.reader import from_graph_def
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.signatures.errors import GraphError, UnsupportedOpError
from tests import handmade
from tests.graph.harness import Array, Runtimes, difference
from tests.graph.samples import floats
from tests.handmade import NodeDef, constant, graph_bytes, node, placeholder

pytestmark = pytest.mark.xdist_group("graph-passes")

F32, I64 = np.float32, np.int64


def agrees(nodes: list[NodeDef], feeds: dict[str, Array], fetches: list[str], runtimes: Runtimes) -> list[str]:
    """The ops that are left of nodes which compute what TensorFlow computes of them."""
    expected = runtimes.tensorflow_message(handmade.graph_def(nodes, producer=24), feeds, fetches)
    read = from_graph_def(handmade.graph_def(nodes, producer=24))
    pins = [Node(f"out_{i}", "Identity", (name,)) for i, name in enumerate(fetches)]
    made = fold(normalise(Graph((*read.nodes, *pins))))
    results = run_graph(made, feeds, [p.name for p in pins])
    problems = {f: difference(e, results[p.name]) for f, p, e in zip(fetches, pins, expected, strict=True)}
    assert {f: p for f, p in problems.items() if p} == {}
    return sorted({n.op for n in made.prune([p.name for p in pins]).nodes})


# ------------------------------------------------------------------ equations


def equations(count: int, seed: int) -> tuple[list[NodeDef], dict[str, Array], list[str]]:
    """So many Einsums of two operands with shared, own and summed labels, and axes of '…' that are broadcast."""
    random = np.random.default_rng(seed)
    lengths = dict(zip("abcd", (2, 3, 4, 5), strict=True))
    nodes, feeds, fetches = [], {}, []
    for number in range(count):
        labels = list(random.permutation([*"abcd"]))
        batch, inner, rows, columns = labels
        terms = [[*random.permutation([batch, inner, own])] for own in (rows, columns)]
        wide = [int(n) for n in random.integers(2, 5, 2)]
        operands = []
        for side, term in enumerate(terms):
            if random.random() < 0.3:
                term.remove(random.choice(term))
            at = int(random.integers(0, len(term) + 1))
            free = [n if random.random() < 0.7 else 1 for n in wide[int(random.integers(0, 3)) :]]
            shape = [*(lengths[c] for c in term[:at]), *free, *(lengths[c] for c in term[at:])]
            terms[side] = [*term[:at], "...", *term[at:]]
            operands.append(floats(*shape, seed=2 * number + side))
        held = {c for t in terms for c in t if c != "..."}
        kept = [c for c in random.permutation(sorted(held)) if c != inner]
        kept.insert(int(random.integers(0, len(kept) + 1)), "...")
        equation = f"{''.join(terms[0])},{''.join(terms[1])}->{''.join(kept)}"
        names = [f"x{number}_{side}" for side in range(2)]
        nodes += [placeholder(n, a.shape) for n, a in zip(names, operands, strict=True)]
        nodes.append(node(f"y{number}", "Einsum", *names, equation=equation, N=2, T=F32))
        feeds |= dict(zip(names, operands, strict=True))
        fetches.append(f"y{number}")
    return nodes, feeds, fetches


def test_equations_with_dots(runtimes: Runtimes) -> None:
    assert "Einsum" not in agrees(*equations(150, seed=3), runtimes)


@pytest.mark.parametrize(
    ("equation", "said"), [("...i->i", "not in its result"), ("ab...i->b...", "does not fit"), ("..i->..i", "plain")]
)
def test_other_equations_are_refused_by_name(equation: str, said: str) -> None:
    nodes = [placeholder("x", (None, 3)), node("y", "Einsum", "x", equation=equation, N=1, T=F32)]
    with pytest.raises(UnsupportedOpError, match=rf"Einsum \(node 'y'\).*{said}"):
        normalise(from_graph_def(handmade.graph_def(nodes, producer=24)))


# ------------------------------------------------------------------ places


def test_places_are_found_and_filled(runtimes: Runtimes) -> None:
    random = np.random.default_rng(1)
    nodes: list[NodeDef] = [constant("none", 0.5)]
    feeds, fetches = {}, []
    for number in range(60):
        shape = tuple(int(n) for n in random.integers(1, 5, random.integers(1, 4)))
        mask = random.random(shape) < 0.5
        where, dense = f"where{number}", f"dense{number}"
        values = random.standard_normal(int(mask.sum())).astype(F32)
        feeds |= {f"m{number}": mask, f"v{number}": values}
        nodes += [
            placeholder(f"m{number}", shape, np.bool_),
            placeholder(f"v{number}", (None,)),
            constant(f"s{number}", np.array(shape, I64), I64),
            node(where, "Where", f"m{number}", T=np.bool_),
            node(dense, "SparseToDense", where, f"s{number}", f"v{number}", "none", T=F32, Tindices=I64,
                 validate_indices=True),
        ]  # fmt: skip
        fetches += [where, dense]
    agrees(nodes, feeds, fetches, runtimes)


@pytest.mark.parametrize("places", [[-1], [4], [2, 1], [1, 1]])
def test_places_that_tensorflow_refuses(places: list[int]) -> None:
    nodes = [
        placeholder("v", (None,)),
        *(constant("p", places), constant("s", [4]), constant("none", 0.0)),
        node("y", "SparseToDense", "p", "s", "v", "none", T=F32, Tindices=np.int32, validate_indices=True),
    ]
    made = normalise(from_graph_def(handmade.graph_def(nodes, producer=24)))
    with pytest.raises(GraphError, match="'y'"):
        run_graph(made, {"v": np.ones(len(places), F32)}, ["y"])


@pytest.mark.parametrize("k", [0, 5])
def test_more_than_there_are_cannot_be_taken(k: int) -> None:
    nodes = [placeholder("x", (None, 4)), constant("k", k), node("y", "TopKV2", "x", "k", T=F32)]
    with pytest.raises(UnsupportedOpError, match=rf"TopKV2 \(node 'y'\): it takes {k} of 4"):
        normalise(from_graph_def(handmade.graph_def(nodes, producer=24)))


# ------------------------------------------------------------------ onnx-tf


def onnx_tf_reshape(name: str, tensor: str, shape: list[int], dtype: Any = F32) -> list[NodeDef]:
    """Reshape as onnx-tf 1.10 writes it: a length of 0 is that of the operand."""
    n = name
    return [
        *(constant(f"{n}/to", np.array(shape, I64), I64), constant(f"{n}/0", np.array(0, I64), I64)),
        *(constant(f"{n}/axis", 0), constant(f"{n}/count", np.array([len(shape)], I64), I64)),
        node(f"{n}/lengths", "Shape", tensor, T=dtype, out_type=I64),
        node(f"{n}/equal", "Equal", f"{n}/to", f"{n}/0", T=I64, incompatible_shape_error=True),
        node(f"{n}/where", "Where", f"{n}/equal", T=np.bool_),
        node(f"{n}/places", "Squeeze", f"{n}/where", T=I64, squeeze_dims=(-1,)),
        node(f"{n}/gathered", "GatherV2", f"{n}/lengths", f"{n}/places", f"{n}/axis", Tparams=I64, Tindices=I64,
             Taxis=np.int32, batch_dims=0),
        node(f"{n}/scattered", "SparseToDense", f"{n}/places", f"{n}/count", f"{n}/gathered", f"{n}/0", T=I64,
             Tindices=I64, validate_indices=True),
        node(f"{n}/copied", "AddV2", f"{n}/to", f"{n}/scattered", T=I64),
        node(n, "Reshape", tensor, f"{n}/copied", T=dtype, Tshape=I64),
    ]  # fmt: skip


@pytest.mark.parametrize("batch", [None, 2])
@pytest.mark.parametrize("shape", [[0, -1], [-1, 12], [0, 0, 4], [-1, 6, 2], [0, 3, 2, 2]])
def test_a_reshape_of_onnx_tf_is_a_reshape(shape: list[int], batch: int | None, runtimes: Runtimes) -> None:
    nodes = [placeholder("x", (batch, 3, 4)), *onnx_tf_reshape("y", "x", shape)]
    left = agrees(nodes, {"x": floats(2, 3, 4)}, ["y"], runtimes)
    assert {"Where", "SparseToDense"}.isdisjoint(left)


@pytest.mark.parametrize("batch", [None, 1])
def test_a_policy_of_onnx_tf_is_exported(batch: int | None, tmp_path: Path, pool: RuntimePool) -> None:
    """With reshapes, TopKV2 and a guard against NaN, in every format; one agent, or any number."""
    nodes = [
        placeholder("vector_observation", (batch, 12)),
        *onnx_tf_reshape("grid", "vector_observation", [0, 3, 4]),
        *(constant("k", 2), constant("zero", np.zeros((), F32)), constant("w", handmade.weights(6, 2))),
        node("top", "TopKV2", "grid", "k", T=F32, sorted=True),
        node("fine", "IsFinite", "top", T=F32),
        node("safe", "SelectV2", "fine", "top", "zero", T=F32),
        *onnx_tf_reshape("flat", "safe", [0, 6]),
        node("out", "Einsum", "flat", "w", equation="...i,ij->...j", N=2, T=F32),
        node("action", "Tanh", "out", T=F32),
    ]
    source = tmp_path / "policy.pb"
    source.write_bytes(graph_bytes(nodes, producer=24))
    (bundle,) = export([source], ExportOptions(tmp_path / "out"), pool=pool)
    assert bundle.report is not None
    assert bundle.report.passed
