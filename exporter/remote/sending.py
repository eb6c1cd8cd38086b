"""Bundles by address: made whole here, sent file by file, policy.json last, so that one that has it is whole."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from export_model.converters.files.fetch import address_of, fetches, path_text
from export_model.converters.files.folders import scratch_folder
from export_model.converters.formats.bundle import bundle
from export_model.exporter.remote.filesystem import asking, filesystem, is_http, remote
from export_model.signatures.contract import POLICY
from export_model.signatures.errors import BundleError, UsageError

#: Puts a staged bundle in its place, and says where that is.
Put = Callable[[Path, str], Path]

#: Lies beside the files of a bundle while they are sent; where it is left, sending was cut short.
_SENDING = "policy.sending"


@contextlib.contextmanager
def landing(out: Path) -> Iterator[tuple[Path, Put]]:
    """A folder to stage a bundle in, and what puts it into ``out``, a folder or an address. Raises BundleError."""
    address = remote(out)
    if address is None:
        yield out, lambda staged, name: _put(staged, out / name)
        return
    with scratch_folder() as folder:
        here = Path(folder)
        yield here, lambda staged, name: _send(_put(staged, here / name), f"{address}/{name}")


def check_free(out: Path, name: str) -> None:
    """Raise BundleError where something in the way of a bundle is none."""
    address = remote(out)
    if address is None:
        bundle.check_replaceable(out / name)
    else:
        _there(f"{address}/{name}")


def check_sendable(out: Path) -> None:
    """Raise UsageError where nothing can be written to an address."""
    address = address_of(out)
    if address is not None and (remote(out) is None or is_http(address)):
        raise UsageError(
            "nothing can be written there",
            where=path_text(address),
            why=None if fetches() else "that needs fsspec: pip install 'export-model[remote]'",
            fix="give a folder, or an address of s3, gs or hf",
        )


def _put(staged: Path, place: Path) -> Path:
    bundle.put_in_place(staged, place)
    return place


def _there(address: str) -> set[str]:
    """The files of the bundle at an address, by their paths in it. Raises BundleError where they are another's."""
    system, root = filesystem(address)
    with asking(address, writes=True):
        system.invalidate_cache()
        found = {path[len(root) :].lstrip("/") for path in system.find(root)} if system.exists(root) else set()
    if found and POLICY not in found and _SENDING not in found:
        raise BundleError(
            "already exists and is not a bundle",
            where=path_text(address),
            why=f"it has no {POLICY}, so it is not this tool's to replace",
            fix="move it, or choose another address with -o or another --name",
        )
    return found


def _send(folder: Path, address: str) -> Path:
    before = _there(address)
    system, root = filesystem(address)
    files = {p.relative_to(folder).as_posix(): p for p in sorted(folder.rglob("*")) if p.is_file()}
    last = files.pop(POLICY)
    with asking(address, writes=True):
        system.makedirs(root, exist_ok=True)
        system.pipe_file(f"{root}/{_SENDING}", f"{POLICY} comes last\n".encode())
        if POLICY in before:
            system.rm_file(f"{root}/{POLICY}")
        for name, file in files.items():
            system.makedirs(f"{root}/{name}".rpartition("/")[0], exist_ok=True)
            system.put_file(str(file), f"{root}/{name}")
        for name in sorted(before - files.keys() - {POLICY, _SENDING}):
            system.rm_file(f"{root}/{name}")
        system.put_file(str(last), f"{root}/{POLICY}")
        system.rm_file(f"{root}/{_SENDING}")
    return Path(address)
