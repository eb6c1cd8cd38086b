"""A module of RLlib as a source: its weights and the arguments it was made with, two pickles that are read as data.

Source: ray/rllib/utils/checkpoints.py and core/rl_module/{rl_module,multi_rl_module}.py of Ray 2.40 to 2.60
(``Checkpointable``): ``class_and_ctor_args.pkl`` names the class and its arguments, ``module_state.pkl`` is the state
dictionary as arrays of numpy. An algorithm's checkpoint has them below ``learner_group/learner/rl_module/<name>/``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from export_model.converters.files.fetch import Fetched
from export_model.converters.files.pickled_objects import array_of, unpickle_objects
from export_model.converters.formats.format import Member
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.trainers.pytorch.weights import ArraysByName
from export_model.converters.trainers.registry import rebuild
from export_model.converters.trainers.trainer import Saved
from export_model.signatures.errors import DamagedFileError, SourceError

_STATE, _ARGUMENTS = "module_state.pkl", "class_and_ctor_args.pkl"
_MODULES = (Path("learner_group/learner/rl_module"), Path("learner/rl_module"), Path("rl_module"), Path())
_MAX_MODULES, _MAX_TENSORS = 100, 10_000


def is_checkpoint(path: Path) -> bool:
    """Whether a folder is a checkpoint of an algorithm, or of modules, of which one at least is kept."""
    return bool(_modules_of(path))


def members(path: Path, options: ReadOptions) -> list[Member]:
    """Return the modules of a checkpoint."""
    return [Member(folder, folder.name) for folder in _modules_of(path)]


def _modules_of(path: Path) -> list[Path]:
    for place in (path / part for part in _MODULES):
        if place.is_dir():
            found = sorted(f.parent for f in place.glob(f"*/{_STATE}"))
            if found:
                return found[:_MAX_MODULES]
    return []


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """Return the one policy of a module's folder.

    Raises SourceError for a network that is not built and where a file is missing, DamagedFileError, NotAPolicyError.
    """
    files = tuple(given.path / name for name in (_STATE, _ARGUMENTS))
    if not files[1].is_file():
        raise SourceError(
            f"its {_ARGUMENTS} is missing",
            why=f"{_STATE} has weights only; activations, memory and actions are recorded in the files next to it",
            fix="give the folder as RLlib wrote it",
        )
    state, arguments = (unpickle_objects(given.bytes_of(file)) for file in files)
    made = rebuild(Saved(given, ArraysByName(_arrays(state)), {"rllib": arguments}))
    return [SourceModel(made.graph, files, made.facts)]


def _arrays(state: Any) -> Mapping[str, Any]:
    if not isinstance(state, dict) or not 0 < len(state) <= _MAX_TENSORS:
        raise DamagedFileError(f"its {_STATE} must be a state dictionary", why="it is damaged, or another file")
    return {str(name): array_of(value, f"{str(name)[:80]!r}") for name, value in state.items()}
