"""A trained policy to try everything with: 3DBall, as fixtures/trained made it (18.8 kB)."""

from __future__ import annotations

from pathlib import Path

#: The frozen graph that training left.
BALL = Path(__file__).resolve().parent / "3DBall.bytes"
