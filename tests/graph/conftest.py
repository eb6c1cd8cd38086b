"""The runtimes' processes, started once per session."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from converters.runtimes.pool import RuntimePool
from tests.graph.harness import Runtimes


@pytest.fixture(scope="session")
def runtimes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Runtimes]:
    with RuntimePool() as pool:
        yield Runtimes(pool, tmp_path_factory.mktemp("models"))
