"""SavedModels: of TensorFlow 1 and 2 read, and written with ``serving_default``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.files.file_probe import Content
    from export_model.converters.formats.saved_model import artifact as _artifact
    from export_model.converters.formats.saved_model import source as _source
    from export_model.converters.formats.saved_model import vetted as _vetted
    from export_model.converters.formats.saved_model import writer as _writer
else:
    _artifact, _source, _vetted, _writer = defer_imports(__name__, "artifact", "source", "vetted", "writer")


def _sniff(file: Content) -> bool:
    """It begins with its version (1), which is 1, and graphs (2); an ONNX model has fields 7 and 8 beside them."""
    if [field[:2] for field in file.fields[:2]] != [(1, 0), (2, 2)] or file.numbers & {(7, 2), (8, 2)}:
        return False
    return bytes(file.fields[0][2]) == b"\x01"


FORMATS = (
    Format(
        key="saved_model",
        aliases=("saved-model", "savedmodel"),
        label="a SavedModel",
        sniff=_sniff,
        marker="saved_model.pb",
        read=_source.read,
        write=_writer.write,
        main="saved_model",
        default=True,
        narrow=True,
        held=_source.embedded_contract,
        ports=_artifact.ports,
        vetted=_vetted.safe_copy,
        inner=_artifact.inner,
        graph=_artifact.graph,
        runtimes=("tensorflow", "tensorflow-python"),
        signatures=True,
    ),
)
