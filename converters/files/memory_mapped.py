"""A file of ours as a view of the file itself, for an artefact that is looked at and not kept.

A large graph is looked into while its source is held: read, the two would take twice its weights. What was looked at
leaves the process's memory when it is let go, and is read again from the file where somebody looks once more. A source
is read, and not mapped: whatever happens to its file meanwhile changes nothing.
"""

from __future__ import annotations

import mmap
import os
from pathlib import Path

from export_model.converters.files.external_data import LARGE_FILE
from export_model.converters.files.fetch import MAX_BYTES, open_regular_file, read_bytes

#: Of a system that cannot be told to forget pages, they leave with the view.
_FORGET: int | None = getattr(mmap, "MADV_DONTNEED", None)


class Mapped:
    """Views of files, by their paths; small ones are read."""

    def __init__(self) -> None:
        self._maps: list[mmap.mmap] = []

    def read(self, path: Path, *, most: int = MAX_BYTES) -> bytes | memoryview:
        """The content of a file. Raises SourceError, DamagedFileError as ``read_bytes`` does."""
        with open_regular_file(path, most) as file:
            if os.fstat(file.fileno()).st_size < LARGE_FILE:
                return read_bytes(path, most=most)
            try:
                made = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except OSError:  # a file system that maps nothing
                return read_bytes(path, most=most)
        self._maps.append(made)
        return memoryview(made)

    def let_go(self) -> None:
        """Give back the memory of what was looked at; the views stay."""
        if _FORGET is not None:
            for made in self._maps:
                made.madvise(_FORGET)
