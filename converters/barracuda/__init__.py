"""Barracuda's ``.nn`` models."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from converters.format import Format

if TYPE_CHECKING:
    from converters.content import Content
    from converters.fetch import Fetched
    from converters.source import ReadOptions, SourceModel

#: Versions of the format, an int64 at its beginning.
_VERSIONS = range(15, 21)


def _sniff(file: Content) -> bool:
    return len(file.data) >= 8 and struct.unpack_from("<q", file.data)[0] in _VERSIONS


def _read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    from converters.barracuda.source import read

    return read(given)


FORMATS = (Format(key="nn", label="a Barracuda .nn model", sniff=_sniff, read=_read),)
