"""An ONNX model as a source: which trainer wrote it, and how the model itself is run beside what is made of it."""

from __future__ import annotations

from pathlib import Path

from converters.detached import Detached
from converters.fetch import Fetched, read_bytes
from converters.onnx.proto import decoded
from converters.onnx.reader import read_onnx
from converters.onnx.writer import CONTRACT_KEY
from converters.source import OriginalRun, SourceModel
from converters.understand.onnx_trainers import understood


def read(given: Fetched) -> list[SourceModel]:
    """The one model in a file. Raises SourceError, GraphError and their kinds.

    The model itself is run by onnxruntime, the draws of its samplers fed from outside (``lift``).
    """
    model = read_onnx(given)
    graph, facts = understood(model)
    original = OriginalRun("onnxruntime", given.path, {"lift": list(model.draws)})
    producer = f"{model.producer}, opset {model.opset}" if model.producer else f"opset {model.opset}"
    return [SourceModel(graph, model.files, facts, original=original, producer=producer)]


def held(path: Path) -> str | None:
    """The contract that a model of ours embeds. Raises SourceError, DamagedFileError."""
    model = decoded(read_bytes(path), Detached())
    return next((str(p.value) for p in model.metadata_props if p.key == CONTRACT_KEY), None)
