"""Public and genuine ``.nn`` files of ../shared, and the runtimes that several tests share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

SHARED = Path(__file__).resolve().parents[3] / "shared"
#: Written by ML-Agents 0.10.1 under a TensorFlow whose AddV2 its converter did not know.
BROKEN = "0.10.1tf115-ppo-continuous"


def public_files() -> list[Path]:
    """The public ``.nn`` files, and the one that lies under the name .bytes."""
    return sorted(SHARED.glob("corpus/nn/*.nn")) + sorted(SHARED.glob("corpus/bytes/*3DBallLearning.bytes"))


def genuine_files() -> list[tuple[Path, Path, dict[str, Any]]]:
    """(.nn, the frozen graph beside it, case.json) of every genuine case that has both."""
    found = []
    for place in sorted(SHARED.glob("genuine/*/case.json")):
        case = json.loads(place.read_text())
        models = sorted(place.parent.glob("*.nn"))
        if models and case.get("frozen", {}).get("file"):
            found.append((models[0], place.parent / case["frozen"]["file"], case))
    return found


def params(items: list[Any], name: Any) -> list[Any]:
    """Pytest parameters with names; one that stands for their absence."""
    return [pytest.param(item, id=name(item)) for item in items] or [pytest.param(None, id="shared-is-absent")]


@pytest.fixture
def shared() -> Path:
    if not SHARED.is_dir():
        pytest.skip("../shared (public models, genuine graphs) is not beside this checkout")
    return SHARED
