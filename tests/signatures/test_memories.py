"""A memory in the parts that a source has of it: one row is cut by another way than several, into the same."""

from __future__ import annotations

import numpy as np
import pytest

from export_model.signatures.memories import SourcePart, join_memory, split_memory


@pytest.mark.parametrize(
    "shapes", [[(1, None, 4), (1, None, 4)], [(None, 3), (None, 5)], [(None, 1, 2), (2, None)], [(2, 3, None)]]
)
def test_rows_are_split_alone_as_together(shapes: list[tuple[int | None, ...]]) -> None:
    parts = [SourcePart(f"part{number}", shape) for number, shape in enumerate(shapes)]
    memory = np.random.default_rng(0).standard_normal((6, sum(p.size for p in parts)), np.float32)
    together = split_memory(parts, memory)
    alone = [split_memory(parts, memory[row : row + 1]) for row in range(6)]
    for part in parts:
        for fed in alone:
            assert fed[part.tensor].shape == tuple(1 if d is None else d for d in part.shape)
            assert fed[part.tensor].flags.c_contiguous
        joined = np.concatenate([fed[part.tensor] for fed in alone], axis=part.axis)
        np.testing.assert_array_equal(joined, together[part.tensor])
    np.testing.assert_array_equal(join_memory(parts, together), memory)
    np.testing.assert_array_equal(np.concatenate([join_memory(parts, fed) for fed in alone]), memory)
