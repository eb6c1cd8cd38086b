"""Convolutions, pools and borders of images against loops over pixels in float64."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn import pooling
from export_model.converters.graph.nn.convolution import Window, conv2d, conv2d_transposed
from export_model.converters.graph.nodes import NameScope, Node, TensorShape
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.errors import UnsupportedOpError
from tests.graph.nn.layers import TOLERANCE, Array, arrays, examples, run_one

H, W, C = 6, 5, 4
IMAGE = (2, H, W, C)
pair = st.tuples(st.integers(0, 2), st.integers(0, 2))
positive = st.tuples(st.integers(1, 3), st.integers(1, 3))


@st.composite
def windows(draw: st.DrawFn, *, dilated: bool) -> Window:
    """A window that fits the image, with any padding; SAME where it is drawn so."""
    dilations = draw(st.tuples(st.integers(1, 2), st.integers(1, 2))) if dilated else (1, 1)
    window = Window(draw(st.tuples(st.integers(1, 3), st.integers(1, 3))), draw(positive), dilations)
    same = draw(st.sampled_from(("", "SAME", "as numbers")))
    pads = window.same_pads((H, W)) if same else (draw(pair), draw(pair))
    return Window(window.size, window.strides, dilations, pads, same == "SAME")


def under(x: Array, window: Window) -> list[list[Array]]:
    """[B, height, width, C] under each place of the window, NaN where the image is not."""
    wide = np.pad(x.astype(np.float64), [(0, 0), *window.pads, (0, 0)], constant_values=np.nan)
    (sh, sw), (dh, dw), (kh, kw) = window.strides, window.dilations, window.size
    rows, columns = window.lengths((H, W))
    return [
        [wide[:, y * sh : y * sh + kh * dh : dh, c * sw : c * sw + kw * dw : dw][:, :kh, :kw] for c in range(columns)]
        for y in range(rows)
    ]


def stacked(places: list[list[Array]], reduce: Callable[[Array], Array]) -> Array:
    return np.stack([np.stack([reduce(p) for p in row], axis=1) for row in places], axis=1)


def kernel_of(seed: int, *shape: int) -> Array:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


@pytest.mark.parametrize("groups", [1, 2, 4])
@given(x=arrays(*IMAGE), window=windows(dilated=True), seed=st.integers(0, 99), twice=st.booleans())
@examples
def test_convolution(groups: int, x: Array, window: Window, seed: int, twice: bool) -> None:
    each, out = C // groups, groups * (1 + twice)
    kernel = kernel_of(seed, *window.size, each, out)

    def at(patch: Array) -> Array:
        parts = np.split(np.nan_to_num(patch), groups, axis=3)
        kernels = np.split(kernel.astype(np.float64), groups, axis=3)
        return np.concatenate([np.einsum("nijc,ijck->nk", p, k) for p, k in zip(parts, kernels, strict=True)], axis=1)

    made = run_one(lambda b, r: conv2d(b, r, kernel, window, groups), x)
    np.testing.assert_allclose(made, stacked(under(x, window), at), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("groups", [1, 2])
@given(
    x=arrays(2, 3, 4, C),
    size=positive,
    strides=positive,
    pads=st.tuples(pair, pair),
    extra=st.tuples(st.integers(0, 1), st.integers(0, 1)),
    seed=st.integers(0, 99),
)
@examples
def test_transposed_convolution(
    groups: int,
    x: Array,
    size: tuple[int, int],
    strides: tuple[int, int],
    pads: tuple[tuple[int, int], tuple[int, int]],
    extra: tuple[int, int],
    seed: int,
) -> None:
    """Every pixel paints the kernel, times its value, onto a canvas; then the pads are cut off."""
    kernel = kernel_of(seed, *size, C, 3)
    lengths = [
        (n - 1) * s + k - sum(p) + e for n, s, k, p, e in zip(x.shape[1:3], strides, size, pads, extra, strict=True)
    ]
    if min(lengths) < 1:
        return
    n, h, w, _ = x.shape
    canvas = np.zeros((n, h * strides[0] + 9, w * strides[1] + 9, 3 * groups))
    for y, column, g in itertools.product(range(h), range(w), range(groups)):
        chosen = slice(g * C // groups, (g + 1) * C // groups)
        top, left = y * strides[0], column * strides[1]
        canvas[:, top : top + size[0], left : left + size[1], g * 3 : g * 3 + 3] += np.einsum(
            "nc,ijck->nijk", x[:, y, column, chosen].astype(np.float64), kernel[:, :, chosen].astype(np.float64)
        )
    top, left = pads[0][0], pads[1][0]
    wanted = canvas[:, top : top + lengths[0], left : left + lengths[1]]
    window = Window(size, strides, pads=pads)
    made = run_one(lambda b, r: conv2d_transposed(b, r, kernel, window, extra, groups), x)
    np.testing.assert_allclose(made, wanted, atol=1e-4, rtol=1e-4)


@given(x=arrays(*IMAGE), window=windows(dilated=False))
@examples
def test_pools_leave_out_what_is_padded(x: Array, window: Window) -> None:
    places = under(x, window)
    if any(np.isnan(p).all() for row in places for p in row):
        return  # a window that sees nothing of the image
    largest = run_one(lambda b, r: pooling.max_pool(b, r, window), x)
    np.testing.assert_array_equal(largest, stacked(places, lambda p: np.nanmax(p, axis=(1, 2))))
    mean = run_one(lambda b, r: pooling.average_pool(b, r, window), x)
    np.testing.assert_allclose(mean, stacked(places, lambda p: np.nanmean(p, axis=(1, 2))), **TOLERANCE)


@given(x=arrays(*IMAGE), window=windows(dilated=False))
@examples
def test_padding_that_counts(x: Array, window: Window) -> None:
    wanted = stacked(under(x, window), lambda p: np.nan_to_num(p).mean(axis=(1, 2)))
    counted = Window(window.size, window.strides, pads=window.pads)
    made = run_one(lambda b, r: pooling.average_pool(b, r, counted, window.pads), x)
    np.testing.assert_allclose(made, wanted, **TOLERANCE)


def refusal(layer: Callable[[Builder, str], str]) -> str:
    b = Builder(NameScope(()))
    x = b.append(Node("x", "Placeholder", attrs={"dtype": FLOAT32, "shape": TensorShape((None, H, W, C))}))
    with pytest.raises(UnsupportedOpError) as caught:
        layer(b, x)
    assert not caught.value.issues  # the reader names the node
    return caught.value.what


def test_what_is_not_written() -> None:
    kernel = np.zeros((1, 1, 2, 3), np.float32)
    assert "2 groups for 3 channels" in refusal(lambda b, x: conv2d(b, x, kernel, Window((1, 1)), 2))
    assert "3 groups" in refusal(lambda b, x: conv2d_transposed(b, x, kernel, Window((1, 1)), groups=3))


# ------------------------------------------------------------------ borders


@given(
    x=arrays(2, 4, 5),
    pairs=st.tuples(st.just((0, 0)), *[st.tuples(st.integers(-1, 2), st.integers(-1, 2))] * 2),
    fill=st.none() | st.floats(-3, 3, width=32),
)
@examples
def test_borders_are_added_and_cut_off(x: Array, pairs: tuple[tuple[int, int], ...], fill: float | None) -> None:
    cut = x[tuple(slice(max(-a, 0), n - max(-z, 0)) for (a, z), n in zip(pairs, x.shape, strict=True))]
    wanted = np.pad(cut, [(max(a, 0), max(z, 0)) for a, z in pairs], constant_values=np.float32(fill or 0))
    made = run_one(lambda b, r: b.add("Identity", [b.pad(r, pairs, fill)]), x)
    np.testing.assert_array_equal(made, wanted)


@given(x=arrays(2, 4, 5), index=st.lists(st.integers(0, 3), min_size=1, max_size=6))
@examples
def test_elements_of_an_axis(x: Array, index: list[int]) -> None:
    np.testing.assert_array_equal(run_one(lambda b, r: b.take(r, index, 1), x), x[:, index])
