"""A few of the mutants of ``make fuzz``, the same in every run: each is converted or refused, in bounds."""

from __future__ import annotations

import sys

import pytest

from tests.fuzz.run import run
from tests.fuzz.seeds import READERS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory are Linux's"),
]


@pytest.mark.parametrize("reader", READERS)
def test_mutants_are_converted_or_refused(reader: str) -> None:
    result = run(reader, 1_000_000, 25)
    assert not result.failures, result.grouped()
    assert sum(result.counts.values()) == 25
    assert result.counts["refused"] > 0
