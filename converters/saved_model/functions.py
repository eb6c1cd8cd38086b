"""Models that only TensorFlow can read (SavedModels of TensorFlow 2, Keras): it freezes them in a child process.

TensorFlow is an extra. A model file is untrusted, and loading one runs what it contains: hence the child.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

from converters.runner.process import RunFailedError, RuntimeProcess
from converters.saved_model.signature import ModelSignature, Tensor
from signatures.errors import RuntimeUnavailableError, SourceError

_ROOT = Path(__file__).resolve().parents[2]
_CHILD = "converters.runner.freeze_child"
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
    start = f"import sys, runpy; sys.path.insert(0, {str(_ROOT)!r}); "
    command = [sys.executable, "-c", f"{start}runpy.run_module({_CHILD!r}, run_name='__main__')"]
    try:
        with RuntimeProcess("tensorflow", command) as process:
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
