"""Samplers of ONNX: draws come in as inputs on both sides, and what stays a sampler has the right distribution."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from export_model.converters.formats.onnx import edit
from export_model.converters.formats.onnx.vetted import self_contained_model
from export_model.converters.graph.ops.samplers import reseed
from export_model.converters.graph.run import run_graph
from export_model.exporter.verify.statistics import fit
from tests.onnx_reader.models import Array, Bench, constant, floats, imported_graph, model, node, read

X = floats(4, 3)


def noisy(kind: str, **attributes: Any) -> Any:
    """x plus noise; the noise is read twice."""
    inputs = ["x"] if kind.endswith("Like") else []
    return model(
        [node(kind, inputs, "n", **attributes), node("Add", ["x", "n"], "s"), node("Mul", ["s", "n"], "y")],
        {"x": (np.float32, ["batch", 3])},
    )


@pytest.mark.parametrize("mean", [0.0, 1.5])
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_draws_of_normals_are_fed(mean: float, scale: float, bench: Bench) -> None:
    path = bench.place(noisy("RandomNormalLike", mean=mean, scale=scale))
    draws = floats(4, 3, seed=9)
    found, graph, names = imported_graph(path, ["y"])
    assert found.draws == ("n",)
    sampler = next(n for n in graph.nodes if n.op == "RandomStandardNormal")
    assert sampler.origin == "n"
    ours = run_graph(graph, {"x": X, sampler.name: draws}, names)[names[0]]
    theirs = bench.load(path, lift=["n"]).run({"x": X, "n": draws}, ["y"])["y"]
    np.testing.assert_allclose(theirs, ours, rtol=1e-6)
    np.testing.assert_allclose(ours, (X + draws * scale + mean) * (draws * scale + mean), rtol=1e-5)


def test_a_normal_of_a_given_shape(bench: Bench) -> None:
    path = bench.place(noisy("RandomNormal", shape=[4, 3]))
    found, graph, _ = imported_graph(path, ["y"])
    assert found.draws == ("n",)
    assert [n.op for n in graph.nodes if n.origin == "n"] == ["RandomStandardNormal"]


def test_a_fixed_number_of_rows_becomes_the_batch(bench: Bench) -> None:
    message = model([node("RandomNormal", [], "n", shape=[1, 3]), node("Add", ["x", "n"])], {"x": (np.float32, [1, 3])})
    path = bench.place(message)
    found, graph, names = imported_graph(path, ["y"])
    assert found.batch == 1
    assert run_graph(graph, {"x": X}, names)[names[0]].shape == (4, 3)


@pytest.mark.parametrize("kind", ["RandomUniform", "RandomUniformLike"])
def test_uniform_draws(kind: str, bench: Bench) -> None:
    rows = 4000
    more = {} if kind.endswith("Like") else {"shape": [rows, 1]}
    message = model(
        [node(kind, ["x"] if kind.endswith("Like") else [], "n", low=-1.0, high=3.0, **more), node("Add", ["x", "n"])],
        {"x": (np.float32, ["batch", 1])},
    )
    found, graph, names = imported_graph(bench.place(message), ["y"])
    assert found.draws == ()
    reseed(1)
    draws = run_graph(graph, {"x": np.zeros((rows, 1), np.float32)}, names)[names[0]]
    assert draws.min() >= -1
    assert draws.max() < 3
    ordered = np.sort(draws.reshape(-1))
    assert np.abs((ordered + 1) / 4 - np.arange(rows) / rows).max() < 3.3 / math.sqrt(rows)


@pytest.mark.parametrize(("number", "dtype"), [(6, np.int32), (7, np.int64)])
def test_multinomial(number: int, dtype: Any, bench: Bench) -> None:
    logits = np.log(np.array([[0.1, 0.0, 0.6, 0.3]], np.float32) + 1e-30)
    message = model([node("Multinomial", ["x"], dtype=number, sample_size=2000)], {"x": (np.float32, ["batch", 4])})
    path = bench.place(message)
    _, graph, names = imported_graph(path, ["y"])
    reseed(1)
    for draws in (run_graph(graph, {"x": logits}, names)[names[0]], bench.onnxruntime(path, {"x": logits}, ["y"])[0]):
        assert draws.dtype == dtype
        assert draws.shape == (1, 2000)
        assert fit(draws, logits[0]) > 1e-6


def test_integer_seeds_are_read_and_repaired(bench: Bench) -> None:
    """tf2onnx 1.5.5 wrote the seed as an integer; onnxruntime refuses the file as it is."""
    message = noisy("RandomNormalLike", seed=7)
    assert message.graph.node[0].attribute[0].type == 2
    path = bench.place(message)
    assert read(message, bench.folder).integer_seeds
    draws = floats(4, 3, seed=9)
    for lift, feeds in (["n"], {"n": draws}), ([], {}):
        result = bench.load(path, lift=lift).run({"x": X, **feeds}, ["y"])["y"]
        assert result.shape == (4, 3)


# ------------------------------------------------------------------ inner values of the original


def two_outputs() -> Any:
    """A model whose second output needs an input that the first does not, and a body that reads from outside."""
    return model(
        [
            constant("two", 2),
            node("Mul", ["x", "two"], "inner"),
            node("Relu", ["inner"], "y"),
            node("Add", ["inner", "extra"], "z"),
        ],
        {"x": (np.float32, ["batch", 3]), "extra": (np.float32, ["batch", 3]), "unused": (np.float32, ["batch", 3])},
        ["y", "z"],
    )


@pytest.mark.parametrize("fetch", [["inner"], ["y", "inner"], ["y"]])
def test_inner_values_are_fetched_and_needless_inputs_are_not_asked_for(fetch: Sequence[str], bench: Bench) -> None:
    loaded = bench.load(bench.place(two_outputs()), lift=[])
    results = loaded.run({"x": X}, fetch)
    expected = {"inner": X * 2, "y": np.maximum(X * 2, 0)}
    for name in fetch:
        np.testing.assert_array_equal(results[name], expected[name])


def test_what_is_cut_keeps_only_what_is_needed(bench: Bench) -> None:
    part = edit.cut(self_contained_model(bench.place(two_outputs())), ["y"])
    assert [n.op_type for n in part.graph.node] == ["Constant", "Mul", "Relu"]
    assert [i.name for i in part.graph.input] == ["x"]


def test_bodies_keep_what_they_read(bench: Bench) -> None:
    from tests.onnx_reader.cases.layers import CASES

    case = next(c for c in CASES if c.op == "Scan")
    path = bench.place(case.model(15))
    results: dict[str, Array] = bench.load(path, lift=[]).run(dict(case.feeds), list(case.outputs))
    for name, wanted in zip(case.outputs, bench.onnxruntime(path, case.feeds, case.outputs), strict=True):
        np.testing.assert_array_equal(results[name], wanted)
