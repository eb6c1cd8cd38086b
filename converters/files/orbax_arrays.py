"""Arrays of a folder that orbax wrote (JAX), by tensorstore: https://orbax.readthedocs.io, checkpoint format of 0.12.

``_METADATA`` names every array by its path of keys. They lie in one key-value store (``manifest.ocdbt``), or, with
``use_ocdbt=False``, in a folder each; as Zarr 2, or 3 where ``use_zarr3`` says so.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files.fetch import Fetched
from export_model.converters.files.file_probe import json_in
from export_model.signatures.errors import DamagedFileError, RuntimeUnavailableError

_METADATA, _STORE = "_METADATA", "manifest.ocdbt"
_MAX_ARRAYS, _MAX_ELEMENTS = 10_000, 1 << 28


def is_orbax(folder: Path) -> bool:
    """Whether a folder is one step that orbax saved."""
    return (folder / _METADATA).is_file() and ((folder / _STORE).is_file() or (folder / "commit_success.txt").is_file())


def read_arrays(given: Fetched, starts: tuple[str, ...]) -> tuple[dict[str, np.ndarray], tuple[Path, ...]]:
    """Return the arrays whose names begin with one of ``starts`` and a dot (or are it), and the files that were read.

    A name is the path of keys, joined by dots. Raises RuntimeUnavailableError without tensorstore, DamagedFileError.
    """
    if importlib.util.find_spec("tensorstore") is None:
        raise RuntimeUnavailableError(
            "tensorstore is not installed, which reads what orbax saves",
            fix="pip install 'export-model[orbax]'; or give what brax.io.model.save_params writes",
        )
    folder = given.path
    metadata = _metadata(given)
    names = [".".join(path) for path in _paths(metadata)]
    wanted = [n for n in names if any(n == s or n.startswith(f"{s}.") for s in starts)]
    arrays = {name: _read(folder, name, bool(metadata.get("use_zarr3"))) for name in wanted}
    return arrays, tuple(sorted(p for p in folder.rglob("*") if p.is_file()))


def _metadata(given: Fetched) -> Mapping[str, Any]:
    try:
        metadata = json_in(given.bytes_of(given.path / _METADATA))
    except (ValueError, RecursionError) as error:
        raise DamagedFileError(f"its {_METADATA} is not JSON", why=str(error)[:200]) from error
    if not isinstance(metadata, dict):
        raise DamagedFileError(f"its {_METADATA} must be an object", why="it names the arrays")
    return metadata


def _paths(metadata: Mapping[str, Any]) -> list[list[str]]:
    tree = metadata.get("tree_metadata")
    entries = list(tree.values()) if isinstance(tree, dict) else []
    paths = [e.get("key_metadata") if isinstance(e, dict) else None for e in entries]
    if not 0 < len(paths) <= _MAX_ARRAYS or not all(isinstance(p, list) for p in paths):
        raise DamagedFileError(f"its {_METADATA} names no arrays", why="it must have tree_metadata with key_metadata")
    keys = [[str(k.get("key")) if isinstance(k, dict) else "" for k in path or ()] for path in paths]
    return [path for path in keys if not any(part in ("", "..") or "/" in part for part in path)]


def _read(folder: Path, name: str, zarr3: bool) -> np.ndarray:
    import tensorstore

    files = {"driver": "file", "path": f"{folder.absolute()}/"}
    if (folder / _STORE).is_file():
        store: dict[str, Any] = {"driver": "ocdbt", "base": files, "path": f"{name}/"}
    else:
        store = {"driver": "file", "path": f"{folder.absolute() / name}/"}
    try:
        found = tensorstore.open({"driver": "zarr3" if zarr3 else "zarr", "kvstore": store}, open=True).result()
        if math.prod(found.shape) > _MAX_ELEMENTS:
            raise DamagedFileError(
                f"its {name[:80]!r} has {math.prod(found.shape)} numbers", why="no policy has so many"
            )
        return np.asarray(found.read().result())
    except (ValueError, OSError, TypeError) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DamagedFileError(f"its {name[:80]!r} cannot be read", why=text[:300]) from error
