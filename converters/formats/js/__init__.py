"""JavaScript: one ES module that needs no runtime, for browsers and Node."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import defer_imports
from export_model.converters.formats.programs import program_format

if TYPE_CHECKING:
    from export_model.converters.formats.js import writer as _writer
else:
    (_writer,) = defer_imports(__name__, "writer")

FORMATS = (program_format("js", "an ES module", ".mjs", _writer.write, runtime="node"),)
