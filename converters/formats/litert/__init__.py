"""LiteRT (TensorFlow Lite): read, and written with its signatures, for phones, boards and pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from converters.formats.litert import artifact as _artifact
    from converters.formats.litert import source as _source
    from converters.formats.litert import writer as _writer
else:
    _artifact, _source, _writer = defer_imports(__name__, "artifact", "source", "writer")

FORMATS = (
    Format(
        key="litert",
        label="a LiteRT (TensorFlow Lite) model",
        sniff=lambda file: file.head[4:8] == b"TFL3",
        read=_source.read,
        write=_writer.write,
        main="{name}.tflite",
        narrow=True,
        fixed=True,
        held=_artifact.held,
        ports=_artifact.ports,
        vetted=_artifact.vetted,
        inner=_artifact.inner,
        runtimes=("litert", "litert-plain", "litert-web"),
        signatures=True,
        dtypes=frozenset(("float32", "int32", "bool", "uint8")),
    ),
)
