"""Normalisations and reductions against numpy in float64."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.graph.nn import normalisation, reduction
from tests.graph.nn.layers import TOLERANCE, Array, arrays, examples, run, run_one

EPSILON = 1e-2
LOOSE = {"atol": 1e-4, "rtol": 1e-4}


def standard(x: Array, axes: tuple[int, ...]) -> Array:
    wide = x.astype(np.float64)
    return np.asarray((wide - wide.mean(axes, keepdims=True)) / np.sqrt(wide.var(axes, keepdims=True) + EPSILON))


def per(values: Array, axis: int, rank: int) -> Array:
    """[C] along one axis of a tensor."""
    return values.reshape([-1 if i == axis else 1 for i in range(rank)])


@pytest.mark.parametrize("shape", [(3, 4), (2, 4, 3), (2, 4, 3, 2)])
@given(data=st.data())
@examples
def test_batch(shape: tuple[int, ...], data: st.DataObject) -> None:
    x, scale, bias, mean = (data.draw(arrays(*s)) for s in (shape, (4,), (4,), (4,)))
    variance = data.draw(arrays(4, low=0.5))
    s, o, m, v = (per(a.astype(np.float64), 1, len(shape)) for a in (scale, bias, mean, variance))
    made = run_one(lambda b, r: normalisation.batch(b, r, scale, bias, mean, variance, EPSILON), x)
    np.testing.assert_allclose(made, (x - m) / np.sqrt(v + EPSILON) * s + o, **LOOSE)


@pytest.mark.parametrize("channels", [1, 3])
@given(x=arrays(2, 4, 3, 4), scale=arrays(4), bias=arrays(4))
@examples
def test_instance_with_channels_first_or_last(channels: int, x: Array, scale: Array, bias: Array) -> None:
    axes = tuple(i for i in (1, 2, 3) if i != channels)
    wanted = standard(x, axes) * per(scale, channels, 4) + per(bias, channels, 4)
    made = run_one(
        lambda b, r: normalisation.instance(b, r, b.const(scale), b.const(bias), EPSILON, channels=channels), x
    )
    np.testing.assert_allclose(made, wanted, **LOOSE)


@pytest.mark.parametrize("axis", [1, 2])
@given(x=arrays(3, 4, 5), bias=st.none() | arrays(5))
@examples
def test_layer(axis: int, x: Array, bias: Array | None) -> None:
    scale = np.linspace(0.5, 2, 5, dtype=np.float32)
    made, mean, inverse = run(
        lambda b, r: normalisation.layer(b, r, axis, b.const(scale), None if bias is None else b.const(bias), EPSILON),
        x,
    )
    axes, wide = tuple(range(axis, 3)), x.astype(np.float64)
    np.testing.assert_allclose(made, standard(x, axes) * scale + (0 if bias is None else bias), **LOOSE)
    np.testing.assert_allclose(mean, wide.mean(axes, keepdims=True), **TOLERANCE)
    np.testing.assert_allclose(inverse, 1 / np.sqrt(wide.var(axes, keepdims=True) + EPSILON), **LOOSE)


@given(x=arrays(3, 4, 5))
@examples
def test_rms_and_unit_length(x: Array) -> None:
    wide = x.astype(np.float64)
    scale = np.linspace(0.5, 2, 5, dtype=np.float32)
    wanted = wide / np.sqrt((wide**2).mean(2, keepdims=True) + EPSILON) * scale
    np.testing.assert_allclose(
        run_one(lambda b, r: normalisation.rms(b, r, 2, b.const(scale), EPSILON), x), wanted, **LOOSE
    )
    shifted = np.abs(x) + 1
    for power in (1, 2):
        made = run_one(lambda b, r, p=power: normalisation.unit_length(b, r, 1, p), shifted)
        norm = np.linalg.norm(shifted.astype(np.float64), power, axis=1, keepdims=True)
        np.testing.assert_allclose(made, shifted / norm, **TOLERANCE)


@pytest.mark.parametrize("per_group", [True, False])
@given(x=arrays(2, 4, 3, 2), data=st.data())
@examples
def test_group(per_group: bool, x: Array, data: st.DataObject) -> None:
    scale, bias = (data.draw(arrays(2 if per_group else 4)) for _ in range(2))
    value = standard(x.reshape(2, 2, -1), (2,)).reshape(x.shape)
    s, o = (per(np.repeat(a, 2) if per_group else a, 1, 4) for a in (scale, bias))
    made = run_one(lambda b, r: normalisation.group(b, r, 2, b.const(scale), b.const(bias), EPSILON), x)
    np.testing.assert_allclose(made, value * s + o, **LOOSE)


# ------------------------------------------------------------------ reductions

REDUCTIONS: dict[str, tuple[reduction.Reduction, Callable[[Array, tuple[int, ...]], Array]]] = {
    **{
        kind: (reduction.of_kind(kind), function)
        for kind, function in (
            ("Sum", lambda x, a: x.sum(a, keepdims=True)),
            ("Mean", lambda x, a: x.mean(a, keepdims=True)),
            ("Max", lambda x, a: x.max(a, keepdims=True)),
            ("Min", lambda x, a: x.min(a, keepdims=True)),
            ("Prod", lambda x, a: x.prod(a, keepdims=True)),
        )
    },
    "l1": (reduction.l1, lambda x, a: abs(x).sum(a, keepdims=True)),
    "l2": (reduction.l2, lambda x, a: np.sqrt((x * x).sum(a, keepdims=True))),
    "sum_square": (reduction.sum_square, lambda x, a: (x * x).sum(a, keepdims=True)),
    "log_sum": (reduction.log_sum, lambda x, a: np.log(x.sum(a, keepdims=True))),
    "log_sum_exp": (reduction.log_sum_exp, lambda x, a: np.log(np.exp(x).sum(a, keepdims=True))),
}


@pytest.mark.parametrize("name", REDUCTIONS)
@given(x=arrays(3, 2, 4, low=0.125, high=8), axes=st.sets(st.integers(1, 2), min_size=1), keep=st.booleans())
@examples
def test_reductions(name: str, x: Array, axes: set[int], keep: bool) -> None:
    layer, function = REDUCTIONS[name]
    along = tuple(sorted(axes))
    wanted = function(x.astype(np.float64), along)
    made = run_one(lambda b, r: layer(b, r, list(along), keep), x)
    np.testing.assert_allclose(made, wanted if keep else wanted.squeeze(along), **LOOSE)


@pytest.mark.parametrize("kind", ["Sum", "Mean", "Max", "Min", "Prod"])
def test_no_axis_is_no_reduction(kind: str) -> None:
    x = np.ones((2, 3), np.float32)
    layer = reduction.of_kind(kind)
    np.testing.assert_array_equal(run_one(lambda b, r: b.add("Identity", [layer(b, r, [], True)]), x), x)


def test_log_sum_exp_at_the_ends_of_float32() -> None:
    """The largest is taken out first; rows of −∞ give −∞ and not NaN (Barracuda's reader once subtracted ∞ from ∞)."""
    x = np.array([[-np.inf, -np.inf], [1000, 999], [-1000, -np.inf]], np.float32)
    made = run_one(lambda b, r: reduction.log_sum_exp(b, r, [1], False), x)
    np.testing.assert_allclose(made, [-np.inf, 1000 + np.log1p(np.exp(-1.0)), -1000], **TOLERANCE)


@pytest.mark.parametrize("shape", [(3, 4), (2, 3, 4), (2, 2, 3, 4)])
@given(data=st.data())
@examples
def test_softmax_and_kin_over_the_last_axis(shape: tuple[int, ...], data: st.DataObject) -> None:
    x = data.draw(arrays(*shape))
    wide = np.exp(x.astype(np.float64))
    share = wide / wide.sum(-1, keepdims=True)
    for op, wanted in (("Softmax", share), ("LogSoftmax", np.log(share))):
        made = run_one(lambda b, r, op=op: reduction.over_last_axis(b, op, r), x)
        np.testing.assert_allclose(made, wanted, **TOLERANCE)
    first = np.arange(4) == x.argmax(-1)[..., None]
    np.testing.assert_array_equal(run_one(reduction.hardmax, x), first.astype(np.float32))
