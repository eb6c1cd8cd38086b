"""The table of what states an interface: files beside a policy, by name, in the order in which they are believed."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.files.fetch import inside, read_bytes
from export_model.converters.files.yaml_data import MAX_YAML_BYTES, read_yaml
from export_model.converters.interfaces.isaac_lab import read_agent, read_descriptors, read_environment
from export_model.converters.interfaces.leapp import read_pipeline
from export_model.converters.interfaces.merge import merge
from export_model.converters.interfaces.metadata import METADATA_KEYS, metadata_in, read_metadata
from export_model.converters.interfaces.mlagents import read_configuration
from export_model.converters.interfaces.table import Table
from export_model.converters.interfaces.unitree import read_deploy
from export_model.signatures.errors import DamagedFileError, ExportModelError
from export_model.signatures.fields import printable
from export_model.signatures.interface import Interface

#: What ``--interface`` is given to leave out what lies beside a source.
NO_INTERFACE = "none"
#: Keys of ONNX metadata in a file, how alike a key or a name is to be called near, and what stands for no key.
_METADATA, _ALIKE, _NO = "the keys of ONNX metadata", 0.7, ("", "", "-")
#: Entries of a folder that are looked at.
_MOST_ENTRIES = 2000
#: The folder that Isaac Lab writes IO descriptors to.
_DESCRIPTORS = "io_descriptors"
#: Folders that trainers put models in, beside ``params/``: rsl_rl's, rl_games', skrl's.
_BELOW_A_RUN = re.compile("exported|nn|checkpoints")
_BOTH = ("observations", "actions")


class InterfaceFile(Struct, frozen=True):
    """A kind of file: what its name matches (``{folder}``: its folder's), keys of which it has one, its reader."""

    label: str
    pattern: str
    keys: tuple[str, ...]
    #: given what the file holds, the source's file name and the behavior's name
    read: Callable[[Table, str, str], Interface]
    #: whether it is for several behaviors, each of which may have a folder below its own
    of_many: bool = False
    #: whether it is of this kind by what it holds, where others have the same keys; it may have any name then
    fits: Callable[[Mapping[str, Any]], bool] = lambda content: True


def _alone(read: Callable[[Table], Interface]) -> Callable[[Table, str, str], Interface]:
    return lambda table, model, behavior: read(table)


def _parts(content: Mapping[str, Any]) -> list[Any]:
    """What stands below ``observations`` and ``actions``."""
    tables = [content[key] for key in _BOTH if isinstance(content.get(key), dict)]
    return [value for table in tables for value in table.values()]


def _has_rows(content: Mapping[str, Any]) -> bool:
    """Whether its terms are lists of rows, as IO descriptors have them."""
    return isinstance(content.get("actions"), list) or any(isinstance(part, list) for part in _parts(content))


def _has_scales(content: Mapping[str, Any]) -> bool:
    """Whether its terms are tables with scales right below ``observations`` and ``actions``, none with a function."""
    entries = [part for part in _parts(content) if isinstance(part, dict)]
    return any("scale" in part for part in entries) and "decimation" not in content


FILES = (
    InterfaceFile(
        "Isaac Lab's IO descriptors", "*IO_descriptors.yaml", _BOTH, _alone(read_descriptors), fits=_has_rows
    ),
    InterfaceFile("LEAPP's pipeline", "{folder}.yaml", ("models",), lambda t, model, _: read_pipeline(t, model)),
    InterfaceFile("Unitree's deploy.yaml", "deploy.yaml", _BOTH, _alone(read_deploy), fits=_has_scales),
    InterfaceFile("Isaac Lab's env.yaml", "env.yaml", ("decimation", *_BOTH), _alone(read_environment)),
    InterfaceFile("Isaac Lab's agent.yaml", "agent.yaml", ("clip_actions", "params"), _alone(read_agent)),
    InterfaceFile(
        "ML-Agents' configuration.yaml",
        "configuration.yaml",
        ("behaviors",),
        lambda t, _, name: read_configuration(t, name),
        of_many=True,
    ),
)


def files_beside(source: Path) -> Iterator[tuple[InterfaceFile, Path]]:
    """Yield the files that may state the interface of what was read from ``source``, the most believed first.

    A link that leads out of its folder is not followed.
    """
    folder = (source if source.is_dir() else source.parent).absolute()
    places = [folder, folder / "params", folder / _DESCRIPTORS]
    if _BELOW_A_RUN.fullmatch(folder.name):
        places += [folder.parent, folder.parent / "params", folder.parent / _DESCRIPTORS]
    for kind in FILES:
        above = [folder.parent] if kind.of_many else []
        for place in dict.fromkeys([*places, *above]):
            for name in _names(place, kind.pattern.replace("{folder}", place.name)):
                path = inside(place, name)
                if path is not None and path.is_file():
                    yield kind, place / name


#: In a note on a file that could not be read.
LEFT_OUT = "beside the source is left out"


def _names(place: Path, pattern: str) -> list[str]:
    """The names in a folder that match; only that of descriptors, which has few, is looked through."""
    if place.name != _DESCRIPTORS or "*" not in pattern:
        return [pattern.replace("*", "")]
    try:
        with os.scandir(place) as entries:
            names = [e.name for _, e in zip(range(_MOST_ENTRIES), entries, strict=False)]
    except OSError:
        return []
    return sorted(name for name in names if fnmatchcase(name, pattern))


def read_beside(source: Path, name: str | None, wanted: str | None) -> tuple[Interface | None, tuple[str, ...]]:
    """Return what the files beside a source state, and notes on those that could not be read.

    ``name`` is the policy's where the source says it. ``wanted`` is a file to be read in their place, which must be one
    of the known kinds: raises what ``read_interface`` raises.
    """
    if wanted == NO_INTERFACE:
        return None, ()
    behavior = name or (source.name if source.is_dir() else source.stem)
    if wanted is not None:
        return read_interface(Path(wanted), source.name, behavior), ()
    found: Interface | None = None
    notes: list[str] = []
    for kind, path in files_beside(source):
        try:
            stated = _of_kind(kind, path, source.name, behavior)
        except ExportModelError as error:
            hint = f"; {error.fix}" if error.fix else ""
            notes.append(printable(f"{path.name} {LEFT_OUT}: {error.what}{hint}"[:500]))
            continue
        if stated is not None:
            found, conflicts = (stated, ()) if found is None else merge(found, stated)
            notes += conflicts
    return found, tuple(notes)


def read_interface(path: Path, model: str, behavior: str) -> Interface:
    """Return what a file of one of the known kinds states, whatever its name, with keys that loaders ask for.

    Raises DamagedFileError that names the nearest kind, SourceError, RuntimeUnavailableError.
    """
    content = read_yaml(read_bytes(path, empty=True, most=MAX_YAML_BYTES), path.name)
    file = printable(path.name)
    if isinstance(content, dict):
        metadata = metadata_in(content)
        rest = {key: value for key, value in content.items() if key not in metadata}
        own = [k for k in FILES if fnmatchcase(path.name, k.pattern.replace("{folder}", path.absolute().parent.name))]
        for kind in [*own, *(k for k in FILES if k not in own)]:
            if any(key in rest for key in kind.keys) and (kind in own or kind.fits(rest)):
                found = kind.read(Table(rest, file), model, behavior)
                if kind in own or replace(found, kept=()):
                    return replace(found, metadata={**found.metadata, **metadata})
        if metadata and (stated := read_metadata(metadata, file)) is not None:
            return replace(stated, kept=(*stated.kept, *Table(rest, file).rest()))
    raise DamagedFileError(
        "states no interface",
        where=str(path),
        why=_nearest(content if isinstance(content, dict) else {}, path.name),
        fix=f"give one of {', '.join(kind.label for kind in FILES)}, or keys of ONNX metadata",
    )


def _nearest(content: Mapping[str, Any], name: str) -> str:
    """Which known kind a file is most like, by its keys, else by its name."""
    from difflib import SequenceMatcher  # not in every export: 2 ms

    def alike(pair: tuple[str, str, str]) -> float:
        return SequenceMatcher(None, pair[1], pair[2]).ratio()

    keys = [str(key)[:60] for key in [*content][:200]]
    kinds = [*((kind.label, kind.keys) for kind in FILES), (_METADATA, METADATA_KEYS)]
    label, own, known = max(
        ((kind, k, o) for kind, known in kinds for o in known for k in keys), key=alike, default=_NO
    )
    if alike((label, own, known)) >= _ALIKE:
        same = f"it has {own}, but nothing in the form of that kind" if own == known else f"{own} may be {known}"
        return f"the nearest kind is {label}: {printable(same)}"
    label, own, known = max(((k.label, name, k.pattern) for k in FILES), key=alike)
    nearest = f"; by its name it is nearest to {label}" if alike((label, own, known)) >= _ALIKE else ""
    return f"it has none of the keys of the known kinds{nearest}"


def _of_kind(kind: InterfaceFile, path: Path, model: str, behavior: str) -> Interface | None:
    """What a file states; None where it has the name alone."""
    content = read_yaml(read_bytes(path, empty=True, most=MAX_YAML_BYTES), path.name)
    if not isinstance(content, dict) or not any(key in content for key in kind.keys):
        return None
    return kind.read(Table(content, printable(path.name)), model, behavior)
