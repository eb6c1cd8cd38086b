"""A SavedModel that anyone may have made, as far as TensorFlow may be given it.

It is read from its protos, its functions written out, its variables made constants, as any source is; what TensorFlow
then loads is a SavedModel of that graph with the signatures asked for: no functions, no variables, no initialiser.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.files.fetch import read_bytes
from export_model.converters.formats.saved_model.reader import read_saved_model
from export_model.converters.formats.saved_model.signature import TensorInfo
from export_model.converters.formats.saved_model.source import FILE, frozen_model, values_beside
from export_model.converters.formats.saved_model.variables import files_of
from export_model.converters.formats.saved_model.writer import METHOD
from export_model.converters.formats.subgraph import subgraph


def safe_copy(path: Path, wanted: Sequence[str], folder: Path) -> Path:
    """A copy in ``folder`` of a SavedModel's folder with the signatures ``wanted``, as far as it has them.

    Raises UnsupportedOpError where an op does more than compute, NotAPolicyError, DamagedFileError, GraphError.
    """
    data = read_bytes(path / FILE)
    detached = Detached()
    known = read_saved_model(data, None, detached).keys
    message = schema.SavedModel(saved_model_schema_version=1)
    meta = message.meta_graphs.add()
    meta.meta_info_def.tags.append("serve")
    placed: dict[str, Any] = {}
    values = values_beside(path)
    for key in (k for k in wanted if k in known):
        model = frozen_model(read_saved_model(data, key, detached), values)
        signature = model.signature
        tensors = [t.name for t in (*signature.inputs.values(), *signature.outputs.values())]
        part = subgraph(model.definition, tensors)
        # The functions of two signatures may have nodes of the same names.
        prefix = f"{key}/" if any(placed.get(n.name, n) != n for n in part.node) else ""
        meta.graph_def.versions.CopyFrom(part.versions)
        for node in _prefix_nodes(part, prefix):
            if node.name not in placed:
                placed[node.name] = node
                meta.graph_def.node.append(node)
        entry = meta.signature_def[key]
        entry.method_name = METHOD
        for side, given in ((entry.inputs, signature.inputs), (entry.outputs, signature.outputs)):
            for name, tensor in given.items():
                _fill(side[name], replace(tensor, name=f"{prefix}{tensor.name}"))
    copy = folder / (path.resolve().name or "model")
    copy.mkdir()
    for relative, content in files_of(message, detached, str(folder)).items():
        (copy / relative).parent.mkdir(exist_ok=True)
        content.write(copy / relative)
    return copy


def _prefix_nodes(part: Any, prefix: str) -> list[Any]:
    """The nodes of a graph under names with ``prefix`` before them."""
    nodes = []
    for node in part.node:
        copy = schema.NodeDef()
        copy.CopyFrom(node)
        copy.name = f"{prefix}{node.name}"
        for i, reference in enumerate(node.input):
            control = "^" if reference.startswith("^") else ""
            copy.input[i] = f"{control}{prefix}{reference.removeprefix('^')}"
        nodes.append(copy)
    return nodes


def _fill(info: Any, tensor: TensorInfo) -> None:
    """A TensorInfo of a signature's entry."""
    info.name = tensor.name if ":" in tensor.name else f"{tensor.name}:0"
    if tensor.dtype is not None:
        info.dtype = schema.dtype_number(tensor.dtype)
    if tensor.shape.dims is None:
        info.tensor_shape.unknown_rank = True
        return
    for size in tensor.shape.dims:
        info.tensor_shape.dim.add(size=-1 if size is None else size)
