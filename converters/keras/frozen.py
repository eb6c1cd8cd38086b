"""Keras models, which only TensorFlow can read: it freezes them in a child process.

Keras builds what a file names, so loading one runs what it says. It is read where the caller trusts it, and then, too,
only if it is made of Keras' own layers (converters/keras/config.py); the child has no network and cannot write.
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

from converters.runtimes.process import RunFailedError, RuntimeProcess
from converters.runtimes.python import child_command
from converters.saved_model.signature import ModelSignature, signature_of
from signatures.errors import RuntimeUnavailableError, SourceError

_CHILD = "converters.runtimes.tensorflow.freeze_child"


def frozen_by_tensorflow(path: Path) -> tuple[bytes, ModelSignature]:
    """(the GraphDef's bytes, its signature) of calling the model with ``training=False``.

    Raises RuntimeUnavailableError where TensorFlow is not installed, SourceError with its message where it refuses.
    """
    if importlib.util.find_spec("tensorflow") is None:
        raise RuntimeUnavailableError(
            "is a Keras model of more than plain layers, which can only be read with TensorFlow",
            why="its layers are turned into a graph by TensorFlow itself, and it is not installed",
            fix="pip install 'export-model[tensorflow]'; or freeze the model where it was made, and give the GraphDef",
        )
    try:
        with RuntimeProcess("tensorflow", child_command(_CHILD)) as process:
            answer = process.load(str(path.resolve())).run({}, ["graph", "names"])
    except RunFailedError as error:
        raise SourceError(
            "is a Keras model that TensorFlow cannot load",
            why=(error.why or error.what)[:600],
            fix="load it where it was made, and save it as a SavedModel with a signature, or freeze it to a GraphDef",
        ) from error
    names = json.loads(answer["names"].tobytes())
    return answer["graph"].tobytes(), signature_of(names["inputs"], names["outputs"], names["signature"])
