"""What coverage is told not to trace, nothing traces (see tests/tracing.py); what it is to trace, it does."""

from __future__ import annotations

import sys
import threading

import pytest

from tests.tracing import Tracing


@pytest.mark.no_cover
def test_where_coverage_rests_nothing_traces() -> None:
    assert sys.gettrace() is None
    assert threading.gettrace() is None


def test_elsewhere_coverage_traces_and_by_one_tracer_alone(request: pytest.FixtureRequest) -> None:
    from coverage.collector import Collector

    plugins = request.config.pluginmanager
    assert plugins.hasplugin(Tracing.NAME)
    traced = plugins.hasplugin("_cov")
    assert len(Collector._collectors) == traced
    if traced and sys.version_info < (3, 12):  # later ones may tell coverage of lines by other means
        assert sys.gettrace() is not None
