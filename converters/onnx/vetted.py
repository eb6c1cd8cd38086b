"""An ONNX model that anyone may have made, as far as a runtime may be given it.

onnxruntime reads the files that a model names as its weights, in some releases from any folder, and loads what
custom ops need. The copy is one file: weights that lie beside the model are brought into it (from 2 GiB on, into one of
our own name beside it), others are refused, and so is every op that is not of ONNX or of the runtime itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from converters.detached import Detached
from converters.fetch import read_bytes
from converters.onnx.messages import files_of
from converters.onnx.proto import decoded, inside, load_external
from signatures.errors import UnsupportedOpError

#: Domains whose operators compute, of ONNX and of onnxruntime.
_DOMAINS = frozenset(("", "ai.onnx", "ai.onnx.ml", "com.microsoft", "com.ms.internal.nhwc"))
#: Operators of these that load something else.
_LOADING = frozenset(("EPContext", "PythonOp", "PythonOpGrad", "ExternalOp"))


def vetted(path: Path, wanted: Sequence[str], folder: Path) -> Path:
    """A copy in ``folder`` of the model in the file ``path``, with all its weights in it.

    Raises UnsupportedOpError where an op is of another domain, DamagedFileError where weights lie elsewhere.
    """
    copy = folder / path.name
    detached = Detached()
    for name, data in files_of(contained(path, detached), detached, path.name).items():
        data.write(folder / name)
    return copy


def contained(path: Path, detached: Detached | None = None) -> Any:
    """The ModelProto with the data of all its files, or ``detached`` with it. Raises what ``vetted`` raises."""
    model = decoded(read_bytes(path), detached)
    own = {(f.domain, f.name) for f in model.functions}
    parts = (model.graph, *model.functions)
    load_external(parts, path.parent, detached)
    for part in parts:
        for node in inside(part, "NodeProto"):
            known = node.domain in _DOMAINS and node.op_type not in _LOADING
            if not known and (node.domain, node.op_type) not in own:
                raise UnsupportedOpError(
                    f"the model has the custom operator {node.domain}::{node.op_type} (node {node.name!r})",
                    issues=[(node.name, node.op_type)],
                    why="a runtime would need a library for it; a model file is untrusted, and none is loaded for one",
                    fix="export the model with operators of ONNX only",
                )
    for value in (*model.graph.input, *model.graph.output):
        for length in value.type.tensor_type.shape.dim:
            if length.HasField("dim_value") and length.dim_value <= 0:  # free, as the importer has it
                length.ClearField("dim_value")
    return model
