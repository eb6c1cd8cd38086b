"""The first tensor that differs: found wherever it is planted, by a played runtime that computes something else."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.intermediate_tensors import InnerTensors, View
from export_model.converters.formats.onnx.tensor_map import TensorMap, loads
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import Graph, NameScope, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.policy.policy import Policy
from export_model.exporter.export.pipeline import ExportOptions, export
from export_model.exporter.verify import bisection as bisect
from export_model.exporter.verify.bisection import _Search
from export_model.exporter.verify.difference import compare
from export_model.exporter.verify.findings import Bisection, Numbers
from export_model.exporter.verify.participants import Feeds
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.sampling import draw_cases
from fixtures import path as fixture


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Policy]:
    made = {}
    for name in ("continuous", "discrete", "recurrent", "sampled"):
        place = tmp_path_factory.mktemp(name)
        options = ExportOptions(place, ("bytes",), verify="none", compile=CompileOptions())
        (result,) = export([fixture(name)], options)
        made[name] = replace(result.policy, graph=runnable(result.policy.graph))
    return made


def no_rounding(graph: Graph, feeds: Feeds, tensor: str) -> np.ndarray:
    return np.zeros(run_graph(graph, feeds, [tensor])[tensor].shape)


def searched(
    graph: Graph,
    other: Graph,
    feeds: Feeds,
    output: str,
    hidden: Collection[str] = (),
    *,
    tolerance: Tolerance | None = None,
    fails: Callable[[Sequence[str]], bool] = lambda names: False,
) -> Bisection:
    """What is found where a runtime computes ``other`` in place of ``graph``."""

    def run(fed: Feeds, names: Sequence[str]) -> dict[str, np.ndarray]:
        if fails(names):
            raise RunFailedError("it does not give that")
        return run_graph(other, fed, names)

    within = InnerTensors(lambda t: None if t in hidden else View(t), run)
    search = _Search(graph, within, feeds, tolerance or Tolerance(), no_rounding, lambda node: node.origin)
    return search.first(output, 0)


def spoilt(graph: Graph, name: str, by: float = 0.5) -> Graph:
    """The graph with ``by`` added to a tensor."""
    nodes: list[Node] = []
    for node in graph.nodes:
        if node.name != name:
            nodes.append(node)
        elif node.op == "Const":
            assert node.value is not None
            nodes.append(replace(node, value=(node.value + node.value.dtype.type(by)).astype(node.value.dtype)))
        else:
            addend = Node(f"{name}/by", "Const", value=np.array(by, np.float32))
            nodes += [replace(node, name=f"{name}/good"), addend, Node(name, "Add", (f"{name}/good", addend.name))]
    return Graph(tuple(nodes))


def floats(policy: Policy, output: str) -> list[str]:
    """The float tensors that lead to an output; one that is added to changes what follows."""
    case = draw_cases(policy.signature, samples=1)[1]
    upstream = policy.graph.ancestors([output])
    names = [n.name for n in policy.graph.nodes if n.name in upstream and n.op not in ("Placeholder", "Split")]
    values = run_graph(policy.graph, case.feeds, names)
    return [n for n in names if values[n].dtype == np.float32]


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_the_tensor_that_was_spoilt_is_found(policies: dict[str, Policy], data: st.DataObject) -> None:
    policy = policies[data.draw(st.sampled_from(["continuous", "discrete", "recurrent"]))]
    output = policy.signature.outputs[0].name
    name = data.draw(st.sampled_from(floats(policy, output)))
    feeds = draw_cases(policy.signature, samples=1)[1].feeds
    found = searched(policy.graph, spoilt(policy.graph, name), feeds, output)
    node = policy.graph[name]
    assert (found.tensor, found.op, found.source) == (name, node.op, node.origin)
    assert found.index is not None
    assert found.got == pytest.approx((found.expected or 0.0) + 0.5, abs=1e-5)
    assert found.hidden == ()


@given(st.data())
@settings(max_examples=40, deadline=None)
def test_behind_what_a_format_hides_the_next_tensor_is_found(policies: dict[str, Policy], data: st.DataObject) -> None:
    policy = policies["continuous"]
    products = [n for n in floats(policy, "action") if policy.graph[n].op == "MatMul"]
    name = data.draw(st.sampled_from(products))
    feeds = draw_cases(policy.signature, samples=1)[1].feeds
    found = searched(policy.graph, spoilt(policy.graph, name), feeds, "action", products)
    (bias,) = policy.graph.consumers()[name]
    assert (found.tensor, found.op, found.hidden) == (bias.name, "BiasAdd", (name,))


def test_a_weight_must_be_the_same_to_the_bit(policies: dict[str, Policy]) -> None:
    policy = policies["continuous"]
    feeds = draw_cases(policy.signature, samples=1)[1].feeds
    found = searched(policy.graph, spoilt(policy.graph, "dense/kernel/read", 1e-6), feeds, "action")
    assert (found.tensor, found.op) == ("dense/kernel/read", "Const")
    assert found.max_abs_diff == pytest.approx(1e-6, rel=0.1)


def test_a_difference_within_the_tolerance_is_none(policies: dict[str, Policy]) -> None:
    policy = policies["continuous"]
    feeds = draw_cases(policy.signature, samples=1)[1].feeds
    other = spoilt(policy.graph, "add_1", 1e-4)
    assert searched(policy.graph, other, feeds, "action").tensor == "add_1"
    found = searched(policy.graph, other, feeds, "action", tolerance=Tolerance(1e-2, 0))
    assert (found.tensor, found.to_dict()) == (None, {"tensor": None, "reason": found.reason})
    assert "no tensor that leads to it differs" in found.reason


def test_of_a_draw_the_sampler_of_its_branch_is_named(policies: dict[str, Policy]) -> None:
    policy = policies["sampled"]
    case = draw_cases(policy.signature, samples=1)[1]
    within = InnerTensors(View, lambda fed, names: run_graph(policy.graph, fed, names))
    search = _Search(policy.graph, within, case.feeds, Tolerance(), no_rounding, lambda n: n.origin)
    found = search.first("action", 2)
    assert (found.tensor, found.op) == ("multinomial_2/Multinomial", "Multinomial")
    assert "what it draws does not" in found.reason
    assert searched(policy.graph, spoilt(policy.graph, "Log_1"), case.feeds, "action").tensor == "Log_1"


def test_a_nan_is_a_difference(policies: dict[str, Policy]) -> None:
    policy = policies["continuous"]
    feeds = draw_cases(policy.signature, samples=1)[1].feeds
    entry = searched(policy.graph, spoilt(policy.graph, "mul", float("nan")), feeds, "action").to_dict()
    assert (entry["tensor"], entry["got"], entry["max_abs_diff"]) == ("mul", "nan", "inf")
    assert entry["smallest_tolerance"] is None
    assert entry["reason"] == "NaN or infinity on one side only"


def ratio(ceiling: float) -> Graph:
    """The logarithm of a ratio that is clipped, beside a sum."""
    b = Builder(NameScope(()))
    b.append(Node("x", "Placeholder", (), {"dtype": np.dtype(np.float32), "shape": TensorShape((None, 2))}))
    b.add("RealDiv", [b.number("x", 1), "x"], "ratio")
    b.add("Log", [b.add("Minimum", ["ratio", b.number("x", ceiling)], "clipped")], "logarithm")
    b.add("Add", ["logarithm", "x"], "action")
    return b.graph()


def test_an_infinity_that_what_reads_it_takes_away_is_not_where_it_begins() -> None:
    """1/0 in place of 1/1e-9: both are clipped to 100, and it is the sum that differs."""
    feeds = {"x": np.full((1, 2), 1e-9, np.float32)}
    infinite = spoilt(ratio(100), "ratio", float("inf"))
    assert searched(ratio(100), spoilt(infinite, "action"), feeds, "action").tensor == "action"
    assert searched(ratio(100), spoilt(infinite, "action", float("nan")), feeds, "action").tensor == "action"
    found = searched(ratio(1e30), spoilt(ratio(1e30), "ratio", float("inf")), feeds, "action")  # clipped to another
    assert (found.tensor, found.reason) == ("ratio", "NaN or infinity on one side only")


def test_what_a_runtime_refuses_to_give_is_left_out(policies: dict[str, Policy]) -> None:
    policy = policies["continuous"]
    feeds = draw_cases(policy.signature, samples=1)[1].feeds
    other = spoilt(policy.graph, "mul")
    found = searched(policy.graph, other, feeds, "action", fails=lambda names: "mul" in names)
    assert (found.tensor, found.hidden) == ("add_1", ("mul",))


def test_no_more_than_a_runtime_should_hold_is_asked_at_a_time(
    policies: dict[str, Policy], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = policies["continuous"]
    feeds = draw_cases(policy.signature, samples=1)[1].feeds
    monkeypatch.setattr(bisect, "FETCH_BYTES", 2000)
    sizes: list[int] = []

    def count(names: Sequence[str]) -> bool:
        values = run_graph(policy.graph, feeds, names)
        sizes.append(0 if len(names) == 1 else sum(v.nbytes for v in values.values()))
        return False

    assert searched(policy.graph, spoilt(policy.graph, "action"), feeds, "action", fails=count).tensor == "action"
    assert len(sizes) > 3
    assert max(sizes) <= 2000


def test_a_graph_is_run_without_the_contract(policies: dict[str, Policy]) -> None:
    read = read_graph(fixture("continuous").read_bytes())
    text = Node("text", "Const", value=np.array(b"x", object).astype("S1"))
    assert "text" not in runnable(Graph((*read.nodes, text)))


# ------------------------------------------------------------------ the smallest tolerance


@given(
    arrays.arrays(np.float32, (3, 2), elements=st.floats(-1e3, 1e3, width=32)),
    arrays.arrays(np.float32, (3, 2), elements=st.floats(-1e3, 1e3, width=32)),
)
@settings(max_examples=100, deadline=None)
def test_the_smallest_tolerance_passes_and_less_does_not(a: np.ndarray, b: np.ndarray) -> None:
    least = compare(a, b, Tolerance(0, 0)).smallest_tolerance
    assert least is not None
    assert compare(a, b, Tolerance(least, least)).passed
    if least:
        assert not compare(a, b, Tolerance(least * 0.999, least * 0.999)).passed


def test_no_tolerance_helps_where_it_is_no_matter_of_numbers() -> None:
    one = np.ones(2, np.float32)
    assert compare(one, one[:1], Tolerance()).smallest_tolerance is None
    assert compare(one, np.array([1, np.nan], np.float32), Tolerance()).smallest_tolerance is None
    assert compare(np.ones(2, np.int64), np.zeros(2, np.int64), Tolerance()).smallest_tolerance is None
    assert compare(one, np.array([1, np.nan], np.float32), Tolerance()).worst == 1


@given(st.floats(1e-12, 1e12))
@settings(max_examples=200, deadline=None)
def test_what_the_terminal_says_passes_too(least: float) -> None:
    failed = Numbers("onnx", "r", "action", 1.0, 1.0, Tolerance(), False, "zeros", smallest_tolerance=least)
    text = failed.explanation()[-1]
    said = float(text.split(": ")[1].split(",")[0])
    assert least <= said <= least * 1.011


# ------------------------------------------------------------------ the map of an .onnx

NAMES = st.text(min_size=1, max_size=8)
VIEWS = st.none() | st.builds(View, NAMES) | st.builds(View, NAMES, st.permutations(range(4)).map(tuple))


@given(st.builds(TensorMap, st.dictionaries(NAMES, VIEWS), st.dictionaries(NAMES, NAMES)))
@settings(max_examples=100, deadline=None)
def test_the_map_is_read_as_it_was_written(names: TensorMap) -> None:
    assert loads(names.dumps()) == names


@pytest.mark.parametrize("text", ["", "x", "[]", "1", '{"values": 3}', '{"sources": [1]}', "[" * 100000])
def test_a_map_that_is_none_maps_nothing(text: str) -> None:
    assert loads(text) == TensorMap()


@pytest.mark.parametrize("entry", ["3", '["a", [0, 0]]', '["a", ["0", 1]]', '["a"]', "{}"])
def test_an_entry_that_is_not_understood_is_a_tensor_that_is_not_there(entry: str) -> None:
    assert loads(f'{{"values": {{"t": {entry}}}}}').view("t") is None


@given(arrays.arrays(np.float32, arrays.array_shapes(min_dims=4, max_dims=4, max_side=3)), st.permutations(range(4)))
@settings(max_examples=50, deadline=None)
def test_a_turned_tensor_is_turned_back(array: np.ndarray, axes: list[int]) -> None:
    np.testing.assert_array_equal(View("t", tuple(axes)).restore(array.transpose(axes)), array)
