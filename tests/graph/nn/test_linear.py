"""Matrix products of any ranks against numpy's matmul."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from export_model.converters.graph.builder import Builder
from export_model.converters.graph.nn.linear import matmul
from tests.graph.nn.layers import Array, examples, floats, run_one


@st.composite
def factors(draw: st.DrawFn) -> tuple[Array, Array]:
    """Two tensors that numpy multiplies."""
    found = draw(hnp.mutually_broadcastable_shapes(signature="(m?,n),(n,p?)->(m?,p?)", max_dims=2, max_side=3))
    x, y = (draw(hnp.arrays(np.float32, shape, elements=floats(-4, 4))) for shape in found.input_shapes)
    return x, y


@given(pair=factors())
@examples
def test_vectors_matrices_and_batches(pair: tuple[Array, Array]) -> None:
    """The second factor is computed (a fed 1 times a constant), so its value is not known before the graph runs."""
    x, y = pair

    def layer(b: Builder, one: str) -> str:
        return b.add("Identity", [matmul(b, b.const(x), b.add("Mul", [one, b.const(y)]))])

    wanted = np.matmul(x.astype(np.float64), y.astype(np.float64))
    np.testing.assert_allclose(run_one(layer, np.array(1, np.float32)), wanted, atol=1e-4, rtol=1e-4)


@given(rows=st.integers(1, 4), columns=st.integers(1, 3), inner=st.integers(1, 3), middle=st.integers(0, 2))
@examples
def test_a_batch_by_a_matrix(rows: int, columns: int, inner: int, middle: int) -> None:
    rng = np.random.default_rng(rows)
    x = rng.normal(size=(rows, *(2,) * middle, inner)).astype(np.float32)
    y = rng.normal(size=(inner, columns)).astype(np.float32)
    made = run_one(lambda b, r: matmul(b, r, b.const(y)), x)
    np.testing.assert_allclose(made, x.astype(np.float64) @ y, atol=1e-4, rtol=1e-4)
