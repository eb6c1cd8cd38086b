"""What a trainer wrote beside a checkpoint about its network: a YAML file, asked key by key, with types."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from export_model.converters.files.fetch import Fetched
from export_model.converters.files.file_probe import json_in
from export_model.converters.files.yaml_data import MAX_YAML_BYTES, read_yaml
from export_model.converters.graph.nn.activations import Activation
from export_model.converters.trainers.pytorch.activations import activation_named
from export_model.converters.trainers.trainer import Saved
from export_model.signatures.errors import SourceError

#: Folders of a run that hold its checkpoints alone: the settings lie one folder up.
_OF_CHECKPOINTS = re.compile(r"nn|checkpoints|checkpoint_p\d+")
MAX_HIDDEN_LAYERS = 64
#: Numbers that a layer gives.
MAX_UNITS = 1 << 16


class Settings:
    """A mapping of a settings file. ``place`` is its path of keys in ``file``, as errors name it.

    Each question raises SourceError, with the key, where the value has another type or is outside its bounds.
    """

    def __init__(self, values: Mapping[str, Any], file: str, place: str = "") -> None:
        self.values, self.file, self.place = values, file, place

    def __contains__(self, key: str) -> bool:
        return self.values.get(key) is not None

    def section(self, key: str) -> Settings:
        """Return a mapping below this one; an empty one where the key is missing."""
        value = self.values.get(key)
        if value is not None and not isinstance(value, dict):
            raise self.error(key, "must be a mapping")
        return Settings(value or {}, self.file, self._path(key))

    def sections(self, key: str) -> list[Settings]:
        """Return the mappings of a list; of a mapping, its values."""
        value = self.values.get(key)
        items = list(value.values()) if isinstance(value, dict) else value
        if not isinstance(items, list) or len(items) > MAX_HIDDEN_LAYERS or not all(isinstance(v, dict) for v in items):
            raise self.error(key, f"must be a list of at most {MAX_HIDDEN_LAYERS} mappings")
        return [Settings(v, self.file, f"{self._path(key)}[{i}]") for i, v in enumerate(items)]

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text; ``default`` (None: there must be one) where the key is missing."""
        value = self.values.get(key)
        value = default if value is None else value
        if not isinstance(value, str):
            raise self.error(key, "must be text")
        return value

    def flag(self, key: str, *, default: bool = False) -> bool:
        """Return true or false."""
        value = self.values.get(key)
        if value is not None and not isinstance(value, bool):
            raise self.error(key, "must be true or false")
        return default if value is None else value

    def number(self, key: str, default: float) -> float:
        """Return a number. YAML 1.1 takes ``1e-3`` for text: it is a number here."""
        value = self.values.get(key)
        try:
            number = float(default if value is None or isinstance(value, bool) else value)
        except (TypeError, ValueError) as error:
            raise self.error(key, "must be a number") from error
        if not math.isfinite(number):
            raise self.error(key, "must be finite")
        return number

    def sizes(self, key: str) -> list[int]:
        """Return a list of lengths, each at least 1."""
        value = self.values.get(key)
        if not isinstance(value, list) or len(value) > MAX_HIDDEN_LAYERS or not all(map(_is_size, value)):
            raise self.error(key, f"must be a list of at most {MAX_HIDDEN_LAYERS} numbers from 1 to {MAX_UNITS}")
        return value

    def pair(self, key: str, default: int, least: int = 1) -> tuple[int, int]:
        """Return a number for height and width, or one for both."""
        value = self.values.get(key, default)
        both = value if isinstance(value, list) else [value, value]
        if len(both) != 2 or not all(_is_size(v, least) for v in both):
            raise self.error(key, f"must be a number from {least} on, or two")
        return both[0], both[1]

    def activation(self, key: str, default: str | None = None) -> Activation:
        """Return the activation of the name that stands there."""
        name = self.text(key, default)
        found = activation_named(name)
        if found is None:
            raise self.error(key, f"is {name[:40]!r}, which is not an activation that is known")
        return found

    def error(self, key: str, what: str) -> SourceError:
        """Return the refusal of a value."""
        return SourceError(
            f"{self.file}: {self._path(key)} {what}",
            why="it says how the network of the checkpoint is built",
            fix="give the file that the training wrote, unchanged, next to the checkpoint",
        )

    def _path(self, key: str) -> str:
        return f"{self.place}.{key}" if self.place else key


def _is_size(value: object, least: int = 1) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= MAX_UNITS


def _json_values(data: bytes, name: str) -> Any:
    """Return what JSON says, which takes no PyYAML. Raises SourceError."""
    try:
        return json_in(data)
    except (ValueError, RecursionError) as error:
        raise SourceError(
            f"{name} is not JSON", why=str(error)[:200], fix="give the file that the training wrote"
        ) from error


def needed_settings(
    saved: Saved, trainer: str, names: Sequence[str], keys: Sequence[str], *, why: str, fix: str, has: str = ""
) -> tuple[Settings, Path]:
    """Return what ``find_settings`` finds. Raises UsageError where activations are given, which the file has.

    The first of ``names`` is what people call the file; ``has`` says where activations stand in it.
    Raises SourceError where there is no such file: ``why`` says what it holds, ``fix`` where the trainer leaves it.
    """
    called = names[0].rpartition("/")[2]
    saved.refuse_activation(f"a checkpoint of {trainer}", f"its {called} has {has or 'each of them'}")
    found = find_settings(saved.given, names, keys)
    if found is None:
        files = ", ".join(names)
        raise SourceError(
            f"its {called} is missing",
            why=f"a checkpoint of {trainer} has weights; {why}, and none of these files is here: {files}",
            fix=fix,
        )
    return found


def find_settings(given: Fetched, names: Sequence[str], keys: Sequence[str]) -> tuple[Settings, Path] | None:
    """Return the first file of these names that has one of ``keys`` at its top, and its path; None where none has.

    They are looked for beside the checkpoint, and beside the folder that a run keeps its checkpoints in.
    Raises SourceError where the file is not read, RuntimeUnavailableError without PyYAML.
    """
    folder = given.path.parent
    for place in (folder, *((folder.parent,) if _OF_CHECKPOINTS.fullmatch(folder.name) else ())):
        for name in names:
            file = place / name
            try:
                if not file.is_file() or file.stat().st_size > MAX_YAML_BYTES:
                    continue
            except OSError:
                continue
            data = given.bytes_of(file, empty=True)
            values = _json_values(data, name) if name.endswith(".json") else read_yaml(data, name)
            if isinstance(values, dict) and any(isinstance(values.get(key), dict | list) for key in keys):
                return Settings(values, name), file
    return None
