"""HDF5 files (``.h5``, ``model.weights.h5``) through h5py, which runs in a process of its own (hdf5_child.py)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from converters.runtimes.process import RunFailedError, RuntimeProcess
from converters.runtimes.python import child_command, module_origin
from signatures.errors import DamagedFileError, RuntimeUnavailableError
from signatures.records import dataclass

_CHILD = "converters.keras.hdf5_child"


@dataclass(frozen=True)
class Stored:
    """What an HDF5 file of Keras holds: (layer, name) → array, in its order, and what an ``.h5`` says of itself."""

    arrays: dict[tuple[str, str], np.ndarray]
    config: str | None = None
    version: str | None = None


def stored_in(path: Path) -> Stored:
    """What an ``.h5`` or ``.keras`` holds. Raises RuntimeUnavailableError without h5py, DamagedFileError."""
    if module_origin("h5py") is None:
        raise RuntimeUnavailableError(
            "is a Keras model, whose weights lie in HDF5, and h5py is not installed",
            why="HDF5 is read by its own library",
            fix="pip install 'export-model[keras]'",
        )
    try:
        with RuntimeProcess("h5py", child_command(_CHILD)) as process:
            answer = process.load(str(path.resolve())).run({}, [])
    except RunFailedError as error:
        raise DamagedFileError(
            "its weights cannot be read",
            why=(error.why or error.what)[:600],
            fix="save the model again: model.save('policy.keras')",
        ) from error
    index = json.loads(answer["index"].tobytes())
    arrays = {(layer, name): answer[str(i)] for i, (layer, name) in enumerate(index["arrays"])}
    return Stored(arrays, index["config"], index["version"])
