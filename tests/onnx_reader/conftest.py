"""Where models are run and written."""

from __future__ import annotations

import pytest

from export_model.converters.runtimes.pool import RuntimePool
from tests.onnx_reader.models import Bench


@pytest.fixture(scope="session")
def bench(processes: RuntimePool, tmp_path_factory: pytest.TempPathFactory) -> Bench:
    opened = Bench(processes, tmp_path_factory.mktemp("onnx"))
    opened.need("onnxruntime")
    return opened
