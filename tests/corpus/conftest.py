"""Public models and genuine graphs of ../shared: found here, skipped with the reason where they are not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

SHARED = Path(__file__).resolve().parents[3] / "shared"


def frozen_corpus() -> list[Path]:
    """The frozen graphs of the public models (one of the .bytes is a .nn)."""
    found = sorted(SHARED.glob("corpus/bytes/*.bytes")) + sorted(SHARED.glob("corpus/pb_frozen/*.pb"))
    return [p for p in found if "3DBallLearning" not in p.name]


def genuine_cases() -> list[tuple[Path, dict[str, Any]]]:
    """(folder, case.json) of every genuine case that has a frozen graph."""
    cases = [(p.parent, json.loads(p.read_text())) for p in sorted(SHARED.glob("genuine/*/case.json"))]
    return [(folder, case) for folder, case in cases if case.get("frozen", {}).get("file")]


@pytest.fixture(autouse=True)
def _shared_data() -> None:
    if not SHARED.is_dir():
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")
