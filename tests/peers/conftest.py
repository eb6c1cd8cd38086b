"""The peers' environment, and every fixture exported once."""

from __future__ import annotations

from pathlib import Path

import pytest

from exporter.export.pipeline import ExportOptions, ExportResult, export
from fixtures import FIXTURES, path
from tests.peers.environment import HOW, Peers, PeersUnavailableError, ensure_peers


@pytest.fixture(scope="session")
def peers() -> Peers:
    try:
        return ensure_peers()
    except PeersUnavailableError as error:
        pytest.skip(f"{error}; to {HOW}")


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ExportResult]:
    """Policy → its bundle; a fixture with two brains gives two."""
    sources: list[Path | str] = [path(name) for name in FIXTURES]
    out = tmp_path_factory.mktemp("bundles")
    return {r.policy.name: r for r in export(sources, ExportOptions(out, verify="none"))}
