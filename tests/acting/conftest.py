"""Fixtures as bundles, exported when they are first asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from export_model.exporter.export.pipeline import ExportOptions, export
from fixtures import path as fixture
from tests.acting.bundles import Bundles
from tests.acting.snippet_bundles import export_all


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Bundles:
    out = tmp_path_factory.mktemp("acting")

    def of(name: str) -> Path:
        if not (out / name).exists():
            list(export([fixture(name)], ExportOptions(out, verify="none")))
        return out / name

    return of


@pytest.fixture(scope="session")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All fixtures as bundles, one with labels, one with the trainer's own names."""
    return export_all(tmp_path_factory.mktemp("snippets"))
