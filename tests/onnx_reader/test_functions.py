"""Models with functions of their own, as PyTorch's newer exporter writes them: inlined, within bounds."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnx.parser
import pytest

from signatures.errors import DamagedFileError, UnsupportedOpError
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


def test_a_function_that_calls_itself_is_refused(tmp_path: Path) -> None:
    functions = [function("F", [call("G", "a", "b")]), function("G", [call("F", "a", "b")])]
    with pytest.raises(DamagedFileError, match="calls itself"):
        read(with_functions([call("F", "x", "y")], functions), tmp_path)


def test_an_op_that_onnx_defines_by_others_is_inlined(bench: Bench) -> None:
    """MeanVarianceNormalization has no entry of its own in the importer's table."""
    from converters.onnx.importer.table import TABLE

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
