"""Processes of runner.mjs."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.runtimes.pipe import Runner


@pytest.fixture(scope="module", params=["tfjs-cpu", "tfjs-wasm"])
def shared(request: pytest.FixtureRequest) -> Iterator[Runner]:
    """One process per backend for all tests that leave it as they found it: a start costs half a second."""
    runner = Runner(request.param)
    yield runner
    status, _, err = runner.end()
    assert status == 0, err


@pytest.fixture
def runner(shared: Runner) -> Iterator[Runner]:
    """The shared process; whatever the test did and whatever failed in it, no tensor may be left."""
    before = shared.tensors_alive()
    yield shared
    shared.ask("unload", id="m")
    assert shared.tensors_alive() == before


@pytest.fixture
def own() -> Iterator[Runner]:
    """A process that the test may end."""
    runner = Runner()
    yield runner
    runner.process.kill()
    runner.process.communicate()
