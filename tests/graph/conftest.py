"""Where models are run and written."""

from __future__ import annotations

import pytest

from export_model.converters.runtimes.pool import RuntimePool
from tests.graph.harness import Runtimes


@pytest.fixture(scope="session")
def runtimes(processes: RuntimePool, tmp_path_factory: pytest.TempPathFactory) -> Runtimes:
    return Runtimes(processes, tmp_path_factory.mktemp("models"))
