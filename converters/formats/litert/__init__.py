"""LiteRT (TensorFlow Lite): read, and written with its signatures, for phones, boards and pages."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Code, Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.formats.litert import artifact as _artifact
    from export_model.converters.formats.litert import source as _source
    from export_model.converters.formats.litert import writer as _writer
else:
    _artifact, _source, _writer = defer_imports(__name__, "artifact", "source", "writer")

_PYTHON = """\
# pip install ai-edge-litert; Kotlin, Swift and pages call the same signature, by the same names
import numpy as np
from ai_edge_litert.interpreter import Interpreter

policy = Interpreter($path).get_signature_runner("serving_default")
$play"""

FORMATS = (
    Format(
        key="litert",
        aliases=("tflite",),
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
        snippets=(Code("litert", "Python, LiteRT", "python", _PYTHON),),
    ),
)
