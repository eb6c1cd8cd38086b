"""Reading untrusted ZIP archives: entries that every reader would find alike, and no more bytes than were asked for.

Names that stand there twice mean one file to us and another to the program that is meant; a link means a file
elsewhere; bzip2 and LZMA unfold some bytes to gigabytes in one step, which zipfile does not bound.
"""

from __future__ import annotations

import io
import stat
import struct
import zipfile
import zlib

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 1 << 0
#: What zipfile raises for a damaged or encrypted archive, and the functions here for one that they do not take.
ZIP_ERRORS = (
    *(zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError, NotImplementedError, RuntimeError),
    *(struct.error, zlib.error),
)


def open_archive(data: bytes) -> zipfile.ZipFile:
    """An archive whose entries were looked at. Raises one of ZIP_ERRORS."""
    archive = zipfile.ZipFile(io.BytesIO(data))
    seen: set[str] = set()
    for entry in archive.infolist():
        name = entry.filename[:80]
        if entry.filename in seen:
            raise zipfile.BadZipFile(f"it has {name!r} twice")
        if stat.S_ISLNK(entry.external_attr >> 16):
            raise zipfile.BadZipFile(f"{name!r} is a link")
        if entry.flag_bits & _ENCRYPTED:
            raise zipfile.BadZipFile(f"{name!r} is encrypted")
        if entry.compress_type not in _METHODS:
            raise zipfile.BadZipFile(f"{name!r} is packed by another method than deflate")
        seen.add(entry.filename)
    return archive


def entry_of(archive: zipfile.ZipFile, name: str, most: int) -> bytes:
    """What an entry unfolds to. Raises one of ZIP_ERRORS, too where that is more than ``most`` bytes."""
    entry = archive.getinfo(name)
    if entry.file_size > most:
        raise zipfile.BadZipFile(f"{name[:80]!r} unfolds to {entry.file_size} bytes, more than {most}")
    with archive.open(entry) as stream:
        return stream.read(entry.file_size)
