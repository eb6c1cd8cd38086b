"""No contract makes a command fail but by a refusal, or write, or act on a terminal (contracts.py)."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from export_model.converters.runtimes.pool import RuntimePool
from tests.hostile.contracts import BEYOND, POLICIES, Trial, changes


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory, processes: RuntimePool) -> Trial:
    return Trial(tmp_path_factory.mktemp("contracts"), processes)


@settings(
    max_examples=60, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
@given(st.integers(0, len(POLICIES) - 1), changes, st.sampled_from(BEYOND))
def test_a_hostile_contract_is_refused_or_harmless(
    trial: Trial, which: int, how: list[tuple[int, str, Any]], beyond: str | None
) -> None:
    trial.run(which, how, beyond)
