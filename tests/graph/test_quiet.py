"""Nothing that is computed warns: infinities, NaNs, the largest and smallest numbers, empty tensors, in every op."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from onnx import helper, numpy_helper

from export_model.converters.compiler.passes.fold import fold
from export_model.converters.files.tensorflow_messages import GraphDef, serialise
from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.run import run_graph
from export_model.signatures.errors import ExportModelError
from fixtures import path as fixture
from tests import conftest
from tests.commands import export_model
from tests.graph.samples import SAMPLES, Sample
from tests.hostile.zoo import onnx_policy

Array = npt.NDArray[Any]
#: The same examples in every run: a failure is about the change at hand.
examples = conftest.examples(10, derandomize=True)
ODD = (np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 0.5, 3e38, -3e38, 1e-45, 1e-38, 88.8, -104.0, 1e300, -2.0)


def odd(array: Array, random: Random, resized: bool) -> Array:
    """Other floats in the shape of an array, or of one that has another length along one axis. Integers are sizes and
    places, and stay.
    """
    if array.dtype.kind != "f":
        return array
    shape = list(array.shape)
    if resized and shape and random.random() < 0.3:
        shape[random.randrange(len(shape))] = random.choice((0, 0, 1, 2))
    few = random.sample(ODD, random.randint(1, 4))
    with np.errstate(all="ignore"):
        return np.array(random.choices(few, k=math.prod(shape))).astype(array.dtype).reshape(shape)


def changed(sample: Sample, random: Random) -> tuple[Graph, Mapping[str, Array]]:
    """A sample with odd numbers in what is fed to it, seldom in what is constant."""
    feeds = {
        name: odd(a, random, sample.outputs == 1) if random.random() < 0.8 else a for name, a in sample.feeds.items()
    }
    nodes = [
        replace(n, value=odd(n.value, random, sample.outputs == 1))
        if n.value is not None and random.random() < 0.2
        else n
        for n in sample.nodes
    ]
    return Graph(tuple(nodes)), feeds


def constants(graph: Graph, feeds: Mapping[str, Array]) -> Graph:
    """The graph with what is fed as constants."""
    return Graph(tuple(Node(n.name, "Const", value=feeds[n.name]) if n.name in feeds else n for n in graph.nodes))


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda s: f"{s.op} {s.title}".strip())
@examples
@given(seed=st.integers(0, 1 << 32))
def test_no_kernel_warns(sample: Sample, seed: int) -> None:
    random = Random(seed)
    graph, feeds = changed(sample, random)
    with warnings.catch_warnings(), np.errstate(all="warn"):
        warnings.simplefilter("error")
        for run in (
            lambda: run_graph(graph, feeds, sample.fetches),
            lambda: run_graph(graph, feeds, sample.fetches, Jitter(1)),
            lambda: fold(constants(graph, feeds)),
        ):
            with contextlib.suppress(ExportModelError):
                run()


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", ["continuous", "recurrent", "visual", "discrete", "sampled"])
def test_weights_of_any_numbers_are_read_and_written_in_silence(name: str, seed: int, tmp_path: Path) -> None:
    random = Random(seed)
    definition = GraphDef.FromString(fixture(name).read_bytes())
    for node in definition.node:
        tensor = node.attr["value"].tensor if node.op == "Const" else None
        if tensor is not None and tensor.dtype == 1 and len(tensor.tensor_content) > 4 and random.random() < 0.5:
            weights = odd(np.frombuffer(tensor.tensor_content, np.float32), random, resized=False)
            tensor.tensor_content = weights.tobytes()
    (tmp_path / "p.bytes").write_bytes(serialise(definition))
    ran = export_model(tmp_path / "p.bytes", "-o", tmp_path / "out", "--verify", "none")
    assert ran.status in (0, 2), ran.err
    assert "warning" not in ran.err.lower() and "did not expect" not in ran.err, ran.err


def test_a_normalisation_of_nothing_is_silent(tmp_path: Path) -> None:
    """The mean of an empty constant is a NaN, of which numpy warns in words."""
    nodes = [
        helper.make_node("LayerNormalization", ["nothing", "scale"], ["normal"]),
        helper.make_node("ReduceSum", ["normal"], ["sum"], keepdims=0),
        helper.make_node("MatMul", ["obs_0", "kernel"], ["product"]),
        helper.make_node("Add", ["product", "sum"], ["continuous_actions"]),
    ]
    empty = [
        numpy_helper.from_array(np.zeros(shape, np.float32), n) for n, shape in (("nothing", (2, 0)), ("scale", 0))
    ]
    model = onnx.ModelProto.FromString(onnx_policy(nodes, empty))
    model.opset_import[0].version = 17
    (tmp_path / "p.onnx").write_bytes(model.SerializeToString())
    ran = export_model(tmp_path / "p.onnx", "-o", tmp_path / "out", "--verify", "none")
    assert ran.status in (0, 2), ran.err
    assert "warning" not in ran.err.lower() and "did not expect" not in ran.err, ran.err
