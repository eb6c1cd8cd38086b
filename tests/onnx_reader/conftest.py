"""The runtimes' processes, started once per session."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from converters.runtimes.pool import RuntimePool
from tests.onnx_reader.models import Bench


@pytest.fixture(scope="session")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with RuntimePool() as pool:
        opened = Bench(pool, tmp_path_factory.mktemp("onnx"))
        opened.need("onnxruntime")
        yield opened
