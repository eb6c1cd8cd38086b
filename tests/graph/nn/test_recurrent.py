"""Recurrent cells against their equations in float64."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from export_model.converters.graph.nn import recurrent as nn
from tests.graph.nn.layers import TOLERANCE, Array, examples, run

B, N, H = 3, 5, 4


def sigmoid(x: Array) -> Array:
    return np.asarray(1 / (1 + np.exp(-x)))


def normal(seed: int, *shape: int) -> Array:
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def wide(*arrays: Array) -> list[Array]:
    return [a.astype(np.float64) for a in arrays]


@given(order=st.permutations("ifgo"), seed=st.integers(0, 999), zeros=st.booleans(), biased=st.booleans())
@examples
def test_lstm(order: Sequence[str], seed: int, zeros: bool, biased: bool) -> None:
    x, h, c = normal(seed, B, N), normal(seed + 1, B, H), normal(seed + 2, B, H)
    w, r, bias = normal(seed + 3, N, 4 * H), normal(seed + 4, H, 4 * H), normal(seed + 5, 4 * H)
    x64, h64, c64, w64, r64, b64 = wide(x, h * (not zeros), c * (not zeros), w, r, bias * biased)
    gates = dict(zip(order, np.split(x64 @ w64 + h64 @ r64 + b64, 4, axis=1), strict=True))
    cell = sigmoid(gates["f"]) * c64 + sigmoid(gates["i"]) * np.tanh(gates["g"])
    hidden, state = run(
        lambda b, x, h, c: nn.lstm(
            b,
            b.add("MatMul", [x, b.const(w)]),
            None if zeros else h,
            None if zeros else c,
            b.const(r),
            bias if biased else None,
            "".join(order),
        ),
        x,
        h,
        c,
    )
    np.testing.assert_allclose(state, cell, **TOLERANCE)
    np.testing.assert_allclose(hidden, sigmoid(gates["o"]) * np.tanh(cell), **TOLERANCE)


@pytest.mark.parametrize("after", [False, True])
@given(seed=st.integers(0, 999), biased=st.booleans())
@examples
def test_gru(after: bool, seed: int, biased: bool) -> None:
    x, h = normal(seed, B, N), normal(seed + 1, B, H)
    w, r, bias = normal(seed + 2, 3, N, H), normal(seed + 3, 3, H, H), normal(seed + 4, 6, H)
    x64, h64, w64, r64, b64 = wide(x, h, w, r, bias * biased)
    z, reset = (sigmoid(x64 @ w64[i] + b64[i] + h64 @ r64[i] + b64[3 + i]) for i in range(2))
    inner = reset * (h64 @ r64[2] + b64[5]) if after else (reset * h64) @ r64[2] + b64[5]
    wanted = (1 - z) * np.tanh(x64 @ w64[2] + b64[2] + inner) + z * h64
    (made,) = run(
        lambda b, x, h: nn.gru(
            b,
            x,
            h,
            [b.const(k) for k in w],
            [b.const(k) for k in r],
            list(bias) if biased else None,
            linear_before_reset=after,
        ),
        x,
        h,
    )
    np.testing.assert_allclose(made, wanted, **TOLERANCE)


@given(seed=st.integers(0, 999), zeros=st.booleans())
@examples
def test_rnn(seed: int, zeros: bool) -> None:
    x, h = normal(seed, B, N), normal(seed + 1, B, H)
    w, r, bias = normal(seed + 2, N, H), normal(seed + 3, H, H), normal(seed + 4, H)
    x64, h64, w64, r64, b64 = wide(x, h * (not zeros), w, r, bias)
    (made,) = run(
        lambda b, x, h: nn.rnn(b, b.add("MatMul", [x, b.const(w)]), None if zeros else h, b.const(r), bias), x, h
    )
    np.testing.assert_allclose(made, np.tanh(x64 @ w64 + h64 @ r64 + b64), **TOLERANCE)
