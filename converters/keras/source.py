"""A Keras model (``.keras``, ``.h5``) as a source, frozen by TensorFlow."""

from __future__ import annotations

from converters.fetch import Fetched
from converters.frozen_graph.reader import read_graph
from converters.saved_model.functions import frozen_by_tensorflow
from converters.saved_model.signature import expose
from converters.source import OriginalRun, SourceModel
from converters.understand.facts import SourceFacts


def read(given: Fetched) -> list[SourceModel]:
    """What calling the model computes, with ``training=False``."""
    data, signature = frozen_by_tensorflow(given.path, "keras")
    graph, roles = expose(read_graph(data), signature)
    original = OriginalRun("tensorflow", given.path, {"kind": "function", "form": "keras"})
    return [SourceModel(graph, (given.path,), SourceFacts(roles=roles), None, original)]
