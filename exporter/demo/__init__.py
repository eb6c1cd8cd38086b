"""Policies to try everything with.

3DBall, Hallway (it has an LSTM), GridWorld and Tennis are the frozen graphs that training left in fixtures/trained;
3DBall.pt and the ONNX of others are of fixtures/torch_checkpoint and fixtures/sb3.
"""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).resolve().parent
BALL = FOLDER / "3DBall.bytes"
