"""What was given: a path, and the bytes of its files, each read from disk once."""

from __future__ import annotations

import importlib.util
import re
import stat
from collections.abc import Iterable
from pathlib import Path

from signatures.digest import sha256_hex, sha256_of_file
from signatures.errors import DamagedFileError, SourceError

#: Protobuf's own limit; files of other formats that are one have the same.
MAX_BYTES = (2 << 30) - 1
#: Weights that lie beside a model, all together; no policy comes near it.
MAX_WEIGHTS = 16 << 30
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
        """The sha256 of a single file, or of the hashes of several in the order of their names. Raises OSError."""
        hashes = [sha256_hex(self._read[f]) if f in self._read else sha256_of_file(f) for f in sorted(set(files))]
        return hashes[0] if len(hashes) == 1 else sha256_hex("\n".join(hashes).encode())


def read_bytes(path: Path, *, empty: bool = False, most: int = MAX_BYTES) -> bytes:
    """The file's bytes. Raises SourceError where it is missing, a folder or unreadable, DamagedFileError where it is
    empty, unless it may be; ``most`` bytes are read.
    """
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise SourceError(
                "is a folder", where=str(path), why="a single model file is expected", fix="give a file in it"
            )
        if not stat.S_ISREG(status.st_mode):
            raise SourceError("is a pipe or a device", where=str(path), fix="copy it to a file first, and give that")
        if status.st_size > most:
            raise SourceError(
                f"has {status.st_size} bytes, and no more than {most} are read",
                where=str(path),
                fix="give the policy alone; it has some hundred kilobytes, settings a few",
            )
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise _missing(path) from error
    except OSError as error:
        raise unreadable(path, error) from error
    except ValueError as error:  # a null character in the path
        raise SourceError("is no path", where=repr(str(path)), why=str(error), fix="check the path") from error
    if not data and not empty:
        raise DamagedFileError("the file is empty", where=str(path), fix="copy or download it again")
    return data


def unreadable(path: Path, error: OSError) -> SourceError:
    """What the system refused."""
    return SourceError("cannot be read", where=str(path), why=error.strerror, fix="check the path and its permissions")


def _missing(path: Path) -> SourceError:
    """There is no such file; an address is none."""
    address = address_of(path)
    if address is None:
        return SourceError("no such file", where=str(path), fix=_neighbours(path))
    fix = "download it (the raw file, not the page that shows it), and give the file"
    known = address.partition("://")[0] in FETCHED
    return SourceError(
        "is an address, not a file",
        where=shown(path),
        why=f"only {', '.join(FETCHED)} are fetched" if fetches() else "nothing is fetched from the network",
        fix=f"{fix}; or pip install 'export-model[remote]'" if known and not fetches() else fix,
    )


def address_of(path: Path) -> str | None:
    """The address that a path is, which keeps one slash of its two; None where it is none."""
    scheme = _ADDRESS.match(path.as_posix())
    return None if scheme is None else f"{scheme[1]}://{path.as_posix()[scheme.end() :]}"


def shown(path: Path | str) -> str:
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


def _neighbours(path: Path) -> str:
    try:
        names = sorted(p.name for p in path.parent.iterdir())
    except OSError:  # there is no such folder, or it may not be listed
        names = []
    import difflib

    close = difflib.get_close_matches(path.name, names, n=1)
    return f"did you mean {path.parent / close[0]}?" if close else "check the path"
