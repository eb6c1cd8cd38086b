"""What is fetched and kept (npm packages, old TensorFlow libraries): where it lies, and how it gets there whole.

Each time it is used it is proved to be what was known when this version was made, by the sha256 of every file that is
loaded. That is not computed again for a file that has not changed since it was found right: its size, its inode, and
the times of its last change, of which ``ctime`` is the system's own. A folder that a cache brought back, or somebody
wrote to, is read again. It is no help against who can write as the user: that one needs no part of ours.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from export_model.converters.formats.bundle.exchange import exchange, stage
from export_model.signatures.digest import sha256_hex
from export_model.signatures.errors import RuntimeUnavailableError

#: The file, in the folder, of what was found right: name → the hash and what told then that nothing has changed.
STAMP = ".export-model-checked.json"


def cache_folder() -> Path:
    """This program's folder in the user's cache, as each system has it; it need not exist."""
    return _root() / "export-model"


def _root() -> Path:
    platform: str = sys.platform  # as a plain string: type checkers drop the branches of other systems otherwise
    if platform == "win32":
        local = os.environ.get("LOCALAPPDATA")
        return Path(local) if local else Path.home() / "AppData" / "Local"
    if platform == "darwin":
        return Path.home() / "Library" / "Caches"
    xdg = Path(os.environ.get("XDG_CACHE_HOME", ""))
    # The XDG rules: a relative path there is invalid and is to be ignored.
    return xdg if xdg.is_absolute() else Path.home() / ".cache"


@contextlib.contextmanager
def built_beside(target: Path, is_whole: Callable[[Path], bool], what: str, fix: str) -> Iterator[Path]:
    """An empty folder to fill; at the end of the block it is put in the place of ``target``; ``what`` is installed.

    So ``target`` is whole whenever it exists: a run that is killed leaves nothing that a later run would take for an
    installation. A damaged ``target`` is replaced; a whole one that another process put there meanwhile is kept.
    Raises RuntimeUnavailableError where the system refuses something in the block; ``fix`` says what to do then.
    """
    try:
        with stage(target) as building:
            yield building
            if not is_whole(target):
                exchange(building, target)
    except OSError as error:
        raise RuntimeUnavailableError(
            f"{what} cannot be installed", where=str(target), why=str(error), fix=fix
        ) from error


def carried_out(command: Sequence[str], folder: Path | None = None) -> tuple[int, list[str]]:
    """(status, lines on stderr that are not blank) of a program that fetches, in ``folder`` or where we stand."""
    done = subprocess.run(
        command, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, encoding="utf-8", errors="replace"
    )
    return done.returncode, [line for line in done.stderr.splitlines() if line.strip()]


def check(folder: Path, known: Mapping[str, str], fix: str) -> None:
    """Hold the files of ``folder`` against ``known``, their sha256 by their names; what is not there is not loaded.

    Raises RuntimeUnavailableError that names the first which is another.
    """
    seen = _read(folder / STAMP)
    found: dict[str, list[object]] = {}
    for name, digest in known.items():
        path = folder / name
        try:
            state = path.stat()
            told: list[object] = [digest, state.st_size, state.st_ino, state.st_mtime_ns, state.st_ctime_ns]
            right = seen.get(name) == told or sha256_hex(path.read_bytes()) == digest
        except FileNotFoundError:
            continue
        except OSError as error:
            raise RuntimeUnavailableError("cannot be read", where=str(path), why=error.strerror, fix=fix) from error
        if not right:
            raise RuntimeUnavailableError(
                "is not the file that was installed",
                where=str(path),
                why="its sha256 is not the one that this version of export-model knows: it was changed, or cut off",
                fix=f"remove {folder}, then: {fix}",
            )
        found[name] = told
    if found != seen:
        _write(folder / STAMP, found)


def _read(path: Path) -> dict[str, list[object]]:
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _write(path: Path, content: Mapping[str, list[object]]) -> None:
    """Whole or not at all; a folder that cannot be written is read again each time."""
    beside = path.with_name(f"{path.name}.{os.getpid()}")
    with contextlib.suppress(OSError):
        beside.write_text(json.dumps(content), encoding="utf-8")
        beside.replace(path)
