"""What was recorded with Unity's own code (../shared/unity), found here, and absent where it is not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

SHARED = Path(__file__).resolve().parents[3] / "shared"
UNITY = SHARED / "unity"
ABSENT = "../shared/unity (what Unity's own code said to these files) is not beside this checkout"


def lines(name: str) -> list[dict[str, Any]]:
    """The rows of a .jsonl below ../shared/unity; none where it is not there."""
    path = UNITY / name
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []


def document(name: str) -> list[dict[str, Any]]:
    """The rows of a .json below ../shared/unity; where it is not there an empty one, whose test says why it skips."""
    path = UNITY / name
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.is_file() else [{}]
    return rows


@pytest.fixture
def unity_data() -> Path:
    if not UNITY.is_dir():
        pytest.skip(ABSENT)
    return UNITY
