"""What brax saves, as a source: a pickle of ``save_params``, read as data, or a folder that orbax wrote.

Source: brax/io/model.py and training/{checkpoint,types}.py of 0.14.2: the tuple (normaliser, policy[, value]), its
arrays numpy's or JAX's (jax/_src/array.py: ``_reconstruct_array`` around numpy's ``_reconstruct``), its mappings plain
or flax' FrozenDict. Orbax 0.12 keeps one array under each path of keys, joined by dots (``1.params.hidden_0.kernel``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files.fetch import Fetched
from export_model.converters.files.orbax_arrays import is_orbax, read_arrays
from export_model.converters.files.pickled_objects import Instance, Name, array_of, unpickle_objects
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.trainers.pytorch.weights import ArraysByName
from export_model.converters.trainers.registry import rebuild
from export_model.converters.trainers.trainer import Saved
from export_model.signatures.errors import DamagedFileError

#: Networks of brax nest two deep; what is deeper, or has more arrays, is none.
_MAX_DEPTH, _MAX_ARRAYS = 8, 10_000
#: What brax writes beside the arrays, of PPO and of SAC.
_CONFIG = "*_network_config.json"
#: How orbax calls the parts of that tuple, and how they are called here.
_PARTS = {"0.mean": "normaliser.mean", "0.std": "normaliser.std", "1.params": "policy"}
_STATISTICS = ("mean", "std")


def is_checkpoint(path: Path) -> bool:
    """Whether a folder is a step of orbax with brax's configuration beside the arrays."""
    return is_orbax(path) and any(path.glob(_CONFIG))


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """Return the one policy of a pickle.

    Raises NotAPolicyError for a name that acts on the machine, DamagedFileError, and what ``trainers.brax`` raises.
    """
    value = unpickle_objects(given.data)
    if not isinstance(value, tuple) or len(value) < 2 or not isinstance(value[0], Instance):
        raise DamagedFileError("it must hold a normaliser and a policy", why="brax saves them as a tuple")
    parts = {
        **{f"normaliser.{name}": value[0].attribute(name) for name in _STATISTICS},
        "policy": _mapping_of(value[1]).get("params"),
    }
    return _rebuild_policy(given, options, dict(_arrays(parts)), given.path.parent, (given.path,), len(value) > 2)


def read_folder(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """Return the one policy of a folder of orbax.

    Raises RuntimeUnavailableError without tensorstore, DamagedFileError, and what ``trainers.brax`` raises.
    """
    arrays, files = read_arrays(given, tuple(_PARTS))
    named = {f"{_PARTS[s]}{n.removeprefix(s)}": a for n, a in arrays.items() for s in _PARTS if n.startswith(s)}
    return _rebuild_policy(given, options, named, given.path, files, critic=False)


def _rebuild_policy(
    given: Fetched,
    options: ReadOptions,
    arrays: Mapping[str, np.ndarray],
    folder: Path,
    files: tuple[Path, ...],
    critic: bool,
) -> list[SourceModel]:
    settings = {"brax": folder, "critic": critic}
    saved = Saved(given, ArraysByName(arrays), settings, activation=options.activation, script=options.script)
    made = rebuild(saved)
    return [SourceModel(made.graph, (*files, *made.files), made.facts)]


def _mapping_of(value: Any) -> Mapping[Any, Any]:
    """Return a mapping, or what flax' FrozenDict was made of; an empty one of anything else."""
    if isinstance(value, Instance) and value.maker.name == "FrozenDict" and len(value.arguments) == 1:
        value = value.arguments[0]
    return value if isinstance(value, dict) else {}


def _arrays(tree: Mapping[Any, Any], path: str = "", depth: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each array of a tree by its path of keys. Raises DamagedFileError for what is neither."""
    for count, (key, value) in enumerate(tree.items()):
        name = f"{path}{key}"
        if depth > _MAX_DEPTH or count > _MAX_ARRAYS:
            raise DamagedFileError(f"its {name[:80]} is nested too deep", why="networks of brax have few layers")
        if inner := _mapping_of(value):
            yield from _arrays(inner, f"{name}.", depth + 1)
        elif not isinstance(value, dict):
            yield name, array_of(_numpys(value), f"{name[:80]!r}")


def _numpys(value: Any) -> Any:
    """Return numpy's array in one of JAX's; anything else as it is."""
    if not isinstance(value, Instance) or value.maker.name != "_reconstruct_array" or len(value.arguments) != 4:
        return value
    function, arguments, state, _ = value.arguments
    return Instance(function, arguments, state) if isinstance(function, Name) else None
