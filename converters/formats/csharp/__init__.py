"""C#: one class that needs no runtime, for Unity on every platform, Godot and servers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import defer_imports
from export_model.converters.formats.programs import program_format

if TYPE_CHECKING:
    from export_model.converters.formats.csharp import writer as _writer
else:
    (_writer,) = defer_imports(__name__, "writer")

FORMATS = (program_format("csharp", "a C# class", ".cs", _writer.write, runtime="csharp"),)
