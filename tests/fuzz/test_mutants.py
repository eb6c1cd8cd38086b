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
#: Of each reader.
COUNT = 20


def test_mutants_are_converted_or_refused() -> None:
    result = run(list(READERS), 0, COUNT * len(READERS))
    failures = [f for f in result.failures if f[1]["kind"] != "slow"]  # which on this machine is ``make fuzz``'s to say
    assert not failures, result.grouped()
    assert sum(result.counts.values()) == COUNT * len(READERS)
    assert min(result.counts["refused"], result.counts["ok"]) > COUNT
