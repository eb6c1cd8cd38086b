"""Chromium, started once per session for each runtime, and what these tests need to be there."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from export_model.converters.files.children.process import RuntimeProcess
from export_model.converters.runtimes.pool import RuntimePool
from export_model.converters.runtimes.registry import available_runtimes

TFJS = ("tfjs-cpu@chromium", "tfjs-wasm@chromium", "tfjs-webgl")
ONNX = ("onnxruntime-web@chromium",)
BROWSERS = (*TFJS, *ONNX)


@pytest.fixture(scope="session")
def chromium_is_here() -> None:
    """Skips, with how to install it, where one of BROWSERS cannot be started."""
    missing = [i for i in available_runtimes() if i.name in BROWSERS and not i.installed]
    if missing:
        pytest.skip(f"{missing[0].name} is not installed: {missing[0].how}")


@pytest.fixture(scope="session")
def browsers(chromium_is_here: None) -> Iterator[RuntimePool]:
    """A pool with all four, which start side by side."""
    with RuntimePool() as opened:
        opened.start(BROWSERS)
        yield opened


@pytest.fixture(params=TFJS)
def tfjs(request: pytest.FixtureRequest, browsers: RuntimePool) -> RuntimeProcess:
    return browsers.process(request.param)


@pytest.fixture
def onnx_web(browsers: RuntimePool) -> RuntimeProcess:
    return browsers.process(ONNX[0])


@pytest.fixture(params=BROWSERS)
def browser(request: pytest.FixtureRequest, browsers: RuntimePool) -> RuntimeProcess:
    return browsers.process(request.param)
