"""Trained policies, exported once for what plays them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.play.play import play_policy
from export_model.exporter.play.report import PlayReport
from fixtures import trained
from tests.exporting import export_model
from tests.reports.validation import check_play

#: Few, where what is tried is found whatever the number.
FEW = 20


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All trained policies, in two formats."""
    folder = tmp_path_factory.mktemp("played")
    export_model(trained.FOLDER, folder, to="bytes,onnx", verify="none")
    return folder


Play = Callable[..., PlayReport]


@pytest.fixture
def play(processes: RuntimePool) -> Play:
    """``play_policy`` in the session's processes; what it reports fits the schema."""

    def run(*given: object, **named: object) -> PlayReport:
        import json

        report = play_policy(*given, **{"pool": processes, **named})  # type: ignore[arg-type]
        check_play(json.dumps(report.to_dict()))
        return report

    return run
