"""Commands that this process runs share the processes of the runtimes."""

from __future__ import annotations

import contextlib

import pytest

from converters.runtimes.pool import RuntimePool


@pytest.fixture
def runtimes(pool: RuntimePool, monkeypatch: pytest.MonkeyPatch) -> RuntimePool:
    """All real runtimes; every command that this test runs shares their processes."""
    for module in ("pipeline", "again"):
        monkeypatch.setattr(f"exporter.export.{module}.RuntimePool", lambda: contextlib.nullcontext(pool))
    return pool
