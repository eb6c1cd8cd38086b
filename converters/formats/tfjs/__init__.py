"""TensorFlow.js models: graphs read from any converter, and written; layers models read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from export_model.converters.formats.format import Format, defer_imports

if TYPE_CHECKING:
    from export_model.converters.formats.tfjs import artifact as _artifact
    from export_model.converters.formats.tfjs import reader as _reader
    from export_model.converters.formats.tfjs import source as _source
    from export_model.converters.formats.tfjs import split_graph as _split_graph
    from export_model.converters.formats.tfjs import writer as _writer
else:
    _artifact, _reader, _source, _split_graph, _writer = defer_imports(
        __name__, "artifact", "reader", "source", "split_graph", "writer"
    )

FORMATS = (
    Format(
        key="tfjs",
        label="a TensorFlow.js model",
        sniff=lambda file: "modelTopology" in (file.json or {}),
        marker="model.json",
        at=lambda path: path.is_dir() and _reader.model_file(path).is_file(),
        read=_source.read,
        write=_writer.write,
        main="tfjs",
        default=True,
        narrow=True,
        held=_reader.embedded_contract,
        ports=_artifact.ports,
        vetted=_artifact.safe_copy,
        inner=_artifact.inner,
        runtimes=("tfjs-cpu", "tfjs-wasm", "tfjs-webgl", "tfjs-cpu@chromium", "tfjs-wasm@chromium"),
        predicts=True,
        dtypes=frozenset({"float32", "int32", "bool"}),
    ),
    Format(
        key="tfjs_split_graph",
        label="a TensorFlow.js model of before 1.0 (a graph and weights_manifest.json)",
        marker="weights_manifest.json",
        at=_split_graph.is_part,
        read=_split_graph.read,
    ),
)
