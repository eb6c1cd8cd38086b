"""Builds a layer of converters/graph/nn over inputs and runs it, for comparison with numpy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nodes import NameScope, Node, TensorShape
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.types import BATCH
from tests import conftest
from tests.graph.harness import Bindings

Array = npt.NDArray[Any]
#: Same examples in every run: a failure is about the change at hand.
examples = conftest.examples(60, derandomize=True)
TOLERANCE = {"atol": 2e-5, "rtol": 2e-5}


def floats(low: float = -10, high: float = 10) -> st.SearchStrategy[float]:
    """Numbers that float32 has; the edges too, and no subnormal ones, which runtimes flush."""
    return st.floats(low, high, width=32, allow_subnormal=False)


def arrays(*shape: int, low: float = -10, high: float = 10) -> st.SearchStrategy[Array]:
    """Arrays of one shape."""
    return hnp.arrays(np.float32, shape, elements=floats(low, high))


def tensors(low: float = -10, high: float = 10, *, min_dims: int = 1, max_dims: int = 4) -> st.SearchStrategy[Array]:
    """Arrays of any shape that a layer sees, the batch first."""
    shapes = hnp.array_shapes(min_dims=min_dims, max_dims=max_dims, min_side=1, max_side=4)
    return hnp.arrays(np.float32, shapes, elements=floats(low, high))


def run(layer: Callable[..., str | Sequence[str]], *inputs: Array) -> list[Array]:
    """What a layer makes of inputs [B, …]: by the kernels, and again after the graph has the spelling of TF 1.4.

    Both must be equal, and as the inferred types say.
    """
    b = Builder(NameScope(()))
    names = []
    for index, array in enumerate(inputs):
        attrs = {"dtype": array.dtype, "shape": TensorShape((None, *array.shape[1:]) if array.ndim else ())}
        names.append(b.append(Node(f"x{index}", "Placeholder", attrs=attrs)))
    b.prefix = "layer"
    made = layer(b, *names)
    outputs = [made] if isinstance(made, str) else list(made)
    fetches = [b.append(Node(f"y{i}", "Identity", (r,))) for i, r in enumerate(outputs)]
    graph, feeds = b.graph(), dict(zip(names, inputs, strict=True))
    results = run_graph(graph, feeds, fetches)
    spelled = run_graph(normalise(graph), feeds, fetches)
    bound = Bindings()
    if inputs and inputs[0].ndim:
        bound.lengths[BATCH] = len(inputs[0])
    for name in fetches:
        np.testing.assert_array_equal(results[name], spelled[name])
        assert not list(bound.problems(name, b.type_of(name), results[name]))
    return [results[name] for name in fetches]


def run_one(layer: Callable[..., str], *inputs: Array) -> Array:
    """The result of a layer that has one."""
    (result,) = run(layer, *inputs)
    return result
