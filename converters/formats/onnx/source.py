"""An ONNX model as a source: which trainer wrote it, and how the model itself is run beside what is made of it."""

from __future__ import annotations

from functools import partial

from msgspec.structs import replace

from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.onnx.reader import read_onnx
from export_model.converters.formats.onnx.trainers import understand
from export_model.converters.formats.onnx.vetted import safe_copy
from export_model.converters.formats.source import OriginalRun, ReadOptions, SourceModel


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The one model in a file. Raises SourceError, GraphError and their kinds.

    The model itself is run by onnxruntime, the draws of its samplers fed from outside (``lift``).
    """
    model = read_onnx(given, options.repair)
    graph, facts = understand(model)
    facts = replace(facts, notes=(*facts.notes, *model.faults))
    copied = len(model.files) > 1 or options.repair is not None
    copy = partial(safe_copy, given.path, [], repair=options.repair) if copied else None
    original = OriginalRun("onnxruntime", given.path, {"lift": list(model.draws)}, copy=copy)
    producer = f"{model.producer}, opset {model.opset}" if model.producer else f"opset {model.opset}"
    seeded = model.seeded
    return [SourceModel(graph, model.files, facts, original=original, producer=producer, seeded=seeded)]
