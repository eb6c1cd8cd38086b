"""Fewer ops for the same outputs: branches as one, constants merged, nothing computed twice; and the same numbers in
the runtimes that it is for.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from export_model.converters.compiler.targets import FEWER_OPS, prepare
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import INT32
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature, TensorSpec
from tests.graph.harness import Runtimes, difference
from tests.graph.making import Array, const, graph, node, ops, placeholder
from tests.graph.samples import f32, floats

pytestmark = pytest.mark.xdist_group("graph-passes")

MASKS = {"ellipsis_mask": 0, "new_axis_mask": 0, "shrink_axis_mask": 0}
ROWS = 3


def columns(name: str, source: str, first: int, last: int) -> list[Node]:
    """Columns of a matrix."""
    bounds = [("begin", (0, first)), ("end", (0, last)), ("strides", (1, 1))]
    return [
        *(const(f"{name}/{k}", np.array(v, np.int32)) for k, v in bounds),
        node(name, "StridedSlice", source, *(f"{name}/{k}" for k, _ in bounds), begin_mask=1, end_mask=1, **MASKS),
    ]


def branches(*widths: int, biased: bool = False, drawn: str = "Log") -> Graph:
    """A discrete policy's scores, softmaxes, masks and logarithms, and the best of each branch beside them."""
    nodes = [placeholder("x", (None, 4)), placeholder("masks", (None, sum(widths))), const("axis", 1)]
    start = 0
    for i, width in enumerate(widths):
        scores = f"product{i}"
        nodes += [const(f"w{i}", floats(4, width, seed=i)), node(scores, "MatMul", "x", f"w{i}")]
        if biased:
            nodes += [const(f"b{i}", floats(width, seed=9 + i)), node(f"biased{i}", "BiasAdd", scores, f"b{i}")]
            scores = f"biased{i}"
        nodes += [
            node(f"softmax{i}", "Softmax", scores),
            const(f"least{i}", f32(1e-7).reshape(())),
            node(f"more{i}", "Add", f"softmax{i}", f"least{i}"),
            *columns(f"mask{i}", "masks", start, start + width),
            node(f"masked{i}", "Mul", f"more{i}", f"mask{i}"),
            const(f"over{i}", np.array([1], np.int32)),
            node(f"sum{i}", "Sum", f"masked{i}", f"over{i}", keep_dims=True),
            node(f"share{i}", "RealDiv", f"masked{i}", f"sum{i}"),
            node(f"log{i}", drawn, f"share{i}"),
            node(f"best{i}", "ArgMax", f"log{i}", "axis"),
        ]
        start += width
    each = range(len(widths))
    scores = "biased" if biased else "product"
    return graph(
        *nodes,
        node("scores", "ConcatV2", *(f"{scores}{i}" for i in each), "axis", N=len(widths)),
        node("action", "ConcatV2", *(f"log{i}" for i in each), "axis", N=len(widths)),
        node("best", "Pack", *(f"best{i}" for i in each), axis=1),
    )


def one_hots(*depths: int, column: int = 0) -> Graph:
    """The last action of each branch, one hot, beside a vector."""
    nodes = [placeholder("x", (None, 2)), placeholder("last", (None, len(depths) + column), INT32), const("axis", 1)]
    for i, depth in enumerate(depths):
        bounds = [("begin", (0, column + i)), ("end", (0, column + i + 1)), ("strides", (1, 1))]
        masks = {**MASKS, "begin_mask": 1, "end_mask": 1, "shrink_axis_mask": 2}
        nodes += [
            *(const(f"{k}{i}", np.array(v, np.int32)) for k, v in bounds),
            node(f"index{i}", "StridedSlice", "last", *(f"{k}{i}" for k, _ in bounds), **masks),
            const(f"depth{i}", depth),
            *(const(f"{k}{i}", np.array(v, np.float32)) for k, v in (("on", 1), ("off", 0))),
            node(f"hot{i}", "OneHot", f"index{i}", f"depth{i}", f"on{i}", f"off{i}"),
        ]
    hots = [f"hot{i}" for i in range(len(depths))]
    return graph(
        *nodes,
        node("hots", "ConcatV2", *hots, "axis", N=len(hots)),
        node("y", "ConcatV2", "x", "hots", "axis", N=2),
    )


def beside(*parts: tuple[str, int, int], then: Sequence[Node] = (), joined: Sequence[str] = ()) -> Graph:
    """Columns of one matrix, or what is made of them, side by side."""
    names = list(joined) or [name for name, _, _ in parts]
    return graph(
        *(placeholder("x", (None, 4)), const("axis", 1)),
        *(n for name, first, last in parts for n in columns(name, "x", first, last)),
        *then,
        node("all", "ConcatV2", *names, "axis", N=len(names)),
        node("y", "Tanh", "all"),
    )


def spread_column() -> Graph:
    """One column times constants: nothing but these says how wide the parts are."""
    twos = [const(f"twos{n}", np.full(n, 2, np.float32)) for n in (3, 2)]
    spread = [node(f"spread{n}", "Mul", "one", f"twos{n}") for n in (3, 2)]
    return beside(("one", 1, 2), then=[*twos, *spread], joined=["spread3", "spread2"])


def sums_of_two_and_of_three() -> Graph:
    sums = [node("two", "AddN", "a", "b"), node("three", "AddN", "b", "a", "c")]
    return beside(("a", 0, 2), ("b", 2, 4), ("c", 1, 3), then=sums, joined=["two", "three"])


def policy(made: Graph, outputs: Sequence[str], action: str = "action") -> Policy:
    def spec(name: str, values: Array) -> TensorSpec:
        role = Role.LOG_PROBS if name == action else Role.OTHER
        return TensorSpec(name, role, values.dtype.name, (None, *values.shape[1:]))

    fed = feeds(made)
    inputs = tuple(spec(n, v) for n, v in fed.items())
    signature = PolicySignature(
        inputs=inputs,
        outputs=tuple(spec(n, v) for n, v in run_graph(made, fed, outputs).items()),
        family="t",
        action_space="t",
    )
    return Policy("sample", made, signature, {n: n for n in fed}, {n: n for n in outputs})


def feeds(made: Graph) -> Mapping[str, Array]:
    """Numbers; one agent may not do the first thing, and no branch's last action exists."""
    found: dict[str, Array] = {}
    for n in made.nodes:
        if n.op == "Placeholder":
            shape = (ROWS, *n.attrs["shape"].dims[1:])
            whole = np.arange(-1, np.prod(shape) - 1, dtype=INT32).reshape(shape)
            found[n.name] = whole if n.attrs["dtype"] == INT32 else floats(*shape)
            if n.name == "masks":
                found[n.name] = np.ones(shape, np.float32)
                found[n.name][0, 0] = 0
    return found


def leaned(tested: Policy) -> Graph:
    return prepare(tested, FEWER_OPS)


CONSTANTS = {
    "two": f32(2),
    "half": f32(0.5),
    "row": f32(1, 2, 3),
    "one": f32(1).reshape(()),
    "zero": f32(0).reshape(()),
    "magic": f32(2**23).reshape(()),
    "ones": np.ones((4, 1, 1), np.float32),
    "high": f32(1.5).reshape(()),
    "low": f32(-0.5).reshape(()),
    "hundred": f32(100).reshape(()),
    "epsilon": f32(1e-6).reshape(()),
}


def arithmetic(steps: str) -> Graph:
    """A graph of "a = Mul x two; y = Add a z"."""
    nodes = [placeholder("x", (None, 3)), placeholder("z", (None, 3))]
    used = steps.replace(";", " ").split()
    nodes += [const(n, v) for n, v in CONSTANTS.items() if n in used]
    for step in steps.split("; "):
        name, _, op, *inputs = step.split()
        nodes.append(node(name, op, *inputs))
    return graph(*nodes)


@pytest.mark.parametrize(
    ("before", "outputs", "expected"),
    [
        # ---- branches
        (branches(3, 2, 4), ["scores", "action", "best"], {"MatMul": 2, "SplitV": 1, "StridedSlice": 3, "Log": 3}),
        (branches(3, 2, biased=True), ["scores", "action"], {"MatMul": 2, "BiasAdd": 1, "RealDiv": 1, "Log": 2}),
        (branches(2, 2), ["action", "log0"], {"MatMul": 3, "Mul": 1, "Log": 2}),
        (branches(2, 2), ["action", "more0"], {"Mul": 1, "Add": 2}),
        (branches(2, 2), ["action", "masked0", "share0"], {"Mul": 2, "RealDiv": 2}),  # outputs stay what they are
        (branches(60, 60), ["action"], {"Sum": 2, "RealDiv": 2, "Mul": 2}),  # a product of 120 rows is no sum
        (branches(5), ["action"], {"Sum": 1, "MatMul": 1}),
        # ---- the last action
        (one_hots(3, 2), ["y"], {"GatherV2": 1, "Equal": 1, "Cast": 1, "ConcatV2": 1}),
        (one_hots(3, 2, column=1), ["y", "hot0"], {"OneHot": 2, "StridedSlice": 2, "ConcatV2": 1}),
        (one_hots(1000, 1000), ["y"], {"OneHot": 2}),  # constants as long as all classes
        # ---- what only looks alike
        (spread_column(), ["y"], {"Mul": 2}),
        (beside(("a", 0, 2), ("b", 2, 1), ("c", 1, 3)), ["y"], {"StridedSlice": 3}),
        (sums_of_two_and_of_three(), ["y"], {"AddN": 2}),
        # ---- constants
        (arithmetic("a = Mul x two; y = RealDiv a half"), ["y"], {"Mul": 1, "RealDiv": 0}),
        (arithmetic("a = Sub x row; y = Sub a two"), ["y"], {"Add": 1, "Sub": 0}),
        (arithmetic("a = Mul two x; y = RealDiv two a"), ["y"], {"Mul": 1, "RealDiv": 1}),
        (arithmetic("a = Mul x two; y = Mul a half"), ["y", "a"], {"Mul": 2}),
        (arithmetic("a = Add x magic; y = Sub a magic"), ["y"], {"Add": 1, "Sub": 1}),  # it rounds
        (arithmetic("a = Sub x hundred; y = Add a epsilon"), ["y"], {"Sub": 1, "Add": 1}),  # a logarithm's, maybe
        (arithmetic("a = Mul x one; b = Add a zero; y = Add b z"), ["y"], {"Mul": 0, "Add": 1}),
        (arithmetic("a = Mul x ones; y = Add a z"), ["y"], {"Mul": 1, "Add": 1}),  # it repeats
        # ---- the same twice
        (arithmetic("a = Tanh x; b = Tanh x; y = Add a b"), ["y"], {"Tanh": 1}),
        (arithmetic("a = Tanh x; b = Tanh x; y = Add a b"), ["y", "b"], {"Tanh": 2}),
        (arithmetic("d = Sub x z; y = Square d"), ["y"], {"SquaredDifference": 1}),
        (arithmetic("d = Sub x z; y = Square d"), ["y", "d"], {"Sub": 1, "Square": 1}),
    ],
)
def test_fewer_ops_give_the_same(before: Graph, outputs: Sequence[str], expected: Mapping[str, int]) -> None:
    tested = policy(before, outputs)
    made = leaned(tested)
    counted = Counter(ops(made))
    assert {op: counted[op] for op in expected} == expected
    wanted, found = (run_graph(g, feeds(before), outputs) for g in (before, made))
    for name in outputs:
        np.testing.assert_allclose(found[name], wanted[name], rtol=2e-6, atol=1e-6, strict=True)


@pytest.mark.parametrize("kind", ["deep", "doubling"])
def test_what_a_stranger_piled_up_takes_no_time_and_no_stack(kind: str) -> None:
    """Chains longer than Python's stack; tensors joined with themselves and cut again, 2³⁰ ways to their source."""
    nodes, ends = [const("over", np.array([1], np.int32))], []
    for side in ("a", "b"):
        at, count = f"{side}/t0", 400 if kind == "deep" else 30
        nodes.append(node(at, "Softmax", side))
        for i in range(1, count):
            before, at = at, f"{side}/t{i}"
            if kind == "deep":
                nodes.append(node(at, "Tanh", before))
            else:
                twice = f"{side}/twice{i}"
                nodes += [node(twice, "ConcatV2", before, before, "axis", N=2), *columns(at, twice, 1, 3)]
        whole, share = f"{side}/whole", f"{side}/share"
        nodes += [node(whole, "Sum", at, "over", keep_dims=True), node(share, "RealDiv", at, whole)]
        ends.append(share)
    made = beside(("a", 0, 2), ("b", 2, 4), then=nodes, joined=ends)
    wanted, found = (run_graph(g, feeds(made), ["y"]) for g in (made, leaned(policy(made, ["y"]))))
    np.testing.assert_allclose(found["y"], wanted["y"], rtol=2e-6, atol=1e-6)


def test_a_product_with_zeros_spreads_nothing_that_is_no_number() -> None:
    """A sum over a branch stays a sum where the other branch may hold an infinity."""
    before = branches(2, 2)
    infinite = [Node(n.name, "Exp", n.inputs) if n.op == "Softmax" else n for n in before.nodes]
    made = leaned(policy(Graph(tuple(infinite)), ["action"]))
    assert Counter(ops(made))["Sum"] == 2


@pytest.mark.parametrize("runtime", ["onnxruntime", "tfjs-cpu", "tfjs-wasm"])
@pytest.mark.parametrize(
    ("before", "outputs"),
    [
        (branches(3, 2, 4), ["scores", "action"]),
        (one_hots(3, 2), ["y"]),
        (arithmetic("a = Minimum x high; b = Maximum a low; d = Sub b z; y = Square d"), ["y"]),
    ],
    ids=["branches", "one-hot", "clip"],
)
def test_runtimes_compute_the_same(before: Graph, outputs: Sequence[str], runtime: str, runtimes: Runtimes) -> None:
    tested, fed = policy(before, outputs), feeds(before)
    wanted = run_graph(before, fed, outputs)
    given = runtimes.onnx(tested, fed, 15) if runtime == "onnxruntime" else runtimes.tfjs(runtime, tested, fed)
    for name, array in zip(outputs, given, strict=True):
        assert difference(wanted[name], array, narrowed=True) is None, name
