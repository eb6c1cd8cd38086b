"""Every op of the table: its kernel, its inferred type and its lowerings against TensorFlow and the other runtimes.

TensorFlow is the oracle of the kernels; onnxruntime, TensorFlow.js and LiteRT judge what the writers make of an op. A
sample that says a runtime ``differs`` is held to that: where it agrees by now, the test fails and the line can go.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import pytest

from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.ops.base import written_as_older
from export_model.converters.graph.ops.samplers import reseed
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import infer_types
from export_model.signatures.errors import ExportModelError, UnsupportedOpError
from tests.graph.harness import Array, Bindings, Runtimes, difference, policy_of
from tests.graph.samples import DRAWS, PROBABILITIES, SAMPLES, TFJS, Sample, random_slices

pytestmark = pytest.mark.xdist_group("graph-ops")

OPSETS = (13, 15, 18, 21)
LITERT = ("litert", "litert-plain")
#: Ops that a graph may hold, by the passes' making or by an importer's; the others are only spellings.
OPS = [op.name for op in TABLE.values() if op.infer is not written_as_older]
BY_OP: Mapping[str, list[Sample]] = {op: [s for s in SAMPLES if s.op == op] for op in OPS}

#: Kernels round once from float64, so TensorFlow is closer to them than the runtimes are to each other.
CLOSE = {"atol": 2e-6, "rtol": 2e-6}

each_op = pytest.mark.parametrize("op", OPS)


def test_every_op_has_samples() -> None:
    assert {op: len(samples) for op, samples in BY_OP.items() if len(samples) < 2} == {}
    assert {s.op for s in SAMPLES} == set(OPS)
    titles = [(s.op, s.title) for s in SAMPLES]
    assert len(titles) == len(set(titles))


# ------------------------------------------------------------------ kernels


def computed(sample: Sample) -> list[Array]:
    """What the numpy kernels make of a sample."""
    reseed(7)
    results = run_graph(sample.graph, sample.feeds, sample.fetches)
    return [results[name] for name in sample.fetches]


@each_op
def test_tensorflow(op: str, runtimes: Runtimes) -> None:
    assert problems(
        op,
        "tensorflow",
        lambda sample: runtimes.tensorflow(sample.oracle or sample.graph, sample.feeds, sample.fetches),
        **CLOSE,
    ) == []  # fmt: skip


@pytest.mark.parametrize("op", [op for op in OPS if TABLE[op].older is None])
def test_onnxruntime(op: str, runtimes: Runtimes) -> None:
    def run(opset: int) -> Callable[[Sample], list[Array]]:
        return lambda sample: runtimes.onnx(policy_of(sample.graph, sample.fetches), sample.feeds, opset)

    found = [f"opset {opset}: {problem}" for opset in OPSETS for problem in problems(op, "onnxruntime", run(opset))]
    assert found == []


@pytest.mark.parametrize("backend", TFJS)
@each_op
def test_tensorflow_js(op: str, backend: str, runtimes: Runtimes) -> None:
    assert problems(
        op,
        backend,
        lambda sample: runtimes.tfjs(backend, policy_of(sample.graph, sample.fetches), sample.feeds),
        narrowed=True,
    ) == []  # fmt: skip


@pytest.mark.parametrize("runtime", LITERT)
@pytest.mark.parametrize("op", [op for op in OPS if TABLE[op].older is None])
def test_litert(op: str, runtime: str, runtimes: Runtimes) -> None:
    """With XNNPACK and without; an op that has no lowering is refused by its name."""
    if TABLE[op].litert is None and not TABLE[op].start:
        for sample in BY_OP[op]:
            with pytest.raises(UnsupportedOpError, match=rf"'op' \({op}\) is not written to \.tflite"):
                runtimes.litert(runtime, policy_of(sample.graph, sample.fetches), sample.feeds)
        return
    found = problems(
        op,
        runtime,
        lambda sample: runtimes.litert(runtime, policy_of(sample.graph, sample.fetches), sample.feeds),
        narrowed=True,
    )
    assert found == []


#: Every op as C; in the other languages those that call their mathematics or draw: tests/programs/test_ops_alike.py
#: holds every op's bits in them to C's, with our own.
SOURCE_CODE = [
    (op, key)
    for op in OPS
    for key, form in WRITTEN.items()
    if TABLE[op].older is None
    and form.program
    and (key == "c" or TABLE[op].precision == "approximate" or TABLE[op].sampler or TABLE[op].loops is None)
]


@pytest.mark.parametrize(("op", "key"), SOURCE_CODE)
def test_source_code(op: str, key: str, runtimes: Runtimes) -> None:
    """Of known lengths, since a program is for one agent; where one hangs on an input, or without loops, refused."""
    runtimes.need(WRITTEN[key].runtimes[0])

    def run(sample: Sample) -> list[Array]:
        graph = sample.with_shapes(lambda _, array: TensorShape(array.shape))
        return runtimes.program(key, policy_of(graph, sample.fetches), sample.feeds)

    found = []
    for sample in BY_OP[op]:
        shapes = [array.shape for array in computed(sample)]
        if any(0 in shape for shape in shapes) or () in shapes:
            continue  # no contract has such an output
        known = infer_types(sample.with_shapes(lambda _, array: TensorShape(array.shape)))[sample.fetches[0]]
        lacks = TABLE[op].loops is None and not TABLE[op].start
        if known.constant is None and (lacks or not all(isinstance(n, int) for n in known.shape or ())):
            with pytest.raises(UnsupportedOpError, match="is not written as source code"):
                run(sample)
            continue
        if problem := disagreement(sample, run(sample)):
            found.append(f"{sample.title}: {problem}")
    assert found == []


def problems(op: str, runtime: str, run: Callable[[Sample], list[Array]], **how: float) -> list[str]:
    """Where a runtime does not do what the samples of an op say."""
    found = []
    for sample in BY_OP[op]:
        try:
            problem = disagreement(sample, run(sample), **how)
        except ExportModelError as error:
            problem = f"refused: {error}"
        if runtime in sample.differs:
            problem = None if problem else f"agrees, though it was said to differ: {sample.differs[runtime]}"
        if problem:
            found.append(f"{sample.title}: {problem}")
    return found


def disagreement(sample: Sample, results: list[Array], *, narrowed: float = False, **close: float) -> str | None:
    """How the results differ from the kernel's."""
    expected = computed(sample)
    assert all(isinstance(array, np.ndarray) for array in expected)
    if sample.drawn:
        (draws,) = results
        return difference(np.zeros_like(expected[0]), np.zeros_like(draws), narrowed=bool(narrowed)) or luck(
            sample.op, draws
        )
    found = (difference(e, a, narrowed=bool(narrowed), **close) for e, a in zip(expected, results, strict=True))
    return next((f for f in found if f), None)


# ------------------------------------------------------------------ draws


def normal(x: Array) -> Array:
    return np.vectorize(lambda v: (1 + math.erf(v / math.sqrt(2))) / 2)(x)


#: The cumulative distribution that an op draws from.
DISTRIBUTIONS: Mapping[str, Callable[[Array], Array]] = {
    "RandomStandardNormal": normal,
    "RandomUniform": lambda x: np.clip(x, 0, 1),
    "TruncatedNormal": lambda x: np.clip((normal(x) - normal(np.float64(-2))) / (2 * normal(np.float64(2)) - 1), 0, 1),
    "Multinomial": lambda x: np.cumsum(PROBABILITIES.astype(np.float64))[x.astype(int)],
}


def luck(op: str, draws: Array) -> str | None:
    """Whether draws are unlikely: 3.3/√n off the true distribution is met once in 10⁹ samples (Massart's bound)."""
    if op == "Multinomial" and len(draws) > 1 and (draws[0] == draws[1]).all():
        return "the rows are the same draws"
    ordered = np.sort(draws.reshape(-1)).astype(np.float64)
    assert ordered.size == DRAWS
    steps = np.searchsorted(ordered, ordered, side="right") / DRAWS
    off = float(np.abs(DISTRIBUTIONS[op](ordered) - steps).max())
    return None if off < 3.3 / math.sqrt(DRAWS) else f"the distribution is {off:.4f} off"


@pytest.mark.parametrize("op", DISTRIBUTIONS)
def test_kernels_draw_from_the_right_distribution(op: str) -> None:
    for sample in BY_OP[op]:
        (draws,) = computed(sample)
        assert luck(op, draws) is None, sample.title
        assert not np.array_equal(draws, run_graph(sample.graph, sample.feeds, ["op"])["op"])
        assert np.array_equal(draws, computed(sample)[0])


def test_a_wrong_distribution_is_noticed() -> None:
    draws = computed(BY_OP["RandomStandardNormal"][0])[0]
    assert luck("RandomStandardNormal", draws * 1.2) is not None
    assert luck("RandomStandardNormal", draws + 0.1) is not None
    assert luck("TruncatedNormal", 4 * computed(BY_OP["RandomUniform"][0])[0] - 2) is not None
    classes = computed(BY_OP["Multinomial"][0])[0]
    assert luck("Multinomial", np.where(classes == 2, 1, classes)) is not None
    assert luck("Multinomial", np.repeat(classes[:, : DRAWS // 2], 2, axis=0)) is not None


# ------------------------------------------------------------------ types

#: Ops that need an image's rank to say anything.
WINDOWS = {"Conv2D", "_FusedConv2D", "DepthwiseConv2dNative", "MaxPool", "AvgPool"}


def contradictions(sample: Sample, graph: Graph) -> list[str]:
    """Where the inferred types of all tensors of a sample are not those of the values."""
    types, bound = infer_types(graph), Bindings()
    names = [*(n.name for n in graph.nodes if n.name != "op"), *sample.fetches]
    results = run_graph(graph, sample.feeds, names)
    return [f"{sample.title}: {p}" for name in names for p in bound.problems(name, types[name], results[name])]


@each_op
def test_inferred_types_hold(op: str) -> None:
    """With the shapes of the sample, all lengths, only the ranks, and nothing known."""
    for sample in BY_OP[op]:
        assert contradictions(sample, sample.graph) == []
        all_lengths_known(sample)
        only_the_ranks_known(sample)
        nothing_known(sample)


def all_lengths_known(sample: Sample) -> None:
    graph = sample.with_shapes(lambda _, array: TensorShape(array.shape))
    assert contradictions(sample, graph) == []
    if sample.op in ("Range", "Where") and any(n.op == "Placeholder" for n in graph.nodes):
        return  # its length hangs on a fed value
    types = infer_types(graph)
    for name in sample.fetches:
        shape = types[name].shape
        assert shape is not None, sample.title
        assert all(isinstance(d, int) for d in shape), sample.title


def only_the_ranks_known(sample: Sample) -> None:
    graph = sample.with_shapes(
        lambda shape, array: TensorShape((*(shape.dims or ())[:1], *[None] * array.ndim)[: array.ndim])
    )
    if sample.op == "Squeeze" and not sample.graph["op"].attrs["squeeze_dims"]:
        with pytest.raises(ExportModelError, match="'op'"):
            infer_types(graph)
    else:
        assert contradictions(sample, graph) == []


def nothing_known(sample: Sample) -> None:
    graph = sample.with_shapes(lambda _shape, _array: TensorShape(None))
    if sample.op in WINDOWS:
        with pytest.raises(ExportModelError, match="'op'"):
            infer_types(graph)
    else:
        assert contradictions(sample, graph) == []


# ------------------------------------------------------------------ slices


@pytest.mark.parametrize("runtime", ["tensorflow", "onnxruntime", *TFJS])
def test_random_slices(runtime: str, runtimes: Runtimes) -> None:
    """All masks of StridedSlice at once, many slices in one graph."""
    graph, feeds, fetches = random_slices(400, seed=5)
    expected = run_graph(graph, feeds, fetches)
    if runtime in TFJS:
        # strides beside a shrunk axis: see the sample; empty slices with a new axis: an error
        fetches = [f for f in fetches if expected[f].size and not _shrinks_and_strides(graph, graph[f])]
        graph = graph.prune(fetches)
        assert len(fetches) > 80
    if runtime == "tensorflow":
        results = runtimes.tensorflow(graph, feeds, fetches)
    elif runtime == "onnxruntime":
        results = runtimes.onnx(policy_of(graph, fetches), feeds, 15)
    else:
        results = runtimes.tfjs(runtime, policy_of(graph, fetches), feeds)
    found = {}
    for name, result in zip(fetches, results, strict=True):
        if problem := difference(expected[name], result):
            found[name] = f"{problem} of {graph[name]}"
    assert found == {}


def _shrinks_and_strides(graph: Graph, node: Node) -> bool:
    strides = graph.constant(node.inputs[3])
    assert strides is not None
    return bool(node.attrs["shrink_axis_mask"]) and bool((strides != 1).any())
