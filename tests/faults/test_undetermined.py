"""Numbers that float32 does not decide: log(sigmoid(x)), as PyTorch exports LogSigmoid, of a sigmoid that may be zero.

Runtimes give -∞, -103, -97 or -87 there, and agree wherever the sigmoid has its digits; onnxruntime and TensorFlow show
it, and a fault that changes ordinary numbers is found beside it all the same.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.underflow import End, Whole
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify.excuses import FLOAT64
from export_model.exporter.verify.rounding import hull
from tests.faults.test_blind_spots import Arrays, Feeds, honest, verified
from tests.handmade import constant, dense, graph_bytes, node, placeholder
from tests.onnx_reader.models import floats, model, save
from tests.onnx_reader.models import node as onnx_node


def logarithms(folder: Path, before_log: str = "Sigmoid") -> Path:
    """``action`` = a dense layer of the logarithm of another's sigmoid."""
    nodes = [
        placeholder("vector_observation"),
        *dense("first", "vector_observation", 3, 4),
        node("squashed", before_log, "first"),
        node("logarithm", "Log", "squashed"),
        constant("kernel", np.linspace(-1, 1.2, 8, dtype=np.float32).reshape(4, 2)),
        node("action", "MatMul", "logarithm", "kernel", transpose_a=False, transpose_b=False),
    ]
    (folder / "logarithms.bytes").write_bytes(graph_bytes(nodes))
    return folder / "logarithms.bytes"


@pytest.mark.parametrize("runtimes", ["tensorflow", "onnxruntime", "tensorflow,onnxruntime"])
def test_runtimes_agree_where_float32_has_an_answer(runtimes: str, tmp_path: Path, processes: RuntimePool) -> None:
    """TensorFlow and onnxruntime make NaN of it at some far inputs where our kernels, and the other, have a number."""
    for runtime in runtimes.split(","):
        pytest.importorskip(runtime)
    nodes = [
        onnx_node("MatMul", ["obs", "w"], "first"),
        onnx_node("Sigmoid", ["first"], "squashed"),
        onnx_node("Log", ["squashed"], "logarithm"),
        onnx_node("MatMul", ["logarithm", "u"], "actions"),
    ]
    weights = {"w": floats(3, 4), "u": floats(4, 2)}
    source = save(model(nodes, {"obs": (np.float32, ["b", 3])}, ["actions"], weights), tmp_path)
    options = ExportOptions(tmp_path / "out", ("bytes", "onnx"), verify=runtimes)
    (result,) = export([source], options, pool=processes)
    assert result.report is not None
    assert not [f for f in result.report.failures if f.judges]
    assert result.report.passed is True or "NaN or infinity beside a number" in result.report.undecided


def test_float64s_answer_is_right_where_the_original_has_infinity(tmp_path: Path, processes: RuntimePool) -> None:
    """onnxruntime's sigmoid is zero from -17 on, five deviations out: of 4,096 typical rows a few."""
    for runtime in ("tensorflow", "onnxruntime"):
        pytest.importorskip(runtime)
    nodes = [
        onnx_node("MatMul", ["obs", "w"], "first"),
        onnx_node("Sigmoid", ["first"], "squashed"),
        onnx_node("Log", ["squashed"], "logarithm"),
        onnx_node("MatMul", ["logarithm", "u"], "actions"),
    ]
    rng = np.random.default_rng(1)
    weights = {"w": rng.normal(0, 2, (3, 16)).astype(np.float32), "u": rng.normal(0, 0.3, (16, 2)).astype(np.float32)}
    source = save(model(nodes, {"obs": (np.float32, ["b", 3])}, ["actions"], weights), tmp_path)
    options = ExportOptions(tmp_path / "out", ("bytes",), verify="tensorflow,onnxruntime")
    (result,) = export([source], options, pool=processes)
    assert result.report is not None and result.report.passed is True, result.report.sentence
    assert FLOAT64.title in {f.excuse.title for c in result.report.comparisons for f in c.forgiven}


def test_float64_forgives_its_own_answer_alone() -> None:
    ends = [np.array([[end]], np.float32) for end in (-np.inf, -17.2, -18.0)]
    right, ordinary = np.array([[-np.inf]], np.float32), {"ordinary": True}
    for answer, forgiven in ((-18.0, True), (0.0, False), (-17.9, False), (-np.inf, False), (np.nan, False)):
        ((excuse, mask),) = hull(ends, right, 0.0).forgive(np.array([[answer]]), right, **ordinary)
        assert (excuse, bool(mask.all())) == (FLOAT64, forgiven), answer
    same = [np.array([[-3.0]], np.float32)] * 3  # nothing there is near zero
    ((_, mask),) = hull(same, right, 0.0).forgive(np.array([[-3.0]]), right, **ordinary)
    assert not mask.any()


def lowest(feeds: Feeds, answers: Arrays) -> Arrays:
    """An answer that is a number where infinity is right, as far inputs make it."""
    return {n: np.nan_to_num(a, nan=np.nan, posinf=97, neginf=-97).astype(a.dtype) for n, a in answers.items()}


def test_a_number_in_place_of_infinity_is_no_fault_at_the_edges(tmp_path: Path, processes: RuntimePool) -> None:
    report = verified(logarithms(tmp_path), tmp_path, processes, lowest)
    assert report.passed is True, [f.explanation() for f in report.failures]


def test_nan_beside_a_number_is_no_agreement(tmp_path: Path, processes: RuntimePool) -> None:
    """Where a sigmoid that is taken for zero explains it, as onnxruntime's is from -17 on, nothing is verified."""
    source = logarithms(tmp_path)
    graph, kernel = read_graph(source.read_bytes()), np.linspace(-1, 1.2, 8, dtype=np.float32).reshape(4, 2)

    def squashed_to_zero(feeds: Feeds, answers: Arrays) -> Arrays:
        logs = run_graph(graph, {"vector_observation": feeds["state"]}, ["logarithm"])["logarithm"]
        with np.errstate(invalid="ignore"):
            made = np.where(logs < -17, -np.inf, logs).astype(np.float32) @ kernel
        return {n: np.where(np.isnan(made), made, a) for n, a in answers.items()}

    report = verified(source, tmp_path, processes, squashed_to_zero)
    assert report.passed is None, [f.explanation() for f in report.failures]
    assert "NaN or infinity beside a number" in report.undecided and report.verdict == "not verified"


@pytest.mark.parametrize("lie", [np.nan, np.inf])
def test_nan_beside_a_number_that_nothing_explains_is_a_fault(
    lie: float, tmp_path: Path, processes: RuntimePool
) -> None:
    """In the same policy, at far inputs where no sigmoid is near zero."""

    def far(feeds: Feeds, answers: Arrays) -> Arrays:
        there = np.abs(feeds["state"]).max(axis=1, initial=0) > 40
        told = there[:, None] & (np.abs(answers["action"]) < 1e-3)
        return {n: np.where(told, lie, a).astype(a.dtype) for n, a in answers.items()}

    assert verified(logarithms(tmp_path), tmp_path, processes, far).passed is False


def test_the_logarithm_of_a_zero_that_is_one_has_an_answer(tmp_path: Path, processes: RuntimePool) -> None:
    """A relu's zeros are exact: every runtime has -∞ there, and NaN of their sums.

    That is no fault and, of half of an output, no proof; whatever else is answered is a fault all the same.
    """

    def zero(feeds: Feeds, answers: Arrays) -> Arrays:
        return {n: np.zeros_like(a) for n, a in answers.items()}

    for number, lie in enumerate((lowest, zero)):
        assert verified(logarithms(tmp_path, "Relu"), tmp_path / str(number), processes, lie).passed is False
    report = verified(logarithms(tmp_path, "Relu"), tmp_path / "honest", processes, honest)
    assert report.passed is None
    assert "NaN on both sides" in report.undecided


def infinite_at_ordinary_inputs(feeds: Feeds, answers: Arrays) -> Arrays:
    ordinary = np.abs(feeds["state"]).max(axis=1, initial=0) < 2
    return {n: np.where(ordinary[:, None], -np.inf, a).astype(a.dtype) for n, a in answers.items()}


def off_at_ordinary_inputs(feeds: Feeds, answers: Arrays) -> Arrays:
    ordinary = np.abs(feeds["state"]).max(axis=1, initial=0) < 2
    return {n: np.where(ordinary[:, None], a + 1e-3, a).astype(a.dtype) for n, a in answers.items()}


@pytest.mark.parametrize("fault", [infinite_at_ordinary_inputs, off_at_ordinary_inputs])
def test_a_fault_at_ordinary_inputs_is_found(fault: object, tmp_path: Path, processes: RuntimePool) -> None:
    report = verified(logarithms(tmp_path), tmp_path, processes, fault)  # type: ignore[arg-type]
    assert report.passed is False and "action" in {f.output for f in report.failures}


def test_a_fault_at_far_inputs_is_found_where_numbers_are_finite(tmp_path: Path, processes: RuntimePool) -> None:
    def far(feeds: Feeds, answers: Arrays) -> Arrays:
        return {n: np.where(np.abs(a) > 1e3, -np.inf, a).astype(a.dtype) for n, a in answers.items()}

    nodes = [placeholder("vector_observation"), *dense("action", "vector_observation", 3, 2)]
    (tmp_path / "linear.bytes").write_bytes(graph_bytes(nodes))
    assert verified(tmp_path / "linear.bytes", tmp_path, processes, far).passed is False


@pytest.mark.parametrize(
    ("op", "values", "undetermined"),
    [
        ("Sigmoid", [-1e3, -90, -30, -17, -14, 0, 30], [True, True, True, True, False, False, False]),
        ("Exp", [-1e3, -104, -90, -87.5, -30, 0, 30], [True, True, True, True, False, False, False]),
        ("Relu", [-1e3, -1, 0, 1e-38, 1e-30, 1, 30], [False, False, False, True, False, False, False]),
    ],
)
def test_an_answer_lies_between_the_ends_of_what_is_not_told_from_zero(
    op: str, values: list[float], undetermined: list[bool]
) -> None:
    nodes = [
        Node("x", "Placeholder", attrs={"dtype": np.dtype(np.float32), "shape": TensorShape((None,))}),
        Node("made", op, ("x",)),
        Node("y", "Log", ("made",)),
    ]
    graph, feeds = Graph(tuple(nodes)), {"x": np.array(values, np.float32)}
    runs = (End("processor", kept=False), End("processor", kept=True), Whole(0))
    zero, kept, whole = (run_graph(graph, feeds, ["y"], run)["y"] for run in runs)
    found = hull((zero, kept, whole), run_graph(graph, feeds, ["y"])["y"], 0.0)
    assert found.open.tolist() == found.holds(whole).tolist() == undetermined
    assert not found.holds(np.full(len(values), np.nan)).any()
    assert not found.holds(np.full(len(values), 3.0)).any()


def test_float64_says_what_float32_cannot() -> None:
    nodes = [
        Node("x", "Placeholder", attrs={"dtype": np.dtype(np.float32), "shape": TensorShape((None,))}),
        Node("y", "Log", ("made",)),
    ]
    nodes.insert(1, Node("made", "Sigmoid", ("x",)))
    feeds = {"x": np.float32([-200, -30, 3])}
    whole = run_graph(Graph(tuple(nodes)), feeds, ["y"], Whole(0))["y"]
    np.testing.assert_allclose(whole, -np.logaddexp(0, -feeds["x"].astype(np.float64)), rtol=1e-12)
