"""A few of the mutants of ``make fuzz``, the same in every run: each is converted or refused, in bounds."""

from __future__ import annotations

import sys
from random import Random

import pytest

from tests.fuzz.run import run
from tests.fuzz.seeds import READERS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory are Linux's"),
]
#: Of each reader.
COUNT = 20


@pytest.mark.parametrize("reader", READERS)
def test_every_seed_of_a_reader_can_be_changed(reader: str) -> None:
    """A seed that ends the tool is one whose reader was never tried."""
    change, random = READERS[reader].change, Random(reader)
    for seed in READERS[reader].seeds():
        assert all(change(seed, random) for _ in range(4))


def test_mutants_are_converted_or_refused() -> None:
    result = run(list(READERS), 0, COUNT * len(READERS))
    failures = [f for f in result.failures if f[1]["kind"] != "slow"]  # which on this machine is ``make fuzz``'s to say
    assert not failures, result.grouped()
    assert sum(result.counts.values()) == COUNT * len(READERS)
    assert min(result.counts["refused"], result.counts["ok"]) > COUNT
