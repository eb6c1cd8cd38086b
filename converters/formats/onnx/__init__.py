"""ONNX models: read from every exporter that policies come from, and written."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.files.file_probe import Content
    from export_model.converters.formats.onnx import artifact as _artifact
    from export_model.converters.formats.onnx import source as _source
    from export_model.converters.formats.onnx import vetted as _vetted
    from export_model.converters.formats.onnx import writer as _writer
else:
    _artifact, _source, _vetted, _writer = defer_imports(__name__, "artifact", "source", "vetted", "writer")


def _sniff(file: Content) -> bool:
    """ModelProto begins with its version (1), and has a graph (7) or opsets (8)."""
    return bool(file.fields) and file.fields[0][:2] == (1, 0) and bool(file.numbers & {(7, 2), (8, 2)})


FORMATS = (
    Format(
        key="onnx",
        label="an ONNX model",
        sniff=_sniff,
        read=_source.read,
        takes=frozenset(("repair",)),
        write=_writer.write,
        main="{name}.onnx",
        beside="{name}.onnx.data",
        default=True,
        narrow=True,
        fixed=True,
        held=_artifact.embedded_contract,
        misstatement=_artifact.misstatement,
        ports=_artifact.ports,
        vetted=_vetted.safe_copy,
        inner=_artifact.inner,
        unity=True,
        origins=_artifact.origins,
        runtimes=("onnxruntime", "onnxruntime-web", "onnxruntime-web@chromium", "openvino"),
    ),
)
