"""A Keras model (``.keras``, ``.h5``) as a source, frozen by TensorFlow."""

from __future__ import annotations

from pathlib import Path

from converters.frozen_graph.reader import read_graph
from converters.saved_model.functions import frozen_by_tensorflow
from converters.saved_model.signature import expose
from converters.source import OriginalRun, ReadOptions, SourceModel
from converters.understand.facts import SourceFacts


def read(path: Path, options: ReadOptions) -> list[SourceModel]:
    """What calling the model computes, with ``training=False``."""
    data, signature = frozen_by_tensorflow(path, "keras")
    graph, roles = expose(read_graph(data), signature)
    original = OriginalRun("tensorflow", path, {"kind": "function", "form": "keras"})
    return [SourceModel(graph, (path,), SourceFacts(roles=roles), None, original)]
