"""The web model of TensorFlow.js before 1.0: a GraphDef whose constants' values lie in shards beside it.

``tensorflowjs_model.pb`` is a frozen graph, ``weights_manifest.json`` the list that is ``weightsManifest`` in a
model.json since 1.0, its shards (``group1-shard1of1``) hold the values. All value fields of the graph's constants were
cleared, whatever their dtype (tensorflowjs 0.1 to 0.8, tf_saved_model_conversion.py, extract_weights), so by itself the
graph reads as zeros.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import Fetched, read_bytes
from export_model.converters.files.file_probe import Content, json_in
from export_model.converters.formats.frozen_graph.emptied import lacks_values
from export_model.converters.formats.frozen_graph.reader import from_graph_def
from export_model.converters.formats.frozen_graph.tensors import from_array
from export_model.converters.formats.source import OriginalRun, ReadOptions, SourceModel
from export_model.converters.formats.tfjs.reader import reshape_constant, weights_of
from export_model.signatures.errors import DamagedFileError, ExportModelError, SourceError

GRAPH, MANIFEST = "tensorflowjs_model.pb", "weights_manifest.json"
_FIX = f"give the folder with the graph ({GRAPH}), {MANIFEST} and all the shards that it names"
_MAX_FILES = 16


def is_part(path: Path) -> bool:
    """Whether a path is the graph, the manifest or a shard of such a model."""
    manifest = path.with_name(MANIFEST) if path.name else path
    if path.is_dir() or not (path.is_file() and manifest.is_file()):
        return False
    if path == manifest:
        return True
    try:
        return path.name in _shard_names(_manifest(read_bytes(manifest))) or _is_graph(path)
    except ExportModelError:  # of a manifest that cannot be read nothing is a part but itself
        return False


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The frozen graph, its constants' values from the shards. Raises DamagedFileError, SourceError, GraphError."""
    folder = given.path if given.path.is_dir() else given.path.parent
    manifest = _manifest(given.bytes_of(folder / MANIFEST))
    file = given.path if given.path.is_file() and _is_graph(given.path) else _graph_in(folder)
    values, shards = weights_of(manifest, given, folder)
    detached = Detached()
    definition = schema.parse(schema.GraphDef, given.bytes_of(file), "TensorFlow graph", detached)
    schema.check_nodes(len(definition.node))
    for node in definition.node:
        if node.op == "Const":
            _fill(node, values, detached)
    files = (file, folder / MANIFEST, *shards)
    original = OriginalRun("tensorflow", file, definition=definition, detached=detached)
    graph = from_graph_def(definition, detached)
    return [SourceModel(graph, files, name=folder.resolve().name or None, original=original)]


def _fill(node: Any, values: dict[str, np.ndarray], detached: Detached) -> None:
    """Give a constant its value in its own dtype: the converter narrowed int64 and float64 in the shards."""
    if node.name not in values:
        raise _damaged_error(f"the constant {node.name!r} has no values", f"{MANIFEST} does not name it")
    tensor = node.attr["value"].tensor
    dims = tuple(d.size for d in tensor.tensor_shape.dim)
    value = reshape_constant(values[node.name], dims).astype(schema.dtype_of(tensor.dtype), copy=False)
    tensor.CopyFrom(from_array(value, detached))


def _manifest(data: bytes) -> list[dict[str, Any]]:
    """The groups of weights. Raises DamagedFileError."""
    try:
        groups = json_in(data)
    except (ValueError, RecursionError) as error:
        raise _damaged_error(f"{MANIFEST} is not JSON", str(error)[:200]) from error
    if not isinstance(groups, list) or not all(
        isinstance(g, dict) and isinstance(g.get("paths"), list) for g in groups
    ):
        raise _damaged_error(f"{MANIFEST} is not a list of groups of weights")
    return groups


def _shard_names(groups: Sequence[dict[str, Any]]) -> list[Any]:
    return [name for group in groups for name in group["paths"]]


def _is_graph(path: Path) -> bool:
    """Whether a file is a GraphDef without its values. Raises SourceError, DamagedFileError."""
    data = read_bytes(path)
    return Content(data).is_graph and lacks_values(schema.parse(schema.GraphDef, data, "TensorFlow graph", Detached()))


def _graph_in(folder: Path) -> Path:
    """The graph in a folder: by its usual name, else the only one without its values. Raises SourceError."""
    if (folder / GRAPH).is_file():
        return folder / GRAPH
    graphs = [p for p in sorted(folder.glob("*.pb"))[:_MAX_FILES] if p.is_file() and _is_graph(p)]
    if len(graphs) != 1:
        raise SourceError(
            f"{GRAPH} is missing" if not graphs else f"holds {len(graphs)} graphs",
            where=str(folder),
            why=f"{MANIFEST} is one half of a web model of TensorFlow.js before 1.0",
            fix=_FIX if not graphs else f"give one of them: {json.dumps([p.name for p in graphs])}",
        )
    return graphs[0]


def _damaged_error(what: str, why: str | None = None) -> DamagedFileError:
    return DamagedFileError(what, why=why, fix=_FIX)
