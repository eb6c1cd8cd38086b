"""JSON Schemas (draft 2020-12) of the files that a bundle holds beside its formats."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal


def schema(name: Literal["parity", "policy"]) -> dict[str, Any]:
    """The schema of parity.json or policy.json."""
    path = Path(__file__).parent / f"{name}.schema.json"
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return content
