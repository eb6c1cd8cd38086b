"""C#: one class that needs no runtime, for Unity on every platform, Godot and servers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from converters.formats.csharp import writer as _writer
    from converters.formats.programs import artifact as _artifact
    from converters.formats.programs import members as _members
else:
    (_writer,) = defer_imports(__name__, "writer")
    _artifact, _members = defer_imports("converters.formats.programs", "artifact", "members")

FORMATS = (
    Format(
        key="csharp",
        label="a C# class",
        write=_writer.write,
        main="{name}.cs",
        beside="{name}.weights.bin",
        narrow=True,
        held=_artifact.held,
        ports=_artifact.ports,
        vetted=_artifact.vetted,
        answers=_members.answers,
        runtimes=("csharp",),
        program=True,
    ),
)
