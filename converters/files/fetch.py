"""What was given: a path, and the bytes of its files, each read from disk once."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import os
import re
import stat
from collections.abc import Iterable
from pathlib import Path, PurePath
from typing import BinaryIO

from export_model.signatures.digest import sha256_hex, sha256_of_stream
from export_model.signatures.errors import DamagedFileError, SourceError

#: Protobuf's own limit; files of other formats that are one have the same.
MAX_BYTES = (2 << 30) - 1
#: Weights that lie beside a model, all together; no policy comes near it.
MAX_WEIGHTS = 16 << 30
#: Bytes from which on a file is asked for holes (fewer zeros are read at no cost), and how many are looked at.
_LARGE_HOLE, _MOST_HOLES = 1 << 28, 1 << 16
#: What has become a pipe since it was looked at is not waited for.
_FLAGS = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
#: Folders of huggingface_hub's cache, in that of a repository: a folder for each revision, and the files of all.
_SNAPSHOTS, _BLOBS = "snapshots", "blobs"
#: As a path keeps an address: with one slash of the two.
_ADDRESS = re.compile("(https?|ftps?|s3|gs|gcs|hf|memory|ssh|git)://?")
#: Addresses of these are fetched where fsspec is installed (exporter/remote).
FETCHED = ("http", "https", "s3", "gs", "gcs", "hf", "memory")
#: Where a # ends a name.
_WEB = ("http", "https")
#: A name there may have any sign, and nobody signs in by it.
_WITHOUT_SECRETS = ("hf", "memory")


class Fetched:
    """A path that was given. What a reader asks of it is kept for those that ask again: recognition, hashing."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._read: dict[Path, bytes] = {}

    @property
    def data(self) -> bytes:
        """The bytes of the file itself. Raises what ``read_bytes`` raises."""
        return self.bytes_of(self.path)

    def bytes_of(self, file: Path, *, empty: bool = False) -> bytes:
        """The bytes of a file that belongs to it. Raises what ``read_bytes`` raises."""
        if file not in self._read:
            self._read[file] = read_bytes(file, empty=empty)
        return self._read[file]

    def inside(self, path: Path) -> Fetched:
        """A path that belongs to it, given in its place."""
        other = Fetched(path)
        other._read = self._read
        return other

    def digest(self, files: Iterable[Path]) -> str:
        """The sha256 of a single file, or of the hashes of several in the order of their names.

        Raises SourceError for what ``open_regular_file`` refuses, and where all together are larger than weights may
        be.
        """
        left, hashes = MAX_WEIGHTS, []
        for each in sorted(set(files)):
            if each in self._read:
                hashes.append(sha256_hex(self._read[each]))
                continue
            with open_regular_file(each, left) as file:
                left -= os.fstat(file.fileno()).st_size
                hashes.append(sha256_of_stream(file))
        return hashes[0] if len(hashes) == 1 else sha256_hex("\n".join(hashes).encode())


def read_bytes(path: Path, *, empty: bool = False, most: int = MAX_BYTES) -> bytes:
    """The file's bytes, ``most`` of them at most.

    Raises SourceError where it is missing, a folder, unreadable or larger, DamagedFileError where it is empty, unless
    it may be (``empty``).
    """
    with open_regular_file(path, most) as file:
        try:
            data = file.read(os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise unreadable(path, error) from error
    if not data and not empty:
        raise DamagedFileError("the file is empty", where=str(path), fix="copy or download it again")
    return data


def open_regular_file(path: Path, most: int = MAX_BYTES) -> BinaryIO:
    """Open a regular file for reading: not a pipe, device, folder, symlink loop or mostly sparse file.

    Raises SourceError, too where it has more than ``most`` bytes.
    """
    try:
        _check_kind(path, path.stat().st_mode)  # a device may do something when it is opened
        file = os.fdopen(os.open(path, _FLAGS), "rb")
    except FileNotFoundError as error:
        raise _missing(path) from error
    except OSError as error:
        raise unreadable(path, error) from error
    except ValueError as error:  # a null character in the path
        raise SourceError("cannot be a path", where=repr(str(path)), why=str(error), fix="check the path") from error
    with contextlib.ExitStack() as refused:
        refused.enter_context(file)
        status = os.fstat(file.fileno())
        _check_kind(path, status.st_mode)  # what is there now
        if status.st_size > most:
            raise SourceError(
                f"has {status.st_size} bytes, and no more than {most} are read",
                where=str(path),
                fix="give the policy alone; it has some hundred kilobytes, settings a few",
            )
        if is_hole(file.fileno(), status.st_size):
            raise SourceError(
                f"is said to have {status.st_size} bytes, most of which were never written",
                where=str(path),
                why="it is a hole, as a copy or a download leaves one that was cut off",
                fix="copy or download it again; if it is whole, give what cp --sparse=never makes of it",
            )
        refused.pop_all()  # it stays open
    return file


def inside(folder: Path, name: str) -> Path | None:
    """The file that ``name`` says, its links followed; None where that lies elsewhere than in ``folder``.

    The snapshots of huggingface_hub's cache are links to files named by their hashes, in ``blobs`` beside them: these
    belong to the folder, where the name itself says nothing else.
    """
    said = PurePath(name)
    try:
        root = folder.resolve()
        place = (root / said).resolve()
    except (OSError, RuntimeError, ValueError):  # a circle of links (RuntimeError before Python 3.13), a null character
        return None
    if place.is_relative_to(root):
        return place
    if said.anchor or ".." in said.parts:
        return None
    return place if place.parent in [p.parent / _BLOBS for p in root.parents if p.name == _SNAPSHOTS] else None


def is_hole(descriptor: int, size: int) -> bool:
    """Whether most of a large file was never written (where the system says so): any size costs nothing then."""
    if size < _LARGE_HOLE or not hasattr(os, "SEEK_DATA"):
        return False
    at = written = 0
    try:
        for _ in range(_MOST_HOLES):
            at = os.lseek(descriptor, at, os.SEEK_DATA)
            end = os.lseek(descriptor, at, os.SEEK_HOLE)
            written += end - at
            at = end
            if 2 * written >= size:
                return False
        return False
    except OSError as error:  # ENXIO: no data from there on; another: the file system does not say
        return error.errno == errno.ENXIO
    finally:
        os.lseek(descriptor, 0, os.SEEK_SET)


def _check_kind(path: Path, mode: int) -> None:
    if stat.S_ISDIR(mode):
        raise SourceError(
            "is a folder", where=str(path), why="a single model file is expected", fix="give a file in it"
        )
    if not stat.S_ISREG(mode):
        raise SourceError("is a pipe or a device", where=str(path), fix="copy it to a file first, and give that")


def unreadable(path: Path, error: OSError) -> SourceError:
    """What the system refused."""
    return SourceError("cannot be read", where=str(path), why=error.strerror, fix="check the path and its permissions")


def _missing(path: Path) -> SourceError:
    """There is no such file; an address is none."""
    address = address_of(path)
    if address is None:
        return SourceError("no such file", where=str(path), fix=neighbours(path))
    fix = "download it (the raw file, not the page that shows it), and give the file"
    known = address.partition("://")[0] in FETCHED
    return SourceError(
        "is an address, not a file",
        where=path_text(path),
        why=f"only {', '.join(FETCHED)} are fetched" if fetches() else "nothing is fetched from the network",
        fix=f"{fix}; or pip install 'export-model[remote]'" if known and not fetches() else fix,
    )


def address_of(path: Path) -> str | None:
    """The address that a path is, which keeps one slash of its two; None where it is none."""
    scheme = _ADDRESS.match(path.as_posix())
    return None if scheme is None else f"{scheme[1]}://{path.as_posix()[scheme.end() :]}"


def path_text(path: Path | str) -> str:
    """A path as it is told and written down: of an address no user, password or query, which may be a signature."""
    address = address_of(Path(path))
    if address is None:
        return str(path)
    scheme, _, rest = address.partition("://")
    if scheme in _WITHOUT_SECRETS:
        return address
    place, slash, inside = re.split(r"[?#]" if scheme in _WEB else r"\?", rest, maxsplit=1)[0].partition("/")
    return f"{scheme}://{place.rpartition('@')[2]}{slash}{inside}"


def fetches() -> bool:
    """Whether what fetches addresses is installed."""
    try:
        return importlib.util.find_spec("fsspec") is not None
    except ValueError:  # something put it into sys.modules without a spec
        return False


def neighbours(path: Path) -> str:
    """What to do where nothing lies at a path: the name of that kind that is nearest to its own in that folder."""
    try:
        names = sorted(p.name for p in path.parent.iterdir())
    except OSError:  # there is no such folder, or it may not be listed
        names = []
    import difflib

    if path.suffix:  # x.toml is near h.html by its ending alone
        alike = [n for n in names if _one_edit(path.suffix.lower(), Path(n).suffix.lower())]
        stems = difflib.get_close_matches(path.stem, {Path(n).stem for n in alike}, n=len(names) or 1)
        names = [n for n in alike if Path(n).stem in stems]
    close = difflib.get_close_matches(path.name, names, n=1)
    return f"did you mean {path.parent / close[0]}?" if close else "check the path"


def _one_edit(word: str, other: str) -> bool:
    """Return whether a letter that is left out, added or another makes one word the other."""
    same = next((i for i, (a, b) in enumerate(zip(word, other, strict=False)) if a != b), min(len(word), len(other)))
    rest, its = word[same:], other[same:]
    return rest[1:] == its[1:] or rest == its[1:] or rest[1:] == its
