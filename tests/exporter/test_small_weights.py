"""``--dtype float16`` and ``--quantize int8``: smaller files, the same numbers in each, decisions that hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from export_model.converters.compiler.passes.int8_products import join_products, multiply_products
from export_model.converters.compiler.passes.weights import LEAST, Storage, are_steps, compact, round_weights
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.registry import DEFAULTS, WRITTEN
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.export.sources import read_source
from export_model.exporter.reports.entry import of_result
from export_model.exporter.reports.markdown import markdown_text
from export_model.exporter.reports.page import page
from export_model.exporter.tables import size_text
from export_model.exporter.verify.checks import decisions as check
from export_model.signatures.errors import UsageError
from fixtures import path as fixture
from tests.exporting import export_model, verify_bundle

_KEPT: tuple[Storage, ...] = ("float16", "int8")


def graph_of(weights: np.ndarray, op: str = "MatMul", **attrs: object) -> Graph:
    return Graph((Node("x", "Placeholder"), Node("w", "Const", value=weights), Node("y", op, ("x", "w"), attrs)))


def drawn(*shape: int, seed: int = 0) -> np.ndarray:
    """Weights whose channels differ a thousandfold."""
    rng = np.random.default_rng(seed)
    return (rng.standard_normal(shape) * 10.0 ** rng.uniform(-2, 1, shape[-1])).astype(np.float32)


@pytest.mark.parametrize("storage", _KEPT)
@pytest.mark.parametrize("turned", [False, True], ids=["", "transposed"])
def test_what_is_rounded_comes_back_to_the_bit(storage: Storage, turned: bool) -> None:
    whole = drawn(24, 40).T if turned else drawn(40, 24)
    made = round_weights(graph_of(whole, transpose_b=turned), storage)["w"].value
    assert made is not None and made.dtype == np.float32 and not np.array_equal(made, whole)
    axis = 0 if turned else 1
    limit = np.abs(whole).max(axis=1 - axis, keepdims=True) * (2.0**-11 if storage == "float16" else 0.51 / 127)
    assert (np.abs(made - whole) <= limit).all()
    found = compact(made, storage)
    assert found is not None
    narrow, step = found
    assert narrow.nbytes * (2 if storage == "float16" else 4) == whole.nbytes
    back = narrow.astype(np.float32) if step is None else narrow.astype(np.float32) * step
    assert back.tobytes() == np.ascontiguousarray(made).tobytes()


@pytest.mark.parametrize(
    "kept",
    [
        graph_of(drawn(5, 3)),
        graph_of(drawn(LEAST), "BiasAdd"),
        graph_of(drawn(20, 20), "Sub"),
        graph_of(np.eye(20, dtype=np.float32)),
        graph_of(np.where(drawn(20, 20) > 0, np.float32(np.inf), 0).astype(np.float32)),
    ],
    ids=["small", "bias", "normaliser", "whole numbers", "infinite"],
)
def test_what_needs_every_digit_keeps_it(kept: Graph) -> None:
    for storage in ("float16", "int8"):
        assert round_weights(kept, storage)["w"] == kept["w"]


def test_what_float16_cannot_hold_stays() -> None:
    large = graph_of(drawn(40, 24) * np.float32(1e6))
    assert round_weights(large, "float16")["w"] == large["w"]


def test_tensorflow_js_multiplies_the_products_of_layers_and_not_their_matrices() -> None:
    matrix = round_weights(graph_of(drawn(40, 24)), "int8")["w"].value
    plain = Graph(
        (
            Node("x", "Placeholder", attrs={"dtype": np.dtype(np.float32), "shape": TensorShape((None, 40))}),
            Node("w", "Const", value=matrix),
            Node("b", "Const", value=drawn(24)),
            Node("product", "MatMul", ("x", "w"), {"transpose_a": False, "transpose_b": False}),
            Node("y", "BiasAdd", ("product", "b"), {"data_format": "NHWC"}),
        )
    )
    made = multiply_products(plain)
    product = made.producer(made["product"].inputs[0])
    assert (made["product"].op, product.op) == ("Mul", "MatMul")
    steps = made[product.inputs[1]].value
    assert steps is not None and are_steps(steps)
    x = drawn(5, 40, seed=3)
    was, now = (run_graph(g, {"x": x}, ["y", "w"]) for g in (plain, made))
    np.testing.assert_allclose(now["y"], was["y"], rtol=1e-5, atol=1e-5 * np.abs(was["y"]).max())
    assert now["w"].tobytes() == was["w"].tobytes()  # who looks inside finds it
    again = join_products(made)
    assert again["product"].op == "MatMul" and again["product"].inputs == ("x", "w")
    assert run_graph(again, {"x": x}, ["y"])["y"].tobytes() == was["y"].tobytes()


def test_a_matrix_that_is_turned_or_read_by_others_is_multiplied_itself() -> None:
    matrix = round_weights(graph_of(drawn(24, 40).T, transpose_b=True), "int8")["w"].value
    for other in (("y", "MatMul", ("x", "w"), {"transpose_b": True}), ("y", "Square", ("w",), {})):
        plain = Graph((Node("x", "Placeholder"), Node("w", "Const", value=matrix), Node(*other)))
        assert multiply_products(plain)["y"] == plain["y"] and multiply_products(plain)["w"].op == "Mul"
        assert join_products(multiply_products(plain))["y"] == plain["y"]


@pytest.mark.parametrize(
    "odd",
    [
        Node("odd", "Mul", ()),
        Node("odd", "Mul", ("bare", "w/step")),
        Node("odd", "Mul", ("turned", "w/step")),
        Node("odd", "Mul", ("w/int8",)),
    ],
)
def test_what_anyone_may_have_written_stays_as_it_is(odd: Node) -> None:
    steps = np.random.default_rng(0).integers(-127, 128, (24, 24)).astype(np.float32)
    assert are_steps(steps)
    graph = Graph(
        (
            Node("x", "Placeholder", attrs={"dtype": np.dtype(np.float32), "shape": TensorShape((None, 24))}),
            Node("w/int8", "Const", value=steps),
            Node("w/step", "Const", value=np.ones((1, 24), np.float32)),
            Node("w", "Mul", ("w/int8", "w/step")),
            Node("bare", "MatMul", ("x",)),
            Node("turned", "MatMul", ("x", "w/int8"), {"transpose_b": True}),
            odd,
        )
    )
    assert join_products(graph) is graph


@pytest.mark.parametrize("storage", _KEPT)
def test_every_format_holds_the_same_numbers(storage: Storage, tmp_path: Path) -> None:
    ((_, policy),) = read_source(fixture("visual")).compile_models()
    (result,) = export_model(
        fixture("visual"),
        tmp_path,
        verify="none",
        **({"dtype": "float16"} if storage == "float16" else {"quantize": "int8"}),
    )
    wanted = round_weights(policy.graph, storage)
    changed = {
        n.value.tobytes() for n in wanted.nodes if n.value is not None and n.value is not policy.graph[n.name].value
    }
    assert len(changed) >= 3 and result.contract["tool"]["weights"] == storage
    for key in DEFAULTS:
        form = WRITTEN[key]
        again = read_source(result.folder / form.main_of(result.policy.name))
        ((_, read),) = again.compile_models()
        assert changed <= {n.value.tobytes() for n in read.graph.nodes if n.value is not None}, key
        assert result.sizes[key] < form.artifact(policy, WriteOptions("{}")).size * 0.9
    assert {*result.whole_sizes} == {*DEFAULTS}


@pytest.mark.parametrize("storage", _KEPT)
def test_runtimes_run_it_and_decisions_are_told(storage: Storage, tmp_path: Path, runtimes: RuntimePool) -> None:
    options = {"dtype": "float16"} if storage == "float16" else {"quantize": "int8"}
    (result,) = export_model(fixture("recurrent"), tmp_path, verify="numpy,tensorflow,onnxruntime,tfjs-wasm", **options)
    report = result.report
    assert report is not None and report.passed, report
    ran = {(c.format, c.runtime) for c in report.comparisons}
    assert {
        ("bytes", "tensorflow"),
        ("saved_model", "tensorflow"),
        ("tfjs", "tfjs-wasm"),
        ("onnx", "onnxruntime"),
    } <= ran
    (decided,) = [c for c in report.comparisons if c.kind == "decisions"]
    assert (decided.output, decided.runtime) == ("deterministic_action", storage)
    assert decided.max_abs_diff <= check.LIMITS[storage]
    assert all(report.whole_sizes[k] > size for k, size in report.sizes.items())
    entry = of_result(result, 1)
    assert entry is not None
    for key, size in report.sizes.items():
        said = f"{size_text(size)} of {size_text(report.whole_sizes[key])}"
        assert said in markdown_text([entry]) and page([entry]).count(said) >= 2  # in the table and among the sizes
    again = verify_bundle(result.folder, source=fixture("recurrent"), runtimes="numpy,tensorflow")
    assert [c.reason for c in again.comparisons if c.kind == "decisions"] == [decided.reason]
    assert not [c for c in verify_bundle(result.folder, runtimes="onnxruntime").comparisons if c.kind == "decisions"]


def test_too_many_other_decisions_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(check.LIMITS, "int8", 1e-6)
    (result,) = export_model(
        fixture("continuous"),
        tmp_path,
        to="onnx",
        quantize="int8",
        verify="numpy,onnxruntime",
        strict=False,
    )
    assert result.passed is False and result.folder.name == "continuous.failed"
    (failed,) = result.report.failures if result.report is not None else ()
    assert failed.kind == "decisions" and "of its spread" in failed.sentence()


@pytest.mark.parametrize(
    ("was", "made", "share"),
    [
        (np.array([[0], [1], [2], [3]]), np.array([[0], [1], [2], [0]]), 0.25),
        (np.array([[-1.0], [1.0]]), np.array([[-1.1], [0.9]]), 0.1),
        (np.array([[5.0, -1.0], [5.0, 1.0]]), np.array([[5.0, -1.0], [5.0, 1.0]]), 0.0),
        (np.array([[0.0], [0.0]]), np.array([[0.0], [1e-9]]), np.inf),
        (np.array([[1.0]]), np.array([[np.nan]]), np.inf),
    ],
    ids=["choices", "spread", "same", "what never varied", "not a number"],
)
def test_shares(was: np.ndarray, made: np.ndarray, share: float) -> None:
    assert check.compare_decisions(was, made)[0] == pytest.approx(share)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"dtype": "float16", "for_": "unity6"}, "--dtype float16 does not go with --for unity6"),
        ({"quantize": "int8", "to": "onnx,nn"}, "--quantize int8 does not go with --to nn"),
        ({"dtype": "float16", "quantize": "int8"}, "contradict"),
        ({"dtype": "bfloat16"}, "not kept in 'bfloat16'"),
        ({"quantize": "int4"}, "not kept in 'int4'"),
    ],
)
def test_what_cannot_be_is_refused(asked: dict[str, str], said: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=said):
        export_model(fixture("discrete"), tmp_path, verify="none", **asked)  # type: ignore[arg-type]
    assert not any(tmp_path.iterdir())
