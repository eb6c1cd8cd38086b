"""A Keras model (``.keras``, ``.h5``) as a source, frozen by TensorFlow where the caller trusts the file."""

from __future__ import annotations

from converters import schema
from converters.fetch import Fetched
from converters.frozen_graph.reader import from_graph_def
from converters.keras.config import config_of, refuse_code
from converters.keras.frozen import frozen_by_tensorflow
from converters.saved_model.signature import expose
from converters.source import OriginalRun, ReadOptions, SourceModel
from converters.understand.facts import SourceFacts
from signatures.errors import NotAPolicyError


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """What calling the model computes, with ``training=False``.

    Raises NotAPolicyError where the file is made of code, or is not trusted; SourceError, RuntimeUnavailableError.
    """
    path = given.path
    if not given.data.startswith(b"\x89HDF"):  # of an .h5, the child looks before Keras does
        refuse_code(config_of(path))
    if not options.trust_source:
        raise NotAPolicyError(
            "is a Keras model, which is not loaded unless you say that you trust it",
            why="only Keras can read it, and Keras builds the classes and functions that the file names",
            fix="--trust-source (trust_source=True), if you know where it comes from; or give a SavedModel of it "
            "(model.export('folder')), which is read without running anything",
        )
    data, signature = frozen_by_tensorflow(path)
    definition = schema.parse(schema.GraphDef, data, "TensorFlow graph")
    graph, roles = expose(from_graph_def(definition), signature)
    original = OriginalRun("tensorflow", path, definition=definition)
    return [SourceModel(graph, (path,), SourceFacts(roles=roles), None, original)]
