"""What several files of tests export with."""

from __future__ import annotations

from pathlib import Path

import pytest

from export_model.exporter.export.pipeline import ExportResult
from fixtures import path as fixture
from tests.exporter.rehearsal import ActingPool, Exporting, export


@pytest.fixture
def exporting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Exporting:
    """Export one policy with played runtimes."""

    def run(what: str | Path, pool: ActingPool | None = None, **options: object) -> ExportResult:
        source = what if isinstance(what, Path) else fixture(what)
        return export(monkeypatch, source, tmp_path / "out", pool or ActingPool(), **options)[0]

    return run
