"""The runtimes' processes, started once per session."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

from exporter.parity.pool import RuntimePool
from exporter.runtimes import available_runtimes

NEEDED = ("tensorflow", "onnxruntime", "tfjs-cpu", "tfjs-wasm")


@pytest.fixture(scope="session")
def _pool() -> Iterator[RuntimePool]:
    missing = [i for i in available_runtimes() if i.name in NEEDED and not i.installed]
    if missing:
        pytest.skip(f"{missing[0].name} is not installed: {missing[0].how}")
    with RuntimePool() as opened:
        yield opened


@pytest.fixture
def runtimes(_pool: RuntimePool, monkeypatch: pytest.MonkeyPatch) -> RuntimePool:
    """All real runtimes; every command that this test runs shares their processes."""
    monkeypatch.setattr("exporter.pipeline.RuntimePool", lambda: contextlib.nullcontext(_pool))
    return _pool
