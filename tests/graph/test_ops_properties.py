"""Laws of the op table, on many random arguments: slices, windows, rounding, rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.loops.layers import window_padding
from export_model.converters.graph.ops.table import TABLE
from export_model.converters.graph.types import INT32
from tests import conftest
from tests.graph.harness import Array, fitting
from tests.graph.making import const, defaults, placeholder

#: The same examples in every run: a failure is about the change at hand.
examples = conftest.examples(150, derandomize=True)


def kernel(op: str, *arrays: Array, **attrs: Any) -> Array:
    function = TABLE[op].kernel
    assert function is not None
    return np.asarray(function(Node("op", op, attrs={**defaults(op), **attrs}), *arrays))


# ------------------------------------------------------------------ slices

bounds = st.integers(-6, 6)


@st.composite
def slices(draw: st.DrawFn) -> tuple[Array, dict[str, int], list[Array], tuple[Any, ...]]:
    """(array, masks, begin end strides, what Python would write between the brackets)."""
    shape = tuple(draw(st.lists(st.integers(1, 4), min_size=1, max_size=4)))
    kinds = st.sampled_from(["slice", "take", "new"])
    entries = draw(st.lists(kinds, min_size=1, max_size=5).filter(lambda e: sum(k != "new" for k in e) <= len(shape)))
    if draw(st.booleans()):
        entries.insert(draw(st.integers(0, len(entries))), "ellipsis")
    masks = dict.fromkeys(("begin", "end", "ellipsis", "new_axis", "shrink_axis"), 0)
    operands: list[list[int]] = [[], [], []]
    index: list[Any] = []
    for i, kind in enumerate(entries):
        begin, end = draw(bounds), draw(bounds)
        stride = draw(st.sampled_from([1, 1, 2, 3, -1, -2]))
        # a set bit that a stronger one beats: ellipsis, then new axis, then shrink, then the bounds
        beaten = [draw(st.booleans()) for _ in range(3)]
        if kind == "ellipsis":
            masks["ellipsis"] |= 1 << i
            masks["new_axis"] |= beaten[0] << i
            masks["shrink_axis"] |= beaten[1] << i
            index.append(Ellipsis)
        elif kind == "new":
            masks["new_axis"] |= 1 << i
            masks["shrink_axis"] |= beaten[0] << i
            index.append(None)
        elif kind == "take":
            begin, stride = draw(st.sampled_from([0, -1])), 1
            masks["shrink_axis"] |= 1 << i
            index.append(begin)
        else:
            masks["begin"] |= beaten[0] << i
            masks["end"] |= beaten[1] << i
            index.append(slice(None if beaten[0] else begin, None if beaten[1] else end, stride))
        for operand, value in zip(operands, (begin, end, stride), strict=True):
            operand.append(value)
    array = np.arange(math.prod(shape), dtype=np.float32).reshape(shape)
    attrs = {f"{name}_mask": mask for name, mask in masks.items()}
    return array, attrs, [np.array(o, np.int32) for o in operands], tuple(index)


@examples
@given(slices())
def test_strided_slice_is_an_index_of_python(case: tuple[Array, dict[str, int], list[Array], tuple[Any, ...]]) -> None:
    array, attrs, operands, index = case
    np.testing.assert_array_equal(kernel("StridedSlice", array, *operands, **attrs), array[index], strict=True)


@examples
@given(slices(), st.booleans())
def test_strided_slice_has_the_inferred_shape(
    case: tuple[Array, dict[str, int], list[Array], tuple[Any, ...]], free: bool
) -> None:
    array, attrs, operands, _ = case
    shape = (None, *array.shape[1:]) if free else array.shape
    nodes = [placeholder("x", shape), *(const(n, o) for n, o in zip("bes", operands, strict=True))]
    graph = Graph((*nodes, Node("op", "StridedSlice", ("x", "b", "e", "s"), attrs)))
    assert fitting(graph, "op", {"x": array}, len(array)) == []


@examples
@given(hnp.array_shapes(min_dims=1, max_dims=3, max_side=5), st.data())
def test_slice_is_a_slice(shape: tuple[int, ...], data: st.DataObject) -> None:
    array = np.arange(math.prod(shape)).reshape(shape)
    begin = [data.draw(st.integers(0, n)) for n in shape]
    size = [data.draw(st.integers(-1, n - b)) for n, b in zip(shape, begin, strict=True)]
    expected = array[tuple(slice(b, n if s == -1 else b + s) for b, s, n in zip(begin, size, shape, strict=True))]
    np.testing.assert_array_equal(kernel("Slice", array, np.array(begin), np.array(size)), expected, strict=True)


# ------------------------------------------------------------------ windows

lengths = st.integers(1, 12)


@examples
@given(size=lengths, window=lengths, stride=st.integers(1, 5))
def test_valid_windows_are_those_that_fit(size: int, window: int, stride: int) -> None:
    starts = [s for s in range(0, size, stride) if s + window <= size]
    assert window_padding(size, window, stride, "VALID") == (len(starts), 0, 0)


@examples
@given(size=lengths, window=lengths, stride=st.integers(1, 5))
def test_same_windows_start_at_every_stride_with_the_least_padding(size: int, window: int, stride: int) -> None:
    count, before, after = window_padding(size, window, stride, "SAME")
    starts = range(0, size, stride)
    assert count == len(starts)
    least = next(p for p in itertools.count() if starts[-1] + window <= size + p)
    assert before + after == least
    assert after - before in (0, 1)


@st.composite
def images(draw: st.DrawFn) -> tuple[Array, dict[str, Any], tuple[int, int]]:
    """(image, attributes, window), the window not larger than what it slides over."""
    height, width = draw(st.integers(3, 7)), draw(st.integers(3, 7))
    window = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    attrs = {
        "padding": draw(st.sampled_from(["SAME", "VALID"])),
        "strides": (1, draw(st.integers(1, 3)), draw(st.integers(1, 3)), 1),
    }
    image = np.random.default_rng(draw(st.integers(0, 99))).normal(size=(2, height, width, 2)).astype(np.float32)
    return image, attrs, window


def looked_at(image: Array, attrs: Mapping[str, Any], window: tuple[int, int]) -> Array:
    """[B, H', W'] lists of the pixels under each window, NaN beside the image; by loops."""
    spans = [(w - 1) * d + 1 for w, d in zip(window, attrs.get("dilations", (1, 1, 1, 1))[1:3], strict=True)]
    (rows, top, _), (columns, left, _) = (
        window_padding(image.shape[1 + i], spans[i], attrs["strides"][1 + i], attrs["padding"]) for i in (0, 1)
    )
    found = np.full((len(image), rows, columns, *window, image.shape[3]), np.nan)
    for r, c, i, j in itertools.product(range(rows), range(columns), *map(range, window)):
        y = r * attrs["strides"][1] - top + i * attrs.get("dilations", (1, 1, 1, 1))[1]
        x = c * attrs["strides"][2] - left + j * attrs.get("dilations", (1, 1, 1, 1))[2]
        if 0 <= y < image.shape[1] and 0 <= x < image.shape[2]:
            found[:, r, c, i, j] = image[:, y, x]
    return found


@examples
@given(images())
def test_pools_look_at_the_image_only(case: tuple[Array, dict[str, Any], tuple[int, int]]) -> None:
    image, attrs, window = case
    attrs["ksize"] = (1, *window, 1)
    seen = looked_at(image, attrs, window)
    for op, function in (("MaxPool", np.nanmax), ("AvgPool", np.nanmean)):
        np.testing.assert_allclose(kernel(op, image, **attrs), function(seen, axis=(3, 4)), rtol=1e-6)


@examples
@given(images(), st.integers(1, 2), st.integers(1, 2))
def test_convolutions_are_sums_over_windows(
    case: tuple[Array, dict[str, Any], tuple[int, int]], down: int, right: int
) -> None:
    image, attrs, window = case
    attrs["dilations"] = (1, down, right, 1)
    spans = [(w - 1) * d + 1 for w, d in zip(window, (down, right), strict=True)]
    assume(attrs["padding"] == "SAME" or all(s <= n for s, n in zip(spans, image.shape[1:3], strict=True)))
    weights = np.random.default_rng(1).normal(size=(*window, 2, 3)).astype(np.float32)
    seen = np.nan_to_num(looked_at(image, attrs, window))
    expected = np.einsum("bhwijc,ijco->bhwo", seen, weights)
    np.testing.assert_allclose(kernel("Conv2D", image, weights, **attrs), expected, rtol=1e-6, atol=1e-6)
    expected = np.einsum("bhwijc,ijco->bhwco", seen, weights).reshape(*expected.shape[:3], 6)
    actual = kernel("DepthwiseConv2dNative", image, weights, **attrs)
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-6)


# ------------------------------------------------------------------ elementwise

reals = hnp.arrays(np.float32, st.integers(1, 8), elements=st.floats(-20, 20, width=32))
positive = hnp.arrays(np.float32, st.integers(1, 8), elements=st.floats(0.0009765625, 1024, width=32))

#: Written with Python's own functions, which are not numpy's.
SCALARS: Mapping[str, Callable[[float], float]] = {
    "Neg": lambda x: -x,
    "Abs": abs,
    "Square": lambda x: x * x,
    "Exp": math.exp,
    "Expm1": math.expm1,
    "Sin": math.sin,
    "Cos": math.cos,
    "Tan": math.tan,
    "Erf": math.erf,
    "Tanh": math.tanh,
    "Sigmoid": lambda x: 1 / (1 + math.exp(-x)),
    "Softplus": lambda x: max(x, 0) + math.log1p(math.exp(-abs(x))),
    "Softsign": lambda x: x / (1 + abs(x)),
    "Relu": lambda x: max(x, 0.0),
    "Relu6": lambda x: min(max(x, 0.0), 6.0),
    "Elu": lambda x: x if x > 0 else math.expm1(x),
    "Selu": lambda x: 1.0507009873554805 * (x if x > 0 else 1.6732632423543772 * math.expm1(x)),
    "LeakyRelu": lambda x: x if x > 0 else float(np.float32(0.2)) * x,
    "Floor": math.floor,
    "Ceil": math.ceil,
    "Round": round,
    "Sign": lambda x: math.copysign(1, x) if x else 0.0,
}
POSITIVE: Mapping[str, Callable[[float], float]] = {
    "Log": math.log,
    "Log1p": math.log1p,
    "Sqrt": math.sqrt,
    "Rsqrt": lambda x: 1 / math.sqrt(x),
    "Reciprocal": lambda x: 1 / x,
}
BINARY: Mapping[str, Callable[[float, float], float]] = {
    "Add": lambda a, b: a + b,
    "Sub": lambda a, b: a - b,
    "Mul": lambda a, b: a * b,
    "RealDiv": lambda a, b: a / b,
    "Pow": lambda a, b: a**b,
    "Maximum": max,
    "Minimum": min,
}


def rounded_once(values: Array, exact: Sequence[float]) -> None:
    """Each value is one of the two floats next to the exact one."""
    true = np.array(exact, np.float64)
    assert values.dtype == np.float32
    assert (np.abs(values - true) <= np.spacing(np.abs(true).astype(np.float32))).all(), (values, true)


@pytest.mark.parametrize("op", SCALARS)
@settings(examples, max_examples=40)
@given(x=reals)
def test_elementwise_rounds_once(op: str, x: Array) -> None:
    rounded_once(kernel(op, x), [SCALARS[op](float(v)) for v in x])


@pytest.mark.parametrize("op", POSITIVE)
@settings(examples, max_examples=40)
@given(x=positive)
def test_elementwise_of_positives_rounds_once(op: str, x: Array) -> None:
    rounded_once(kernel(op, x), [POSITIVE[op](float(v)) for v in x])


@pytest.mark.parametrize("op", BINARY)
@settings(examples, max_examples=40)
@given(a=positive, b=st.floats(0.0625, 3, width=32))
def test_binary_rounds_once(op: str, a: Array, b: float) -> None:
    rounded_once(kernel(op, a, np.float32(b)), [BINARY[op](float(v), b) for v in a])


@examples
@given(hnp.arrays(np.int32, 6, elements=st.integers(-50, 50)), st.integers(-9, 9).filter(bool))
def test_integers_divide_as_in_python(a: Array, b: int) -> None:
    divisor = np.array(b, np.int32)
    assert kernel("FloorDiv", a, divisor).tolist() == [int(v) // b for v in a]
    assert kernel("FloorMod", a, divisor).tolist() == [int(v) % b for v in a]


# ------------------------------------------------------------------ rows

rows = hnp.arrays(np.float32, st.tuples(st.integers(1, 3), st.integers(1, 6)), elements=st.floats(-200, 200, width=32))


@examples
@given(rows, st.floats(-50, 50, width=32))
def test_softmax_rows_are_distributions(x: Array, shift: float) -> None:
    p = kernel("Softmax", x)
    assert (p >= 0).all()
    np.testing.assert_allclose(p.sum(axis=-1, dtype=np.float64), 1, atol=1e-6)
    np.testing.assert_allclose(np.exp(kernel("LogSoftmax", x).astype(np.float64)), p, atol=1e-5)
    # as many bits as the sum keeps of x
    np.testing.assert_allclose(kernel("Softmax", x + np.float32(shift)), p, atol=1e-4)


@examples
@given(rows)
def test_arg_max_is_the_first_of_the_largest(x: Array) -> None:
    for op, best in (("ArgMax", max), ("ArgMin", min)):
        expected = [row.index(best(row)) for row in x.tolist()]
        assert kernel(op, x, np.array(1)).tolist() == expected
        assert kernel(op, x, np.array(-1), output_type=INT32).dtype == np.int32


@examples
@given(
    hnp.arrays(np.int32, hnp.array_shapes(max_dims=2, max_side=4), elements=st.integers(-3, 6)),
    st.integers(1, 4),
    st.integers(-1, 2),
)
def test_one_hot_is_on_at_the_index_alone(indices: Array, depth: int, axis: int) -> None:
    assume(axis <= indices.ndim)
    on, off = np.float32(2.5), np.float32(-1)
    hot = kernel("OneHot", indices, np.array(depth), on, off, axis=axis)
    assert hot.dtype == np.float32
    last = np.moveaxis(hot, axis, -1)
    assert last.shape == (*indices.shape, depth)
    for place, index in np.ndenumerate(indices):
        assert last[place].tolist() == [on if k == index else off for k in range(depth)]
    nodes = [placeholder("i", (None, *indices.shape[1:]), np.int32), const("d", depth)]
    nodes += [const("on", on, np.float32), const("off", off, np.float32)]
    graph = Graph((*nodes, Node("op", "OneHot", ("i", "d", "on", "off"), {"axis": axis})))
    assert fitting(graph, "op", {"i": indices}, len(indices)) == []


@examples
@given(hnp.arrays(np.float32, hnp.array_shapes(max_dims=3, max_side=6), elements=st.integers(-9, 9)), st.data())
def test_parts_join_to_the_whole(x: Array, data: st.DataObject) -> None:
    axis = data.draw(st.integers(-x.ndim, x.ndim - 1))
    cuts = sorted(data.draw(st.lists(st.integers(0, x.shape[axis]), max_size=3)))
    sizes = np.diff([0, *cuts, x.shape[axis]])
    function = TABLE["SplitV"].kernel
    assert function is not None
    where = np.array(axis)
    parts = function(Node("op", "SplitV"), x, sizes, where)
    assert [p.shape[axis] for p in parts] == sizes.tolist()
    np.testing.assert_array_equal(kernel("ConcatV2", *parts, where), x, strict=True)
    pieces = TABLE["Unpack"].kernel(Node("op", "Unpack", attrs={"axis": axis, "num": x.shape[axis]}), x)
    np.testing.assert_array_equal(kernel("Pack", *pieces, axis=axis), x, strict=True)
