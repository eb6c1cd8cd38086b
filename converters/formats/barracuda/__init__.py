"""Barracuda's ``.nn`` models: read, and written (version 16) for Unity's ML-Agents of 0.7 to release 20."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.files.file_probe import Content
    from export_model.converters.formats.barracuda import source as _source
    from export_model.converters.formats.barracuda import writer as _writer
else:
    _source, _writer = defer_imports(__name__, "source", "writer")


#: Versions of the format, an int64 at its beginning.
_VERSIONS = range(15, 21)


def _sniff(file: Content) -> bool:
    return len(file.data) >= 8 and struct.unpack_from("<q", file.data)[0] in _VERSIONS


FORMATS = (
    Format(
        key="nn",
        label="a Barracuda .nn model",
        sniff=_sniff,
        read=_source.read,
        write=_writer.write,
        main="{name}.nn",
        held=_writer.embedded_contract,
        runtimes=("numpy",),
        elsewhere="Unity",
        consumer="barracuda-1.0",
    ),
)
