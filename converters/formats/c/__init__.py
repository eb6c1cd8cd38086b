"""C: one header that needs no runtime, for microcontrollers, engines and robots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import defer_imports
from export_model.converters.formats.programs import program_format

if TYPE_CHECKING:
    from export_model.converters.formats.c import writer as _writer
else:
    (_writer,) = defer_imports(__name__, "writer")

FORMATS = (program_format("c", "a C header", ".h", _writer.write, runtime="c"),)
