"""Trained policies to try everything with, as fixtures/trained made them: 3DBall (18.8 kB), Hallway (33.2 kB)."""

from __future__ import annotations

from pathlib import Path

#: The frozen graphs that training left. Hallway has an LSTM.
BALL = Path(__file__).resolve().parent / "3DBall.bytes"
HALLWAY = BALL.with_name("Hallway.bytes")
