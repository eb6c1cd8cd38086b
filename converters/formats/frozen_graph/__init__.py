"""Frozen TensorFlow graphs (GraphDef): read from ``.bytes`` and ``.pb``, and written."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.formats.frozen_graph import artifact as _artifact
    from export_model.converters.formats.frozen_graph import source as _source
    from export_model.converters.formats.frozen_graph import writer as _writer
else:
    _artifact, _source, _writer = defer_imports(__name__, "artifact", "source", "writer")

FORMATS = (
    Format(
        key="bytes",
        aliases=("pb", "frozen_graph"),
        label="a TensorFlow graph (GraphDef)",
        sniff=lambda file: file.is_graph,
        read=_source.read,
        write=_writer.write,
        main="{name}.bytes",
        default=True,
        narrow=True,
        ports=_artifact.ports,
        vetted=_artifact.safe_copy,
        inner=_artifact.inner,
        unity=True,
        graph=_artifact.graph,
        runtimes=("numpy", "tensorflow", "tensorflow-python", "tf1.4", "tf1.7"),
    ),
)
