"""Every test ends, and none fails because the machine is busy."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st


def test_every_test_has_a_limit(pytestconfig: pytest.Config, request: pytest.FixtureRequest) -> None:
    assert pytestconfig.pluginmanager.hasplugin("timeout")
    assert 0 < float(pytestconfig.getini("timeout")) <= 1800
    assert settings.default is not None
    assert settings.default.deadline is None


@pytest.mark.xdist_group("limits")
def test_tests_of_a_group_run_in_one_worker(pytestconfig: pytest.Config, request: pytest.FixtureRequest) -> None:
    """Else each worker makes what they share; pytest-xdist finds the group at the end of the name."""
    if not pytestconfig.getoption("loadgroup", False):
        pytest.skip("not spread by groups")
    assert request.node.nodeid.endswith("@limits")


@given(st.just(0))
def test_an_example_has_none(nothing: int) -> None:
    assert settings().deadline is None
