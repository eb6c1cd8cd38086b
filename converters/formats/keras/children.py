"""What only a library reads, in a process of its own: HDF5 (h5py), and Keras models of more than plain layers.

Keras builds what a file names, so loading one runs what it says. It is read where the caller trusts it, and then, too,
only if it is made of Keras' own layers (config.py): TensorFlow freezes it, in a child that has no network and cannot
write. HDF5 files are ``.h5`` and ``model.weights.h5`` (hdf5_child.py).
"""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
from msgspec import Struct

from export_model.converters.files.children.process import RunFailedError, RuntimeProcess
from export_model.converters.files.children.python import child_command, module_origin
from export_model.converters.formats.saved_model.signature import ModelSignature, signature_of
from export_model.signatures.errors import DamagedFileError, RuntimeUnavailableError, SourceError


class Stored(Struct, frozen=True):
    """Content of an HDF5 file of Keras.

    ``arrays`` are (layer, name) → array, in the file's order; ``config``, ``version`` and ``training`` are what an
    ``.h5`` says of itself, and ``names`` the first names in it.
    """

    arrays: dict[tuple[str, str], np.ndarray]
    config: str | None = None
    version: str | None = None
    #: how the model was compiled, as JSON
    training: str | None = None
    names: tuple[str, ...] = ()


def stored_in(path: Path) -> Stored:
    """What an ``.h5`` or ``.keras`` holds. Raises RuntimeUnavailableError without h5py, DamagedFileError."""
    if module_origin("h5py") is None:
        raise RuntimeUnavailableError(
            "is a Keras model with its weights in HDF5, and h5py is not installed",
            why="HDF5 is read by its own library",
            fix="pip install 'export-model[keras]'",
        )
    try:
        # 20 kB can keep the HDF5 library busy for ever, so that reading has the processor time of any untrusted file.
        with RuntimeProcess(
            "h5py", child_command("export_model.converters.formats.keras.hdf5_child"), timed_out=set()
        ) as process:
            answer = process.load(str(path.absolute())).run({}, [])
    except RunFailedError as error:
        raise DamagedFileError(
            "its weights cannot be read",
            why=(error.why or error.what)[:600],
            fix="save the model again: model.save('policy.keras')",
        ) from error
    index = json.loads(answer["index"].tobytes())
    arrays = {(layer, name): answer[str(i)] for i, (layer, name) in enumerate(index["arrays"])}
    return Stored(arrays, index["config"], index["version"], index["training"], tuple(index["names"]))


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
        with RuntimeProcess(
            "tensorflow", child_command("export_model.converters.runtimes.tensorflow.python")
        ) as process:
            answer = process.load(str(path.absolute()), kind="keras").run({}, ["graph", "names"])
    except RunFailedError as error:
        raise SourceError(
            "is a Keras model that TensorFlow cannot load",
            why=(error.why or error.what)[:600],
            fix="load it where it was made, and save it as a SavedModel with a signature, or freeze it to a GraphDef",
        ) from error
    names = json.loads(answer["names"].tobytes())
    return answer["graph"].tobytes(), signature_of(names["inputs"], names["outputs"], names["signature"])
