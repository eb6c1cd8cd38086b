"""Models that only TensorFlow can read (SavedModels of TensorFlow 2, Keras): it freezes them in a child process.

TensorFlow is an extra. A model file is untrusted, and loading one runs what it contains: hence the child.
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

from converters.runtimes.process import RunFailedError, RuntimeProcess
from converters.runtimes.python import child_command
from converters.saved_model.signature import ModelSignature, Tensor
from signatures.errors import RuntimeUnavailableError, SourceError

_CHILD = "converters.runtimes.tensorflow.freeze_child"
_WHAT = {"saved_model": "a SavedModel of TensorFlow 2", "keras": "a Keras model"}


def frozen_by_tensorflow(path: Path, form: str, signature: str | None = None) -> tuple[bytes, ModelSignature]:
    """(the GraphDef's bytes, its signature). ``form`` is "saved_model" or "keras".

    Raises RuntimeUnavailableError where TensorFlow is not installed, SourceError with its message where it refuses.
    """
    if importlib.util.find_spec("tensorflow") is None:
        raise RuntimeUnavailableError(
            f"is {_WHAT[form]}, which can only be read with TensorFlow",
            why="its functions are flattened by TensorFlow itself, and it is not installed",
            fix="pip install 'export-model[tensorflow]'; or freeze the model where it was made, and give the GraphDef",
        )
    try:
        with RuntimeProcess("tensorflow", child_command(_CHILD)) as process:
            answer = process.load(str(path), form=form, signature=signature).run({}, ["graph", "names"])
    except RunFailedError as error:
        raise SourceError(
            f"is {_WHAT[form]} that TensorFlow cannot load",
            why=(error.why or error.what)[:600],
            fix="load it where it was made, and save it as a SavedModel with a signature, or freeze it to a GraphDef",
        ) from error
    names = json.loads(answer["names"].tobytes())
    tensors = [{key: Tensor(name) for key, name in names[side].items()} for side in ("inputs", "outputs")]
    return answer["graph"].tobytes(), ModelSignature(tensors[0], tensors[1], names["signature"])
