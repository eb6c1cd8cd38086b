"""Models with functions of their own, as PyTorch's newer exporter writes them: inlined, within bounds."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest

from export_model.converters.formats.onnx.functions import inline_functions
from export_model.signatures.errors import DamagedFileError, UnsupportedOpError
from tests.onnx_reader.models import Bench, floats, helper, imported, model, node, read

OPSETS = [helper.make_opsetid("", 18), helper.make_opsetid("own", 1)]


def with_functions(nodes: Sequence[Any], functions: Sequence[Any]) -> Any:
    message = model(nodes, {"x": (np.float32, ["batch", 4])}, opset=18, domains={"own": 1})
    message.functions.extend(functions)
    return message


def function(name: str, nodes: Sequence[Any]) -> Any:
    return helper.make_function("own", name, ["a"], ["b"], list(nodes), OPSETS)


def call(name: str, given: str, made: str) -> Any:
    return node(name, [given], made, domain="own")


def test_functions_are_inlined(bench: Bench) -> None:
    functions = [
        function("Swish", [node("Sigmoid", ["a"], "s"), node("Mul", ["a", "s"], "b")]),
        function("Twice", [call("Swish", "a", "m"), call("Swish", "m", "b")]),
    ]
    path = bench.place(with_functions([call("Twice", "x", "h"), node("Tanh", ["h"])], functions))
    x = floats(3, 4)
    (got,), (wanted,) = imported(path, {"x": x}, ["y"]), bench.onnxruntime(path, {"x": x}, ["y"])
    np.testing.assert_allclose(got, wanted, atol=1e-6)


def test_functions_that_unfold_to_a_bomb_are_refused(tmp_path: Path) -> None:
    """Twenty functions, each of which calls the next one four times: 4²⁰ nodes."""
    names = [f"F{i}" for i in range(20)]
    functions = [function(names[-1], [node("Neg", ["a"], "b")])]
    for name, following in itertools.pairwise(names):
        steps = [call(following, "a" if i == 0 else f"t{i}", "b" if i == 3 else f"t{i + 1}") for i in range(4)]
        functions.append(function(name, steps))
    with pytest.raises(UnsupportedOpError, match="unfold"):
        read(with_functions([call("F0", "x", "y")], functions), tmp_path)


def twice(depth: int, first: Sequence[Any], **given: Any) -> list[Any]:
    """Functions F0, of the nodes ``first``, to F<depth>, each of which calls the one before it twice."""
    made = [function("F0", first)]
    for i in range(depth):
        calls = [node(f"F{i}", ["a"], "t", domain="own", **given), node(f"F{i}", ["t"], "b", domain="own", **given)]
        made.append(function(f"F{i + 1}", calls))
    return made


NEGATED = [node("Neg", ["a"], "b")]


def overloaded() -> Any:
    """Harmless functions have the names of those that are called, and come last."""
    functions = twice(22, NEGATED)
    for each in (*functions, *(n for f in functions[1:] for n in f.node)):
        each.overload = "much"
    harmless = [function(f"F{i}", NEGATED) for i in range(23)]
    top = call("F22", "x", "y")
    top.overload = "much"
    return with_functions([top], [*functions, *harmless])


def joined() -> Any:
    """What onnx's inliner calls ``own::F22::much`` is a name here, an overload there."""
    functions = twice(22, NEGATED)
    for each in functions:
        each.name += "::much"
    for each in (n for f in functions[1:] for n in f.node):
        each.overload = "much"
    top = call("F22", "x", "y")
    top.overload = "much"
    return with_functions([top], functions)


def standard() -> Any:
    """Functions of ``ai.onnx``, called as those of no domain."""
    functions = twice(22, NEGATED)
    for each in functions:
        each.domain = "ai.onnx"
        for called in each.node:
            called.domain = ""
    return with_functions([node("F22", ["x"])], functions)


def swelling() -> Any:
    """48 kB, 2¹⁴ times."""
    big = onnx.numpy_helper.from_array(np.ones(12_000, np.float32))
    return with_functions([call("F14", "x", "y")], twice(14, [node("Constant", [], "c", value=big), *NEGATED]))


def given_bytes() -> Any:
    """48 kB that are given to a function, which reads them 2¹² times."""
    leaf = node("Constant", [], "c")
    leaf.attribute.add(name="value", ref_attr_name="big", type=onnx.AttributeProto.TENSOR)
    functions = twice(12, [leaf, *NEGATED])
    for each in (n for f in functions[1:] for n in f.node):
        each.attribute.add(name="big", ref_attr_name="big", type=onnx.AttributeProto.TENSOR)
    big = onnx.numpy_helper.from_array(np.ones(12_000, np.float32))
    return with_functions([node("F12", ["x"], domain="own", big=big)], functions)


def given_nodes() -> Any:
    """Branches that are given on from function to function, each holding the former one twice."""
    functions = [function("F0", [node("Not", ["c"], "d"), node("If", ["d"], "b")])]
    functions[0].node[1].attribute.add(name="then_branch", ref_attr_name="body", type=onnx.AttributeProto.GRAPH)
    for i in range(20):
        both = [node("If", ["c"], "d"), node("If", ["c"], "b")]
        for each in both:
            each.attribute.add(name="then_branch", ref_attr_name="body", type=onnx.AttributeProto.GRAPH)
        body = helper.make_graph(both, "body", [], [])
        functions.append(function(f"F{i + 1}", [node(f"F{i}", ["a"], "b", domain="own", body=body)]))
    last = helper.make_graph([node("Neg", ["x"], "b")], "body", [], [])
    return with_functions([node("F20", ["x"], domain="own", body=last)], functions)


def defaults() -> Any:
    """A function's default is 1 MB, and a thousand calls leave it out."""
    functions = [function("F", NEGATED)]
    functions[0].attribute_proto.append(helper.make_attribute("text", "t" * (1 << 20)))
    return with_functions([call("F", "x", f"y{i}" if i else "y") for i in range(1000)], functions)


def long_names() -> Any:
    """A value's name of 1 MB, which a function reads a thousand times."""
    long = "n" * (1 << 20)
    functions = [function("F", [node("Neg", ["a"], f"c{i}" if i else "b") for i in range(1000)])]
    return with_functions([node("Neg", ["x"], long), call("F", long, "y")], functions)


def empty() -> Any:
    return with_functions([call("F22", "x", "y")], twice(22, []))


def deep() -> Any:
    chain = [function("F0", NEGATED), *(function(f"F{i + 1}", [call(f"F{i}", "a", "b")]) for i in range(1500))]
    return with_functions([call("F1500", "x", "y")], chain)


@pytest.mark.parametrize(
    "make",
    [overloaded, joined, standard, swelling, given_bytes, given_nodes, defaults, long_names, empty, deep],
)
def test_functions_are_refused_by_what_they_unfold_to(make: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Before onnx unfolds them; whatever hides their size."""
    monkeypatch.setattr("onnx.inliner.inline_local_functions", None)
    with pytest.raises(UnsupportedOpError, match=r"functions (unfold|call one another)"):
        inline_functions(make())


def test_a_function_is_told_from_another_of_its_name(bench: Bench) -> None:
    """Each overload has defaults of its own."""
    text = """
        <ir_version: 10, opset_import: ["":18, "own":1]>
        test (float[batch, 4] x) => (float[batch, 4] y) { h = own.Scale:a (x) y = own.Scale:b (h) }
        <domain: "own", overload: "a", opset_import: ["":18]>
        Scale <alpha: float = 0.25> (a) => (b) { b = LeakyRelu <alpha = @alpha> (a) }
        <domain: "own", overload: "b", opset_import: ["":18]>
        Scale <alpha: float = 0.5> (a) => (b) { b = LeakyRelu <alpha = @alpha> (a) }
    """
    path = bench.place(onnx.parser.parse_model(text))
    (got,) = imported(path, {"x": -np.ones((1, 4), np.float32)}, ["y"])
    np.testing.assert_allclose(got, -0.125 * np.ones((1, 4)))


def test_a_function_that_calls_itself_is_refused(tmp_path: Path) -> None:
    functions = [function("F", [call("G", "a", "b")]), function("G", [call("F", "a", "b")])]
    with pytest.raises(DamagedFileError, match="calls itself"):
        read(with_functions([call("F", "x", "y")], functions), tmp_path)


def test_an_op_that_onnx_defines_by_others_is_inlined(bench: Bench) -> None:
    """MeanVarianceNormalization has no entry of its own in the importer's table."""
    from export_model.converters.formats.onnx.importer.table import TABLE

    assert ("", "MeanVarianceNormalization") not in TABLE
    images = {"x": (np.float32, ["batch", 3, 4, 5])}
    for axes in ({}, {"axes": [1]}):  # left out: the op's default, all axes but the channels
        path = bench.place(model([node("MeanVarianceNormalization", ["x"], **axes)], images, opset=13))
        x = floats(3, 3, 4, 5)
        (got,), (wanted,) = imported(path, {"x": x}, ["y"]), bench.onnxruntime(path, {"x": x}, ["y"])
        np.testing.assert_allclose(got, wanted, atol=1e-5)


def test_a_function_whose_attribute_is_left_out_has_its_default(bench: Bench) -> None:
    """Its body has an op that ONNX defines by others, too."""
    text = """
        <ir_version: 9, opset_import: ["":18, "own":1]>
        test (float[batch, 4] x) => (float[batch, 4] y) {
            h = own.Scale (x)
            k = own.Scale <alpha = 3.0> (h)
            y = own.Norm (k)
        }
        <domain: "own", opset_import: ["":18]>
        Scale <alpha: float = 0.25> (a) => (b) { b = LeakyRelu <alpha = @alpha> (a) }
        <domain: "own", opset_import: ["":18]>
        Norm (a) => (b) { b = MeanVarianceNormalization <axes = [1]> (a) }
    """
    path = bench.place(onnx.parser.parse_model(text))
    x = floats(3, 4)
    (got,), (wanted,) = imported(path, {"x": x}, ["y"]), bench.onnxruntime(path, {"x": x}, ["y"])
    np.testing.assert_allclose(got, wanted, atol=1e-5)
