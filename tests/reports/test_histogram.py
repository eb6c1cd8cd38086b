"""Counts per decade."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from export_model.exporter.verify.difference import BINS, add_histograms, by_decade, compare, decades
from export_model.exporter.verify.tolerances import Tolerance


def test_decades_by_hand() -> None:
    counts = decades(np.array([[0.0, 0.0, 1e-20], [2e-7, 9e-7, 5e4]]))
    assert by_decade(counts) == {"0": 2, "1e-12": 1, "1e-7": 2, "1e3": 1}
    assert decades(np.array([])) == (0,) * BINS


@given(arrays.arrays(np.float64, st.integers(0, 50), elements=st.floats(0, 1e300)))
def test_every_element_is_counted_once_where_it_belongs(values: np.ndarray) -> None:
    counts = by_decade(decades(values))
    assert sum(counts.values()) == values.size
    for name, count in counts.items():
        low = 0.0 if name in ("0", "1e-12") else float(name)
        high = np.inf if name == "1e3" else 0.0 if name == "0" else 10 * float(name)
        inside = (
            values == 0 if name == "0" else (values > 0) & (values >= low * (1 - 1e-9)) & (values < high * (1 + 1e-9))
        )
        assert count <= int(inside.sum())


def test_sums() -> None:
    one = decades(np.array([1.0]))
    assert add_histograms([one, ()]) == add_histograms([(), one]) == one
    assert by_decade(add_histograms([one, one])) == {"1e0": 2}
    assert add_histograms([()]) == ()


def test_a_comparison_counts_its_elements_and_none_where_there_are_no_numbers() -> None:
    a, b = np.array([1, 2, np.nan], np.float32), np.array([1, 2.5, np.nan], np.float32)
    assert by_decade(compare(a, b, Tolerance()).histogram) == {"0": 2, "1e-1": 1}
    assert compare(a, b[:2], Tolerance()).histogram == ()
