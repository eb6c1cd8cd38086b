"""Sources in what a person gives for many: patterns, folders, lists of paths in a file."""

from __future__ import annotations

import glob
import logging
import os
import re
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

from msgspec import Struct, field

from export_model.converters.files.fetch import Fetched, path_text, unreadable
from export_model.converters.files.folders import natural_order
from export_model.converters.formats.bundle import BUNDLE
from export_model.converters.formats.recognise import recognise_path
from export_model.converters.formats.source import ReadOptions
from export_model.exporter.remote.filesystem import is_pattern, matching, remote
from export_model.signatures.errors import SourceError, UsageError

_LOG = logging.getLogger("export_model")
#: Bytes of a list of paths.
MAX_LIST = 16 << 20
_MAGIC = frozenset("*?[")
#: The format of text that is none of the others, and how much of a file of it is looked at.
_TEXT, _LINES_LOOKED_AT = "text", 1000
#: A suffix that begins with a letter, as ``numpy==2.1`` has not.
_FILE_NAME = re.compile(r"\w\.[A-Za-z]\w{1,15}$")
#: What a folder holds besides models is passed over, but for what stands there in a model's place.
_TELLING = ("lfs_pointer",)
#: Files that are called as models are: those that cannot be read are refused by name, not passed over.
_MODELS = frozenset((".bytes", ".keras", ".nn", ".onnx", ".pb", ".pt", ".tflite"))
#: What TensorFlow puts beside ``saved_model.pb``.
_COMPANIONS = frozenset(("fingerprint.pb", "keras_metadata.pb"))
_MOST_NAMED = 10
_READ = ReadOptions()


def is_many(given: Sequence[Path], read: ReadOptions = _READ) -> bool:
    """Whether one of the paths stands for others: a pattern, a list, or a folder that is not one source."""
    try:
        return any(
            remote(path) is not None
            or (path.is_dir() and not (_is_source(path) and _parts(path, read) is None))
            or (not path.exists() and not _MAGIC.isdisjoint(str(path)))
            or _is_list(path)
            for path in given
        )
    except (OSError, ValueError):  # what cannot be a path: its reader says why
        return False


class PassedOver(Struct):
    """Files that are not exported: those that are not models, and other forms of policies that are."""

    others: list[Path] = field(default_factory=list)
    forms: list[Path] = field(default_factory=list)


def sources_in(
    given: Sequence[Path], out: Path, passed_over: PassedOver | None = None, read: ReadOptions = _READ
) -> list[Path]:
    """The sources that the paths stand for, each once, in their order; those of a pattern or folder by name.

    A file that is called as a model is a source, whatever it holds: its reader refuses it by name. ``passed_over`` gets
    the other files that a pattern or a folder has.

    ``**`` goes through all folders. A ``.txt`` whose lines are paths stands for them, from where the command is called;
    ``#`` begins a comment. What is at an address is fetched later, one by one. What lies in ``out`` is no source.
    Raises UsageError where there is none, or a path stands for none.
    """
    passed_over = passed_over or PassedOver()
    if not given:
        raise UsageError("no source was given", fix="export-model FILE -o DIR")
    found: dict[Path, None] = {}
    for path in given:
        search = _Search(out.resolve(), read, PassedOver())
        here = list(search.expand(path))
        if not here and path.is_dir():
            recognise_path(Fetched(path))  # which says what lies there instead
        others = search.passed_over.others
        if not here:
            raise UsageError(
                f"{path_text(path)} matches no model",
                why=f"none of the matching files is a model: {paths_text(others)}" if others else "no file matches",
                fix="give model files, run folders, or folders that hold them",
            )
        found.update(dict.fromkeys(here))
        passed_over.others += others
        passed_over.forms += search.passed_over.forms
    return list(found)


def in_folder(path: Path, out: Path, read: ReadOptions) -> list[Path]:
    """The sources that a folder stands for; of anything else the path itself. Raises UsageError, SourceError."""
    if not path.is_dir():
        return [path]
    passed_over = PassedOver()
    found = sources_in([path], out, passed_over, read)
    if passed_over.forms:
        _LOG.info("also here, not used: %s", paths_text(passed_over.forms))
    return found


def paths_text(paths: Sequence[Path]) -> str:
    """The paths, or the first and how many more."""
    more = f" and {len(paths) - _MOST_NAMED} more" if len(paths) > _MOST_NAMED else ""
    return ", ".join(map(path_text, paths[:_MOST_NAMED])) + more


class _Search(Struct, frozen=True):
    """Finds sources; what lies in ``out`` is none."""

    out: Path
    read: ReadOptions
    passed_over: PassedOver

    def expand(self, path: Path) -> Iterator[Path]:
        """Yield the sources that a path stands for. Raises UsageError, SourceError."""
        address = remote(path)
        if address is not None:
            yield from matching(address) if is_pattern(address) else [path]
        elif path.is_dir():
            yield from self._walk(path)
        elif _is_list(path):
            for line in _lines(path):
                listed = Path(line)
                if _is_list(listed):  # one that names itself has no end
                    raise UsageError(f"{path} names another list", where=line, fix="put its lines in its place")
                yield from self.expand(listed)
        elif not path.exists() and not _MAGIC.isdisjoint(str(path)):
            yield from self._matching(path)
        else:
            yield path

    def _matching(self, pattern: Path) -> Iterator[Path]:
        """The sources that a pattern finds; of a folder that is a source itself, nothing that lies in it."""
        whole: set[Path] = set()
        for match in sorted(set(_glob(pattern)), key=natural_order):
            if not whole.isdisjoint(match.parents) or _lies_in(match, self.out):
                continue
            if match.is_file():
                if _is_source(match) or _is_called_a_model(match):
                    yield match
                else:
                    self.passed_over.others.append(match)
            elif "**" not in pattern.parts or _is_source(match):  # a ** goes into the others by itself
                whole.add(match)
                yield from self._walk(match)

    def _walk(self, top: Path) -> Iterator[Path]:
        """What is a source in a folder: itself, or the first on each way down, however deep; no link is gone through.

        A folder whose files are policies of their own is not one source, and its folders are gone through, too.
        """
        left = [top]
        while left:
            path = left.pop()
            if not path.is_dir() or (path.is_symlink() and path != top):
                if path.is_file() and (_is_source(path) or _is_called_a_model(path)):
                    yield path
                continue
            if path.resolve() == self.out:
                continue
            parts = _parts(path, self.read) if (source := _is_source(path)) else None
            if source and parts is None:
                yield path
                continue
            try:
                inside = sorted(path.iterdir(), key=natural_order, reverse=True)
            except OSError as error:
                raise unreadable(path, error) from error
            inside = [p for p in inside if not p.name.startswith(".")]
            if parts is not None:
                yield from parts
                files = [p for p in inside if p.is_file() and p not in parts and _is_called_a_model(p)]
                self.passed_over.forms += reversed(files)
                inside = [p for p in inside if p.is_dir()]
            left += inside


def _lies_in(path: Path, out: Path) -> bool:
    real = Path(os.path.realpath(path))  # ``resolve`` raises where a link leads to itself
    return out in (real, *real.parents)


def _glob(pattern: Path) -> Iterator[Path]:
    """What a pattern matches. ``**`` goes through no link: two that lead back have no end (glob follows them)."""
    parts = pattern.parts
    at = parts.index("**") if "**" in parts else len(parts)
    tops = glob.glob(str(Path(*parts[:at])))  # noqa: PTH207 (a Path cannot glob from anywhere)
    rest = parts[at + 1 :]
    for top in tops if at < len(parts) else ():
        for folder, folders, files in os.walk(top):
            folders[:] = [f for f in folders if not f.startswith(".")]
            if rest:
                yield from _glob(Path(glob.escape(folder), *rest))
            else:
                yield from (Path(folder, *f) for f in ((), *((n,) for n in files if not n.startswith("."))))
    if at == len(parts):
        yield from map(Path, tops)


def _is_list(path: Path) -> bool:
    """Whether a file is a list of sources.

    That is text whose lines could be paths, one of which at least is there or ends as a file's name does. Any other
    ``.txt`` is read by its content, as every file is.
    """
    if path.suffix != ".txt" or not path.is_file():
        return False
    try:
        if recognise_path(Fetched(path)).key != _TEXT:
            return False
    except SourceError:  # it cannot be read: its reader says why
        return False
    lines = list(islice(_lines(path), _LINES_LOOKED_AT))
    return not lines or any(map(_stands_for_something, lines)) or all(map(_looks_like_path, lines))


def _stands_for_something(line: str) -> bool:
    try:
        return remote(Path(line)) is not None or Path(line).exists() or next(_glob(Path(line)), None) is not None
    except (OSError, ValueError):  # what cannot be a path
        return False


def _looks_like_path(line: str) -> bool:
    return _FILE_NAME.search(line) is not None or bool(re.fullmatch(r"\S*[/\\]\S*", line))


def _lines(path: Path) -> Iterator[str]:
    try:
        if path.stat().st_size > MAX_LIST:
            raise ValueError(f"it has more than {MAX_LIST} bytes")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise UsageError(
            f"{path} must be a list of paths", why=str(error), fix="write one path a line, in UTF-8"
        ) from error
    for line in text.splitlines():
        if line.strip() and not line.lstrip().startswith("#"):
            yield line.strip()


def _parts(folder: Path, read: ReadOptions) -> list[Path] | None:
    """The files of a folder that has a policy in each, under the file's name; None where the folder is one source.

    That is a run's, which has a folder of a policy's name too, or keeps its policies elsewhere; and any whose step was
    asked for.
    """
    found = recognise_path(Fetched(folder))
    if found.members is None or read.step is not None:
        return None
    members = found.members(folder, read)
    paths = [m.path for m in members if m.path.is_file() and m.path.parent == folder and m.path.stem == m.name]
    apart = len(paths) == len(members) and not any((folder / str(m.name)).is_dir() for m in members)
    return sorted(paths, key=natural_order) if apart else None


def _is_called_a_model(path: Path) -> bool:
    return path.suffix.lower() in _MODELS and path.name not in _COMPANIONS


def _is_source(path: Path) -> bool:
    try:
        found = recognise_path(Fetched(path))
    except SourceError:
        return False
    return found.readable or found is BUNDLE or found.key in _TELLING
