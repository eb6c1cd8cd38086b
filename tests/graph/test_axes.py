"""Every axis, list of axes and permutation of a file is held to the rank before anything is made of it.

A 389-byte ONNX (OneHot, axis 60,000,000) took 3.6 GB under ``inspect`` once: a list as long as the number was made.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.ops.base import axes_within, axis_within
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import infer_types
from export_model.signatures.errors import ExportModelError
from tests.graph.harness import Runtimes
from tests.graph.making import const, graph, node, placeholder

pytestmark = pytest.mark.xdist_group("graph-ops")

X = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
RANK = X.ndim
HUGE = (60_000_000, -60_000_000, 2**31 - 1, -(2**31))
#: More than any tensor here takes, less than a list as long as the smallest of the huge numbers.
ROOM = 64 << 20


def _of_constant(op: str, *, at: int, vector: bool = False, **attrs: Any) -> Callable[[int], Graph]:
    """The axis is an operand."""

    def made(axis: int) -> Graph:
        names = ["x", "x"] if op == "ConcatV2" else ["x", "sizes"] if op == "SplitV" else ["x"]
        names += ["index"] if op == "GatherV2" else []
        names.insert(at, "axis")
        return graph(
            placeholder("x", (None, 3, 4)),
            const("sizes", [1, -1]),
            const("index", [0]),
            const("axis", [axis] if vector else axis),
            node("op", op, *names, **attrs),
        )

    return made


def _of_attribute(op: str, name: str, *operands: str, many: bool = False, **attrs: Any) -> Callable[[int], Graph]:
    def made(axis: int) -> Graph:
        return graph(
            placeholder("x", (None, 3, 4)),
            placeholder("i", (None, 3, 4), np.int32),
            const("depth", 5),
            const("on", np.float32(1)),
            const("off", np.float32(0)),
            node("op", op, *operands, **{**attrs, name: [axis] if many else axis}),
        )

    return made


#: op → (a graph of it, whose axis is given; the axes that TensorFlow allows)
AXES: dict[str, tuple[Callable[[int], Graph], range]] = {
    "ExpandDims": (_of_constant("ExpandDims", at=1), range(-RANK - 1, RANK + 1)),
    "ConcatV2": (_of_constant("ConcatV2", at=2), range(-RANK, RANK)),
    "GatherV2": (_of_constant("GatherV2", at=2), range(-RANK, RANK)),
    "SplitV": (_of_constant("SplitV", at=2, num_split=2), range(-RANK, RANK)),
    "Split": (_of_constant("Split", at=0, num_split=1), range(-RANK, RANK)),
    "ArgMax": (_of_constant("ArgMax", at=1), range(-RANK, RANK)),
    **{op: (_of_constant(op, at=1, vector=True), range(-RANK, RANK)) for op in ("Sum", "Mean", "Max", "Min", "Prod")},
    "Pack": (_of_attribute("Pack", "axis", "x", "x"), range(-RANK - 1, RANK + 1)),
    "Unpack": (_of_attribute("Unpack", "axis", "x", num=3), range(-RANK, RANK)),
    "OneHot": (_of_attribute("OneHot", "axis", "i", "depth", "on", "off"), range(-1, RANK + 1)),
    "Squeeze": (_of_attribute("Squeeze", "squeeze_dims", "x", many=True), range(-RANK, RANK)),
}


def peak(call: Callable[[], object]) -> tuple[int, ExportModelError | None]:
    """(bytes taken at most, how it was refused) by a call."""
    tracemalloc.start()
    try:
        call()
        refused = None
    except ExportModelError as error:
        refused = error
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most, refused


@pytest.mark.parametrize("op", AXES)
def test_an_axis_outside_the_rank_is_refused_for_little(op: str) -> None:
    made, allowed = AXES[op]
    for axis in (*HUGE, allowed.start - 1, allowed.stop):
        most, refused = peak(lambda axis=axis: infer_types(made(axis)))  # type: ignore[misc]
        assert refused is not None and "op" in str(refused), axis
        assert most < ROOM, axis


@pytest.mark.parametrize("op", AXES)
def test_the_axes_that_tensorflow_allows_are_the_ones_allowed_here(op: str, runtimes: Runtimes) -> None:
    made, allowed = AXES[op]
    for axis in range(-RANK - 2, RANK + 3):
        whole = made(axis)
        feeds = {"x": X, "i": X.astype(np.int32)}
        taken = {n: v for n, v in feeds.items() if any(n in node.inputs for node in whole.nodes)}
        ours = theirs = None
        try:
            infer_types(whole)
            ours = run_graph(whole, taken, ["op"])["op"]
        except ExportModelError:
            assert axis not in allowed or op in ("Unpack", "Squeeze")
        try:
            (theirs,) = runtimes.tensorflow(whole, taken, ["op"])
        except ExportModelError:
            assert axis not in allowed or op in ("Unpack", "Squeeze")
        assert (ours is None) == (theirs is None), axis
        if ours is not None and theirs is not None:
            np.testing.assert_array_equal(ours, theirs)


def test_an_axis_counts_from_either_end() -> None:
    assert [axis_within(a, 3) for a in (-3, -1, 0, 2)] == [0, 2, 0, 2]
    assert axes_within(np.array([-1, 0, 2]), 3) == (0, 2)
    for axis, rank in ((3, 3), (-4, 3), (0, 0)):
        with pytest.raises(IndexError, match="must be one of"):
            axis_within(axis, rank)
