"""The numpy runner: what is computed, what may be fed, and what is an error."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.linear import matmul
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.run import run_graph
from export_model.exporter.verify.rounding import FACTOR, RUNS
from export_model.signatures.errors import ExportModelError, GraphError
from tests.graph.harness import Runtimes, policy_of
from tests.graph.making import const, graph, node, placeholder

pytestmark = pytest.mark.xdist_group("graph-ops")

X = np.arange(12, dtype=np.float32).reshape(2, 6)
CUT = {
    "Split": [const("axis", 1), node("cut", "Split", "axis", "x", num_split=3)],
    "SplitV": [const("axis", 1), const("sizes", [2, 2, 2]), node("cut", "SplitV", "x", "sizes", "axis", num_split=3)],
    "Unpack": [node("cut", "Unpack", "x", num=6, axis=1)],
}


def test_an_input_that_is_not_fed_is_named() -> None:
    with pytest.raises(GraphError, match="'x' is not fed"):
        run_graph(graph(placeholder("x", (None, 2)), node("y", "Neg", "x")), {}, ["y"])


@pytest.mark.parametrize("fed", ["cut", "cut:0", "cut:1"])
@pytest.mark.parametrize("op", CUT)
def test_the_other_outputs_of_a_node_are_computed_where_one_is_fed(op: str, fed: str) -> None:
    made = graph(placeholder("x", (None, 6)), *CUT[op])
    plain = run_graph(made, {"x": X}, ["cut", "cut:1", "cut:2"])
    given = np.full_like(plain["cut"], 7)
    found = run_graph(made, {"x": X, fed: given}, ["cut", "cut:1", "cut:2"])
    for name, value in plain.items():
        np.testing.assert_array_equal(found[name], given if name == fed.removesuffix(":0") else value)


@pytest.mark.parametrize("op", CUT)
def test_nothing_behind_a_fed_output_is_needed(op: str) -> None:
    made = graph(placeholder("x", (None, 6)), *CUT[op], node("y", "Neg", "cut:1"))
    given = np.ones((2, 2), np.float32)
    np.testing.assert_array_equal(run_graph(made, {"cut:1": given}, ["y"])["y"], -given)
    with pytest.raises(GraphError, match="'x' is not fed"):
        run_graph(made, {"cut:1": given}, ["y", "cut:2"])


@pytest.mark.parametrize("index", [-1, 6])
@pytest.mark.parametrize("op", ["Gather", "GatherV2"])
def test_an_index_outside_of_its_axis_is_an_error_as_in_tensorflow(op: str, index: int, runtimes: Runtimes) -> None:
    operands = [const("axis", 0)] if op == "GatherV2" else []
    made = graph(
        placeholder("x", (6,)), placeholder("i", (None,), np.int32), *operands,
        node("y", op, "x", "i", *(o.name for o in operands)),
    )  # fmt: skip
    feeds = {"x": X[0], "i": np.array([0, index], np.int32)}
    with pytest.raises(GraphError, match="'y'"):
        run_graph(made, feeds, ["y"])
    with pytest.raises(ExportModelError, match="is not in \\[0, 6\\)"):
        runtimes.tensorflow(made, feeds, ["y"])


@pytest.mark.parametrize("backend", ["tfjs-cpu", "tfjs-wasm"])
def test_float16_inside_is_float32_in_tensorflow_js(backend: str, runtimes: Runtimes) -> None:
    made = graph(
        placeholder("x", (None, 3)),
        node("half", "Cast", "x", DstT=np.dtype(np.float16)),
        const("two", np.full(3, 2, np.float16)),
        node("doubled", "Mul", "half", "two"),
        node("y", "Cast", "doubled", DstT=np.dtype(np.float32)),
    )
    x = np.array([[0.5, -1.25, 3]], np.float32)
    (y,) = runtimes.tfjs(backend, policy_of(made, ["y"]), {"x": x})
    np.testing.assert_array_equal(y, x * 2, strict=True)


@pytest.mark.parametrize("terms", [16, 512])
def test_what_moving_each_weight_makes_is_known_of_large_ones(terms: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(terms)
    weights = rng.standard_normal((terms, 64)).astype(np.float32)
    nodes = [Node("x", "Placeholder"), Node("w", "Const", value=weights), Node("y", "MatMul", ("x", "w"))]
    feeds = {"x": rng.standard_normal((8, terms)).astype(np.float32)}
    exact = run_graph(Graph(tuple(nodes)), feeds, ["y"])["y"]

    def spread() -> float:
        moved = [run_graph(Graph(tuple(nodes)), feeds, ["y"], Jitter(seed))["y"] - exact for seed in range(20)]
        return float(np.sqrt(np.mean(np.square(moved, dtype=np.float64))))

    one_by_one = spread()
    monkeypatch.setattr("export_model.converters.graph.jitter._MOST_DRAWN", 0)
    assert 0.9 < spread() / one_by_one < 1.1


def test_a_large_product_is_computed_a_piece_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((3, 50)).astype(np.float32), rng.standard_normal((50, 17)).astype(np.float32)
    product = TABLE["MatMul"].kernel
    assert product is not None
    whole = product(Node("y", "MatMul"), a, b)
    monkeypatch.setattr("export_model.converters.graph.ops.linear._LARGE", 100)
    monkeypatch.setattr("export_model.converters.graph.ops.linear._AT_ONCE", 100)
    for each, other in ((Node("y", "MatMul"), b), (Node("y", "MatMul", attrs={"transpose_b": True}), b.T.copy())):
        np.testing.assert_allclose(product(each, a, other), whole, rtol=1e-6)


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize(("ulps", "absolute"), [(1.0, 0.0), (2.37, 1e-6)])
def test_what_rounding_moves_it_moves_by_units_in_the_last_place(dtype: str, ulps: float, absolute: float) -> None:
    random = np.random.default_rng(0)
    bits = {"float16": np.uint16, "float32": np.uint32, "float64": np.uint64}[dtype]
    given = random.integers(0, np.iinfo(bits).max, (64, 64), dtype=bits, endpoint=True).view(dtype)  # NaN, denormals
    for array in (given, given[:1, 0].reshape(()), random.standard_normal(99).astype(dtype), np.zeros(4, dtype)):
        with np.errstate(all="ignore"):
            step = np.maximum(np.spacing(np.abs(array)) * ulps, absolute).astype(dtype)
            up = np.random.default_rng(3).random(array.shape) >= 0.5
            moved = np.where(up, array + step, array - step)
        expected = np.where((array == 0) | ~np.isfinite(array), array, moved)
        np.testing.assert_array_equal(Jitter(3)._perturb(array, ulps, absolute), expected)


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
@pytest.mark.parametrize("shape", [(), (1,), (1 << 16,), (65537,), (3, 50_000), (2, 3, 33_333), (400, 401)], ids=str)
def test_what_is_moved_piece_by_piece_is_moved_as_the_whole_is(
    dtype: str, shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(1)
    given = (random.standard_normal(shape) * 10.0 ** random.integers(-9, 5, shape)).astype(dtype)
    given = np.where(random.random(shape) < 0.01, random.choice([0.0, -0.0, np.nan, np.inf, 1e-7], shape), given)
    array = np.asarray(given, dtype)
    entry, each = TABLE["MatMul"], Node("y", "MatMul")
    left, right = (random.standard_normal(s).astype(dtype) for s in ((700, 5), (5, 300)))

    def moved() -> list[bytes]:
        jitter = Jitter(7)
        made = [jitter._perturb(a, *how) for a in (array, array.T) for how in ((), (2.37, 1e-6))]
        return [m.tobytes() for m in (*made, *jitter.results(entry, each, [left, right], [left @ right]))]

    pieces = moved()
    monkeypatch.setattr("export_model.converters.graph.jitter._AT_ONCE", 1 << 30)
    assert pieces == moved()


@pytest.mark.parametrize("piece", [100, 1 << 16])
@pytest.mark.parametrize(
    ("op", "left", "right", "moves"),
    [
        ("Mul", [1.0, 3.1, 0.0, 7.7], -1.0, [False] * 4),
        ("Mul", [1.1, 3.1, 0.0, 7.7], 2.0**-7, [False] * 4),
        ("Mul", [1.1, 3.1, 0.0, 3.0], 1e8, [True, True, False, False]),
        ("Mul", [1.1, 3.1, 0.0, 7.7], 0.1, [True, True, False, True]),
        ("Add", [-1.0, 0.0, -0.5, 0.1], 1.0, [False, False, False, True]),
        ("Sub", [0.0, 8.0, -0.5, 0.1], 1e8, [False, False, True, True]),
        ("RealDiv", [1.0, 2.0, 4.0, 8.0], 2.0, [True] * 4),  # a shader multiplies by a reciprocal
    ],
)
def test_what_is_not_rounded_is_not_moved(
    op: str, left: list[float], right: float, moves: list[bool], piece: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mask's (1 - mask)·1e8 is exact: moved by one unit in the last place of 1, it would open every choice."""
    monkeypatch.setattr("export_model.converters.graph.jitter._AT_ONCE", piece)
    made = graph(placeholder("x", (None, 4)), const("c", right, np.float32), node("y", op, "x", "c"))
    feeds = {"x": np.repeat(np.float32([left]), 300, axis=0)}
    exact = run_graph(made, feeds, ["y"])["y"]
    assert (run_graph(made, feeds, ["y"], Jitter(1))["y"] != exact).all(axis=0).tolist() == moves


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("piece", [100, 1 << 16])
def test_a_product_of_squares_is_that_of_the_squared_operands(
    piece: int, turned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(2)
    a, b = random.standard_normal((3, 50)).astype(np.float32), random.standard_normal((50, 17)).astype(np.float32)
    b = b.T.copy() if turned else b
    monkeypatch.setattr("export_model.converters.graph.ops.linear._LARGE", piece)
    monkeypatch.setattr("export_model.converters.graph.ops.linear._AT_ONCE", piece)
    each = Node("y", "MatMul", attrs={"transpose_b": turned})
    expected = matmul(each, np.square(a), np.square(b))
    assert matmul(each, a, b, squared=True).tobytes() == expected.tobytes()


@pytest.mark.parametrize("turned", [False, True])
def test_what_rounding_makes_of_a_large_layer_is_computed_without_another_one(turned: bool) -> None:
    weights = np.resize(np.random.default_rng(3).standard_normal(2111).astype(np.float32), (2048, 2304))
    product = Node("y", "MatMul", ("x", "w"), {"transpose_b": turned})
    graph = Graph((Node("x", "Placeholder"), Node("w", "Const", value=weights), product))
    feeds = {"x": np.ones((2, weights.shape[turned]), np.float32)}
    run_graph(graph, feeds, ["y"], Jitter(1))
    tracemalloc.start()
    try:
        run_graph(graph, feeds, ["y"], Jitter(1))
        assert tracemalloc.get_traced_memory()[1] < weights.nbytes / 4
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("op", ["Mean", "Sum"])
@pytest.mark.parametrize(
    ("axes", "shape"),
    [
        ((1, 2, 4), (10, 10, 4, 2)),  # a GroupNorm's, which onnxruntime adds one number after the other
        ((1, 2), (84, 84, 8)),
        ((1, 2, 3), (84, 84, 3)),
        ((1,), (4096,)),
        ((2, 3), (4, 40, 40)),
    ],
    ids=str,
)
def test_rounding_explains_what_runtimes_make_of_equal_numbers(
    op: str, axes: tuple[int, ...], shape: tuple[int, ...], runtimes: Runtimes
) -> None:
    """As of a black or white image: a partial sum after the other is rounded the same way."""
    made = graph(placeholder("x", (None, *shape)), const("axes", axes), node("y", op, "x", "axes", keep_dims=False))
    numbers = np.random.default_rng(0).uniform(1e3, 1e4, (16, *(1 for _ in shape))).astype(np.float32)
    feeds = {"x": np.broadcast_to(numbers, (16, *shape)).copy()}
    exact = run_graph(made, feeds, ["y"])["y"]
    moved = np.max([np.abs(run_graph(made, feeds, ["y"], Jitter(seed))["y"] - exact) for seed in range(RUNS)], axis=0)
    answers = (*runtimes.onnx(policy_of(made, ["y"]), feeds, 15), *runtimes.tensorflow(made, feeds, ["y"]))
    for answer in answers:
        assert np.all(np.abs(answer - exact) <= FACTOR * moved)
    # and not by far more: of numbers that differ each is rounded by itself
    feeds = {"x": np.random.default_rng(1).standard_normal((16, *shape)).astype(np.float32)}
    exact = run_graph(made, feeds, ["y"])["y"]
    moved = np.abs(run_graph(made, feeds, ["y"], Jitter(0))["y"] - exact)
    added = (np.sum if op == "Sum" else np.mean)(np.abs(feeds["x"]), axis=axes)
    assert np.max(FACTOR * moved / added) < 1e-5


@pytest.mark.parametrize("arithmetic", ["processor", "graphics"])
def test_rounding_moves_no_function_out_of_its_range(arithmetic: str) -> None:
    """SAC's log(1 - tanh² + 1e-6) is NaN of a tanh six units above 1: in most runs, so rounding explained nothing."""
    nodes = [Node("x", "Placeholder"), Node("tanh", "Tanh", ("x",)), Node("softmax", "Softmax", ("x",))]
    feeds = {"x": np.array([[30.0, -30, 9, -8.5]], np.float32)}
    for seed in range(50):
        found = run_graph(Graph(tuple(nodes)), feeds, ["tanh", "softmax"], Jitter(seed, arithmetic))
        assert np.abs(found["tanh"]).max() <= 1 + 2**-22  # onnxruntime's own, of 8.4755
        assert (1 - found["tanh"] ** 2 + np.float32(1e-6) > 0).all()
        assert found["softmax"].min() >= 0 and found["softmax"].max() <= 1 + 2**-23


def test_what_nothing_reads_any_more_is_let_go() -> None:
    """A child may take so much memory; 4,096 rows of each tensor of an attention at once were more."""
    steps = [node(f"y{i}", "Neg", f"y{i - 1}" if i else "x") for i in range(32)]
    made = graph(placeholder("x", (None, 1 << 10)), *steps)
    fed = np.ones((1 << 9, 1 << 10), np.float32)
    run_graph(made, {"x": fed}, ["y31"])
    tracemalloc.start()
    given = run_graph(made, {"x": fed}, ["y3", "y31"])
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 6 * fed.nbytes
    np.testing.assert_array_equal(given["y31"], fed)
    np.testing.assert_array_equal(given["y3"], fed)
