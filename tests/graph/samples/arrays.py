"""Samples of ops: arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.types import INT32, INT64
from tests.graph.samples.base import (
    INF,
    NAN,
    NO_LOWERING,
    NO_SUCH_OP,
    TFJS,
    UNKNOWN_BATCH,
    Array,
    Operand,
    Sample,
    SampleBuilder,
    bools,
    const,
    f32,
    fixed,
    floats,
    ints,
    sample,
    shape_of,
    via,
)


def _sources() -> Iterator[Sample]:
    for array in (floats(2, 3), ints(4), ints(2, 2, dtype=np.int64), bools(3), f32(2.5).reshape(())):
        title = f"{array.dtype}, rank {array.ndim}"
        yield Sample("Const", title, (Node("op", "Const", value=array),), {})
        attrs = {"dtype": array.dtype, "shape": TensorShape((None, *array.shape[1:]) if array.ndim else ())}
        node = Node("op", "Placeholder", attrs=attrs)
        yield Sample("Placeholder", title, (node,), {"op": array})
    for op in ("Identity", "StopGradient", "Snapshot"):
        yield sample(op, "float32", floats(3, 4))
        yield sample(op, "int32", ints(3))
    yield sample("PreventGradient", "float32", floats(3, 4), differs=NO_SUCH_OP)
    yield sample("PreventGradient", "int32", ints(3), differs=NO_SUCH_OP)
    yield sample("CheckNumerics", "matrix", floats(3, 4), message="not finite", differs=NO_SUCH_OP)
    yield sample("CheckNumerics", "rank 1", floats(3), differs=NO_SUCH_OP)


def _shapes() -> Iterator[Sample]:
    for op in ("Shape", "Size"):
        yield sample(op, "matrix", floats(3, 4), out_type=INT32)
        yield sample(op, "int64", floats(3, 4, 2), out_type=INT64)
        differs = NO_EMPTY if op == "Shape" else None
        yield sample(op, "scalar", f32(1).reshape(()), out_type=INT32, differs=differs)
    yield sample("Rank", "matrix", floats(3, 4), differs=NO_LOWERING)
    yield sample("Rank", "scalar", f32(1).reshape(()), differs=NO_LOWERING)
    yield sample("Reshape", "to a known shape", fixed(floats(3, 4)), const(2, 6))
    yield sample("Reshape", "flatten", floats(3, 4, 2), const(-1, 8))
    yield sample("Reshape", "split the last axis", floats(3, 6), const(-1, 2, 3))
    yield sample("Reshape", "rows into the batch", floats(3, 6), const(-1, 2))
    yield sample("Reshape", "int64 shape", floats(3, 6), const(-1, 6, 1, dtype=np.int64))
    yield sample("Reshape", "to a scalar", fixed(floats(1, 1)), const(np.zeros(0, np.int32)))
    rows = via("StridedSlice", shape_of("x0"), *_vectors(0, 1, 1), shrink_axis_mask=1)
    yield sample("Reshape", "computed", floats(3, 4, 2), via("Pack", rows, const(8)))
    rows = via("StridedSlice", shape_of("x0"), *_vectors(0, 1, 1))
    yield sample("Reshape", "computed, joined", floats(3, 4, 2), via("ConcatV2", rows, *_vectors(8), const(0)))
    yield sample("Squeeze", "all", fixed(floats(1, 3, 1, 2)))
    yield sample("Squeeze", "named", floats(2, 1, 3, 1), squeeze_dims=(1,))
    yield sample("Squeeze", "named, negative", floats(2, 1, 3, 1), squeeze_dims=(-1, 1))
    yield sample("ExpandDims", "in front", floats(3, 4), const(0))
    yield sample("ExpandDims", "behind", floats(3, 4), const(-1))
    yield sample("ExpandDims", "vector of an axis", floats(3, 4), const(np.array([1], np.int32)))
    yield sample("Transpose", "matrix", floats(3, 4), const(1, 0))
    yield sample("Transpose", "image", floats(2, 3, 4, 5), const(0, 3, 1, 2))
    yield sample("Transpose", "scalar", f32(3).reshape(()), const(np.zeros(0, np.int32)))
    yield sample("Transpose", "int32, int64 order", ints(2, 3, 4), const(2, 0, 1, dtype=np.int64))


def _vectors(*values: int) -> list[Operand]:
    return [const(np.array([v], np.int32)) for v in values]


def _joins() -> Iterator[Sample]:
    a, b, c = floats(3, 2), floats(3, 4, seed=1), floats(3, 1, seed=2)
    yield sample("ConcatV2", "columns", a, b, c, const(1))
    yield sample("ConcatV2", "negative axis", floats(3, 2, 2), floats(3, 2, 1, seed=1), const(-1))
    yield sample("ConcatV2", "rows", a, floats(3, 2, seed=1), const(0))
    yield sample("ConcatV2", "int64", ints(3, 1, dtype=np.int64), ints(3, 2, dtype=np.int64), const(1))
    yield sample("Pack", "in front", floats(3, 2), floats(3, 2, seed=1))
    yield sample("Pack", "behind", floats(3, 2), floats(3, 2, seed=1), axis=-1)
    yield sample("Pack", "between, three", floats(3, 2), floats(3, 2, seed=1), floats(3, 2, seed=2), axis=1)
    yield sample("Pack", "scalars", const(3), const(4), fixed(np.array(5, np.int32)))
    yield sample("Unpack", "columns", floats(4, 3), num=3, axis=1, outputs=3)
    yield sample("Unpack", "negative axis", floats(4, 3, 2), num=2, axis=-1, outputs=2)
    yield sample("Unpack", "first axis", fixed(ints(2, 3)), num=2, axis=0, outputs=2)
    yield sample("Split", "columns", const(1), floats(3, 8), num_split=4, outputs=4)
    yield sample("Split", "negative axis", const(-1), floats(2, 3, 4), num_split=2, outputs=2)
    yield sample("Split", "one part", const(1), floats(3, 4), num_split=1)
    yield sample(
        "Split",
        "rows",
        const(0),
        floats(4, 3),
        num_split=2,
        outputs=2,
        differs=UNKNOWN_BATCH,
    )
    yield sample("SplitV", "columns", floats(3, 6), const(1, 2, 3), const(1), num_split=3, outputs=3)
    yield sample("SplitV", "the rest", floats(3, 6), const(2, -1), const(-1), num_split=2, outputs=2)
    yield sample(
        "SplitV",
        "rows, the rest",
        floats(4, 3),
        const(1, -1),
        const(0),
        num_split=2,
        outputs=2,
        differs=UNKNOWN_BATCH,
    )


def _slices() -> Iterator[Sample]:
    yield sample("Slice", "columns", floats(3, 5), const(0, 1), const(-1, 2))
    yield sample("Slice", "to the end", floats(3, 5, 2), const(0, 2, 0), const(-1, -1, 1))
    yield sample("Slice", "rows", floats(4, 5), const(1, 0), const(2, -1))
    yield sample("Slice", "int64 bounds", ints(3, 5), const(0, 3, dtype=np.int64), const(-1, 2, dtype=np.int64))
    yield strided("x[:, 1:3]", (3, 5), (0, 1), (0, 3), begin_mask=1, end_mask=1)
    yield strided("x[:, 2]", (3, 5), (0, 2), (0, 3), begin_mask=1, end_mask=1, shrink_axis_mask=2)
    yield strided("x[:, -1]", (3, 5), (0, -1), (0, 0), begin_mask=1, end_mask=1, shrink_axis_mask=2)
    yield strided("x[:, -3:-1]", (3, 5), (0, -3), (0, -1), begin_mask=1, end_mask=1)
    yield strided("x[:, ::-1]", (3, 5), (0, 0), (0, 0), (1, -1), begin_mask=3, end_mask=3)
    yield strided("x[:, 3:0:-2]", (3, 5), (0, 3), (0, 0), (1, -2), begin_mask=1, end_mask=1)
    yield strided("x[:, 1::2]", (3, 6), (0, 1), (0, 0), (1, 2), begin_mask=1, end_mask=3)
    yield strided("x[:, 3:99]", (3, 5), (0, 3), (0, 99), begin_mask=1, end_mask=1)
    yield strided("x[:, newaxis]", (3, 5), (0, 0), (0, 0), begin_mask=1, end_mask=1, new_axis_mask=2)
    yield strided("x[..., newaxis]", (3, 5), (0, 0), (0, 0), ellipsis_mask=1, new_axis_mask=2)
    yield strided("x[..., 1]", (2, 3, 4), (0, 1), (0, 2), ellipsis_mask=1, shrink_axis_mask=2)
    yield strided("x[:, ..., 0:2]", (2, 3, 4), (0, 0, 0), (0, 0, 2), begin_mask=1, end_mask=1, ellipsis_mask=2)
    yield strided("x[newaxis, 0]", (3, 5), (0, 0), (0, 1), new_axis_mask=1, shrink_axis_mask=2)
    yield strided("x[1]", (3, 5), (1,), (2,), shrink_axis_mask=1)
    yield strided("x[1:]", (3, 5), (1,), (0,), end_mask=1)
    yield strided("x[:, 2:2]", (3, 5), (0, 2), (0, 2), begin_mask=1, end_mask=1)
    yield strided(
        "x[:, 1, ::2]",
        (3, 2, 4),
        (0, 1, 0),
        (0, 0, 0),
        (1, 1, 2),
        begin_mask=5,
        end_mask=5,
        shrink_axis_mask=2,
    )
    yield sample("StridedSlice", "of a shape", shape_of(floats(3, 4, 2)), *_vectors(1, 3, 1))
    yield sample("StridedSlice", "int32", ints(3, 4), const(0, 1), const(0, 2), const(1, 1), begin_mask=1, end_mask=1)


def strided(
    title: str,
    shape: Sequence[int],
    begin: Sequence[int],
    end: Sequence[int],
    step: Sequence[int] = (),
    *,
    differs: Mapping[str, str] | None = None,
    **masks: int,
) -> Sample:
    bounds = [const(np.array(v, np.int32)) for v in (begin, end, step or [1] * len(begin))]
    return sample("StridedSlice", title, floats(*shape), *bounds, differs=differs, **masks)


def _gathers() -> Iterator[Sample]:
    table = floats(5, 3)
    yield sample("Gather", "rows", const(table), np.array([4, 0, 2], np.int32))
    yield sample("Gather", "int64 matrix of indices", const(table), ints(2, 2, low=0, high=4, dtype=np.int64))
    yield sample("GatherV2", "rows", const(table), np.array([4, 0, 2], np.int32), const(0))
    yield sample("GatherV2", "columns", floats(3, 5), const(2, 0), const(1))
    yield sample("GatherV2", "one column", floats(3, 5), const(3), const(1))
    yield sample("GatherV2", "negative axis", floats(2, 3, 4), const(np.array([[1, 3]], np.int32)), const(-1))


def _fills() -> Iterator[Sample]:
    seven = const(f32(7).reshape(()))
    yield sample("Fill", "constant", const(2, 3), seven)
    yield sample("Fill", "as an input", shape_of(floats(3, 2)), seven)
    yield sample("Fill", "int32, fed value", const(2, 2), fixed(np.array(3, np.int32)))
    yield sample("BroadcastTo", "rows", const(floats(4)), const(3, 4))
    yield sample("BroadcastTo", "column", fixed(floats(3, 1)), const(3, 4))
    yield sample("BroadcastTo", "scalar to a scalar", f32(3).reshape(()), const(np.zeros(0, np.int32)))
    yield sample("BroadcastTo", "as an input", const(floats(1, 4)), shape_of(floats(3, 4)))
    yield sample("Tile", "columns", floats(3, 2), const(1, 3))
    yield sample("Tile", "rows", floats(3, 2), const(2, 1))
    yield sample("Tile", "int64", ints(2, 1, dtype=np.int64), const(1, 4, dtype=np.int64))
    yield sample("Range", "constant", const(2), const(11), const(3))
    yield sample("Range", "downwards", const(5), const(0), const(-2))
    yield sample("Range", "to a fed limit", const(0), fixed(np.array(4, np.int32)), const(1))
    yield sample("Range", "float32", *(const(f32(v).reshape(())) for v in (0.0, 1.0, 0.1)))


def _one_hots() -> Iterator[Sample]:
    on, off = const(f32(1).reshape(())), const(f32(0).reshape(()))
    indices = np.array([0, 2, 1], np.int32)
    yield sample("OneHot", "vector", indices, const(3), on, off)
    yield sample("OneHot", "outside of the depth", np.array([-1, 3, 7, -3, 2], np.int32), const(3), on, off)
    yield sample("OneHot", "axis 0", indices, const(4), on, off, axis=0)
    yield sample("OneHot", "axis 1 of 3", ints(3, 2, low=0, high=3), const(4), on, off, axis=1)
    yield sample("OneHot", "last axis, said", ints(3, 2, low=0, high=3), const(4), on, off, axis=2)
    yield sample("OneHot", "int64 indices", ints(3, 2, low=0, high=3, dtype=np.int64), const(4), on, off)
    yield sample("OneHot", "depth 1", np.array([0, 1, -1], np.int32), const(1), on, off)
    yield sample("OneHot", "other values", indices, const(3), const(f32(-2).reshape(())), const(f32(0.5).reshape(())))
    yield sample("OneHot", "int32 values", indices, const(3), const(5), const(-1))
    yield sample("OneHot", "one column of a matrix", np.array([[0], [2], [1]], np.int32), const(3), on, off)


#: What LiteRT answers nothing of.
NO_EMPTY = dict.fromkeys(("litert", "litert-plain"), "the interpreter hands out no empty tensor")
#: Places of a matrix, in order.
ROWS = np.array([[0, 1], [1, 3], [2, 0]], np.int32)


def _places() -> Iterator[Sample]:
    at_once = dict.fromkeys(TFJS, "how many it finds is known only when the model runs")
    yield sample("Where", "booleans", bools(3, 4), differs=at_once)
    yield sample("Where", "numbers, NaN among them", f32(0, -0.0, NAN, 1, INF, 0).reshape(3, 2), differs=at_once)
    yield sample("Where", "int32, rank 3", ints(2, 3, 2, low=-1, high=1), differs=at_once)
    yield sample("Where", "nothing found", np.zeros((2, 2), bool), differs=at_once)
    zero = const(f32(0).reshape(()))
    yield sample("SparseToDense", "a vector of places", const(1, 3), const(np.array([5], np.int32)), floats(2), zero)
    yield sample("SparseToDense", "places of a matrix", const(ROWS), const(3, 4), floats(3), const(f32(-1).reshape(())))
    yield sample("SparseToDense", "one value", const(ROWS), const(3, 4), fixed(f32(2.5).reshape(())), zero)
    yield sample(
        "SparseToDense", "one place", const(2), const(np.array([4], np.int32)), fixed(f32(7).reshape(())), zero
    )
    yield sample(
        "SparseToDense", "places that are fed, int64", np.array([0, 2], np.int64), const(np.array([4])), f32(1, 2), zero
    )
    yield sample(
        "SparseToDense",
        "int32 values, out of order",
        const(3, 0),
        const(np.array([4], np.int32)),
        ints(2),
        const(9),
        validate_indices=False,
    )


def samples() -> Iterator[Sample]:
    yield from _sources()
    yield from _shapes()
    yield from _joins()
    yield from _slices()
    yield from _gathers()
    yield from _fills()
    yield from _one_hots()
    yield from _places()


def random_slices(count: int, seed: int) -> tuple[Graph, dict[str, Array], list[str]]:
    """(graph, feeds, fetches) of many StridedSlices of one array, with bounds and masks as TensorFlow allows them."""
    random = np.random.default_rng(seed)
    array = floats(3, 4, 5)
    builder = SampleBuilder()
    source = builder.operand(fixed(array))
    fetches = []
    while len(fetches) < count:
        entries = int(random.integers(1, 6))
        masks = {name: int(random.integers(0, 2**entries)) for name in ("begin", "end", "new_axis", "shrink_axis")}
        masks["ellipsis"] = 1 << int(random.integers(0, entries)) if random.random() < 0.5 else 0
        covered = [i for i in range(entries) if not (masks["ellipsis"] | masks["new_axis"]) >> i & 1]
        if len(covered) > array.ndim:
            continue
        taken = [i for i in covered if masks["shrink_axis"] >> i & 1]
        begin, end = random.integers(-7, 8, entries), random.integers(-7, 8, entries)
        begin[taken] = random.integers(-3, 3, len(taken))  # inside of every axis
        strides = random.choice([-2, -1, 1, 2, 3], entries)
        strides[taken] = 1
        bounds = [builder.operand(const(v.astype(np.int32))) for v in (begin, end, strides)]
        name = f"slice_{len(fetches)}"
        attrs = {f"{key}_mask": value for key, value in masks.items()}
        builder.nodes.append(Node(name, "StridedSlice", (source, *bounds), attrs))
        fetches.append(name)
    return Graph(tuple(builder.nodes)), builder.feeds, fetches
