"""TensorFlow in its own process, by its C interface.

``python -m export_model.converters.runtimes.tensorflow.child NAME LIBRARY``
NAME is the runtime's, LIBRARY the path of the shared object that has the C API. TensorFlow 2 runs graphs and our own
SavedModels so; its Python is imported (2 s, 200 MiB) for what it alone builds (python.py), and does all of it where
the library does not load. An assertion within TensorFlow ends this process, not its parent.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.children.child import Model, claim_stdout, serve
from export_model.converters.files.children.frames import Tensors
from export_model.converters.runtimes.tensorflow import python
from export_model.converters.runtimes.tensorflow.library import Session, TensorFlowError, library_version, load_library


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    name, path = sys.argv[1:]
    python.set_environment()
    try:
        library = load_library(path)
    except (OSError, AttributeError):  # another system, or a build without the C API
        if name != "tensorflow":
            raise
        python.serve_python(out)
    if name != "tensorflow":
        serve(name, library_version(library), lambda h: Session(library, Path(h["path"])), (TensorFlowError,), out)
    version = f"{library_version(library)} (C interface)"
    serve(name, version, lambda header: _load(library, header), (TensorFlowError, *python.FAULTS), out)


def _load(library: ctypes.CDLL, header: Mapping[str, Any]) -> Model:
    kind = header["kind"]
    if kind == "saved_model":
        return _Saved(library, Path(header["path"]), header.get("signature", "serving_default"))
    if kind == "graph":
        return Session(library, Path(header["path"]), fitting=True, source=header.get("source", False))
    return python.load(header)


class _Saved:
    """A SavedModel, called by one signature, inputs by name."""

    def __init__(self, library: ctypes.CDLL, folder: Path, key: str) -> None:
        self._session = Session(library, folder, saved=True)
        meta = schema.parse(schema.MetaGraphDef, self._session.meta_graph, "MetaGraphDef")
        self._session.meta_graph = b""
        if key not in meta.signature_def:
            raise TensorFlowError(f"the SavedModel has no signature {key!r}")
        signature = meta.signature_def[key]
        self._inputs = {name: info.name for name, info in signature.inputs.items()}
        self._outputs = {name: info.name for name, info in signature.outputs.items()}

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        if feeds.keys() != self._inputs.keys():
            raise TensorFlowError(f"the signature takes {sorted(self._inputs)}, and {sorted(feeds)} were fed")
        tensors = {self._outputs[name]: name for name in fetch}
        answers = self._session.run({self._inputs[name]: a for name, a in feeds.items()}, list(tensors))
        return {name: answers[self._outputs[name]] for name in fetch}


if __name__ == "__main__":
    main()
