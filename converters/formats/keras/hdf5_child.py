"""The arrays and the configuration of an HDF5 file, read by h5py in a confined process.

``python -m export_model.converters.formats.keras.hdf5_child``. Loads by ``path`` an ``.h5``, or a ``.keras``'s
``model.weights.h5``; run, it gives JSON as ``index`` ({"config", "version", "training", "names",
"arrays": [[layer, name], …]}), and the arrays as ``0``, ``1``, …; none of an ``.h5`` that is no model, whose names say
what it is.
The HDF5 library has met hostile files before: it has no network here, writes nothing, and can end without harm. What
lies elsewhere, refers to something, or is larger than the file is refused before it is read.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import count, islice, takewhile
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files.children.child import claim_stdout, serve
from export_model.converters.files.children.frames import Tensors
from export_model.converters.files.zip_archives import ZIP_ERRORS, entry_of, open_archive
from export_model.converters.formats.keras.config import MAX_CONFIG
from export_model.signatures.errors import DamagedFileError, ExportModelError

WEIGHTS = "model.weights.h5"
_MAX_DEPTH, _MAX_ENTRIES = 32, 1 << 14
#: Names of what lies in a file that are told, for a message.
_SHOWN = 20
#: How much larger the weights in a ``.keras`` may be than the archive: Keras does not compress them.
_MAX_RATIO, _FREE = 8, 1 << 20


def _open_weights(path: str) -> tuple[io.BytesIO, int, bool]:
    """(the HDF5 file's bytes, their number, whether they lie in a ``.keras``)."""
    data = Path(path).read_bytes()
    if not data.startswith(b"PK"):
        return io.BytesIO(data), len(data), False
    with open_archive(data) as archive:
        content = entry_of(archive, WEIGHTS, _MAX_RATIO * len(data) + _FREE)
    return io.BytesIO(content), len(content), True


class _Weights:
    def __init__(self, path: str) -> None:
        import h5py

        self.h5py = h5py
        stream, self.left, zipped = _open_weights(path)
        self.entries = _MAX_ENTRIES
        with h5py.File(stream, "r") as file:
            said = ("model_config", "keras_version", "training_config")
            config, version, training = (self._text(file.attrs, key) for key in said)
            names = [str(name) for name in islice(file, _SHOWN)]
            arrays = [] if config is None and not zipped else [*self._arrays(file)]
        texts = {"config": config, "version": version, "training": training}
        index = {**texts, "names": names, "arrays": [name for name, _ in arrays]}
        self.tensors = {str(i): array for i, (_, array) in enumerate(arrays)}
        self.tensors["index"] = np.frombuffer(json.dumps(index).encode(), np.uint8)

    def _arrays(self, file: Any) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
        root = self._group(file, "model_weights") or file
        return self._h5_arrays(root) if "layer_names" in root.attrs else self._keras_arrays(root, "", 0)

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        return self.tensors

    def _text(self, attributes: Any, key: str) -> str | None:
        if key not in attributes:
            return None
        self._check(attributes, key)
        value = attributes[key]
        text = value.decode() if isinstance(value, bytes) else str(value)
        return text if len(text) <= MAX_CONFIG else None

    def _check(self, attributes: Any, key: str) -> None:
        """Raise DamagedFileError where an attribute is larger than it may be."""
        said = attributes.get_id(key)
        if _size(said.shape, said.dtype) > min(MAX_CONFIG, self.left):
            raise DamagedFileError(f"its {key} is larger than the file", fix="save the model again")

    def _member(self, group: Any, key: str) -> Any:
        """What lies in a group, if it lies there."""
        self.entries -= 1
        link = group.get(key, getlink=True)
        if not isinstance(link, self.h5py.HardLink) or self.entries < 0:
            raise DamagedFileError(
                f"its {key[:200]!r} is {'one of too many' if self.entries < 0 else 'a link to something else'}",
                fix="save the model again, in one file",
            )
        return group[key]

    def _group(self, group: Any, key: str) -> Any:
        member = self._member(group, key) if key in group else None
        return member if isinstance(member, self.h5py.Group) else None

    def _h5_arrays(self, root: Any) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
        """The arrays of an ``.h5``, in the order of the layers and of each layer's weights."""
        for layer in self._names(root, "layer_names"):
            group = self._group(root, layer)
            for name in () if group is None else self._names(group, "weight_names"):
                at = group
                for part in name.split("/"):
                    at = self._member(at, part)
                yield (layer, name), self._array(at)

    def _names(self, group: Any, key: str) -> list[str]:
        """A list of names; a long one lies in several attributes (``layer_names0``, …)."""
        parts = takewhile(group.attrs.__contains__, (f"{key}{number}" for number in count()))
        found: list[str] = []
        for name in [key] if key in group.attrs else parts:
            self._check(group.attrs, name)
            found += [n.decode() if isinstance(n, bytes) else str(n) for n in np.ravel(group.attrs[name])]
        return found

    def _keras_arrays(self, group: Any, path: str, depth: int) -> Iterator[tuple[tuple[str, str], np.ndarray]]:
        """The arrays of a ``.keras``, by their paths."""
        for key in group:
            if depth > _MAX_DEPTH:
                raise DamagedFileError("its groups are nested too deep", fix="save the model again")
            if not depth and key in ("optimizer", "_optimizer"):
                continue
            value = self._member(group, key)
            if isinstance(value, self.h5py.Group):
                yield from self._keras_arrays(value, f"{path}{key}/", depth + 1)
            else:
                yield ("", path + key), self._array(value)

    def _array(self, data: Any) -> np.ndarray:
        """A dataset that lies in the file as it is; raises DamagedFileError."""
        if not isinstance(data, self.h5py.Dataset) or data.is_virtual or data.external:
            raise DamagedFileError(
                f"its {str(getattr(data, 'name', ''))[:200]!r} is in another file, or is not an array"
            )
        size = _size(data.shape, data.dtype)
        if (
            data.shape is None
            or data.dtype.kind not in "fiub"
            or data.id.get_storage_size() != size
            or size > self.left
        ):
            raise DamagedFileError(
                f"its {str(data.name)[:200]!r} is not stored as the array of numbers that it claims to be",
                why="it is packed, empty, of another type, or larger than the file",
                fix="save the model again, as Keras does",
            )
        self.left -= size
        return np.asarray(data[()])


def _size(shape: Sequence[int] | None, dtype: np.dtype) -> int:
    return math.prod(shape or ()) * dtype.itemsize


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    import h5py

    faults = (ExportModelError, AttributeError, RecursionError, *ZIP_ERRORS)
    serve("h5py", h5py.__version__, lambda header: _Weights(header["path"]), faults, out)


if __name__ == "__main__":
    main()
