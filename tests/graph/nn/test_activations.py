"""Each activation against its formula in float64."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.graph.nn import activations as nn
from export_model.converters.graph.nn import trigonometry
from tests.graph.nn.layers import TOLERANCE, Array, examples, floats, run_one, tensors

_erf = np.vectorize(math.erf, otypes=[float])


def _sigmoid(x: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-x)))


#: layer → what it computes, on float64
PLAIN: dict[Callable[..., str], Callable[[Array], Array]] = {
    nn.swish: lambda x: x * _sigmoid(x),
    nn.hard_swish: lambda x: x * np.clip(x / 6 + 0.5, 0, 1),
    nn.mish: lambda x: x * np.tanh(np.log1p(np.exp(x))),
    nn.gelu: lambda x: x * (1 + _erf(x / math.sqrt(2))) / 2,
    nn.elu: lambda x: np.where(x < 0, np.expm1(x), x),
    nn.selu: lambda x: 1.0507009873554805 * np.where(x < 0, 1.6732632423543772 * np.expm1(x), x),
    trigonometry.sinh: np.sinh,
    trigonometry.cosh: np.cosh,
    trigonometry.asinh: np.arcsinh,
    trigonometry.atan: np.arctan,
}
#: The parameter is above 0: celu divides by it.
WITH_ALPHA: dict[Callable[..., str], Callable[[Array, float], Array]] = {
    nn.leaky_relu: lambda x, a: np.where(x < 0, a * x, x),
    nn.thresholded_relu: lambda x, a: np.where(x > a, x, 0),
    nn.elu: lambda x, a: np.where(x < 0, a * np.expm1(x), x),
    nn.celu: lambda x, a: np.where(x < 0, a * np.expm1(x / a), x),
    nn.swish: lambda x, a: x * _sigmoid(a * x),
}
NARROW: dict[Callable[..., str], Callable[[Array], Array]] = {
    trigonometry.asin: np.arcsin,
    trigonometry.acos: np.arccos,
    trigonometry.atanh: np.arctanh,
}


@pytest.mark.parametrize("layer", PLAIN, ids=lambda f: f.__name__)
@given(x=tensors())
@examples
def test_without_parameters(layer: Callable[..., str], x: Array) -> None:
    np.testing.assert_allclose(run_one(layer, x), PLAIN[layer](x.astype(np.float64)), **TOLERANCE)


@pytest.mark.parametrize("layer", WITH_ALPHA, ids=lambda f: f.__name__)
@given(x=tensors(), alpha=floats(0.0625, 3))
@examples
def test_with_a_slope_on_both_sides_of_one(layer: Callable[..., str], x: Array, alpha: float) -> None:
    wanted = WITH_ALPHA[layer](x.astype(np.float64), alpha)
    np.testing.assert_allclose(run_one(lambda b, r: layer(b, r, alpha), x), wanted, **TOLERANCE)


@pytest.mark.parametrize("layer", NARROW, ids=lambda f: f.__name__)
@given(x=tensors(-0.9375, 0.9375))
@examples
def test_between_minus_one_and_one(layer: Callable[..., str], x: Array) -> None:
    np.testing.assert_allclose(run_one(layer, x), NARROW[layer](x.astype(np.float64)), **TOLERANCE)


@given(x=tensors(1.0625, 100))
@examples
def test_acosh_above_one(x: Array) -> None:
    np.testing.assert_allclose(run_one(trigonometry.acosh, x), np.arccosh(x.astype(np.float64)), **TOLERANCE)


@given(x=tensors(-(2.0**100), 2.0**100))
@examples
def test_the_arc_tangent_of_anything(x: Array) -> None:
    np.testing.assert_allclose(run_one(trigonometry.atan, x), np.arctan(x.astype(np.float64)), **TOLERANCE)


def test_the_ends_of_the_arcs() -> None:
    edge = np.array([-1.0, 1.0, 2.0], np.float32)
    for layer, wanted in ((trigonometry.asin, np.arcsin), (trigonometry.acos, np.arccos)):
        with np.errstate(invalid="ignore"):
            np.testing.assert_allclose(run_one(layer, edge), wanted(edge.astype(np.float64)), **TOLERANCE)


@given(x=tensors(), low=st.none() | floats(-5, 5), high=st.none() | floats(-5, 5))
@examples
def test_clip_takes_the_low_bound_where_they_cross(x: Array, low: float | None, high: float | None) -> None:
    wanted = x if high is None else np.minimum(x, np.float32(high))
    wanted = wanted if low is None else np.maximum(wanted, np.float32(low))
    layer = lambda b, r: b.add("Identity", [nn.clip(b, r, low, high)])  # noqa: E731
    np.testing.assert_array_equal(run_one(layer, x), wanted)


@given(x=tensors(min_dims=2), slope=floats(-3, 3))
@examples
def test_prelu_with_a_slope_per_column(x: Array, slope: float) -> None:
    slopes = (np.arange(x.shape[-1]) + slope).astype(np.float32)
    wanted = np.maximum(x, 0) + slopes * np.minimum(x, 0)
    np.testing.assert_allclose(run_one(lambda b, r: nn.prelu(b, r, b.const(slopes)), x), wanted, **TOLERANCE)


@given(x=tensors(), alpha=floats(-2, 2), beta=floats(-2, 2))
@examples
def test_hard_sigmoid_and_scaled(x: Array, alpha: float, beta: float) -> None:
    line = np.float64(alpha) * x + beta
    np.testing.assert_allclose(
        run_one(lambda b, r: nn.hard_sigmoid(b, r, alpha, beta), x), np.clip(line, 0, 1), **TOLERANCE
    )
    np.testing.assert_allclose(
        run_one(lambda b, r: b.add("Identity", [nn.scale_and_shift(b, r, alpha, beta)]), x), line, **TOLERANCE
    )


@given(x=tensors(), alpha=floats(0.25, 3), gamma=floats(-2, 2))
@examples
def test_selu_with_constants_of_its_own(x: Array, alpha: float, gamma: float) -> None:
    wanted = gamma * np.where(x < 0, alpha * np.expm1(x.astype(np.float64)), x)
    np.testing.assert_allclose(run_one(lambda b, r: nn.selu(b, r, alpha, gamma), x), wanted, **TOLERANCE)


@given(x=tensors())
@examples
def test_gelu_by_its_approximation(x: Array) -> None:
    wide = x.astype(np.float64)
    wanted = wide / 2 * (1 + np.tanh(math.sqrt(2 / math.pi) * (wide + 0.044715 * wide**3)))
    np.testing.assert_allclose(run_one(lambda b, r: nn.gelu(b, r, tanh=True), x), wanted, **TOLERANCE)
