"""SavedModel files (saved_model.proto, meta_graph.proto) without TensorFlow.

A SavedModel of TensorFlow 1 holds a flat graph, signatures, and in ``variables/`` a checkpoint. In one of TensorFlow 2
the signatures call functions of the graph's library (converters/formats/saved_model/inlining.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec import Struct, field

from export_model.converters.compiler.options import MAX_PORTS
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.external_data import Detached
from export_model.converters.formats.saved_model.signature import ModelSignature, TensorInfo
from export_model.converters.graph.nodes import TensorShape, node_of, reachable
from export_model.converters.graph.ops.table import CALLING
from export_model.signatures.errors import DamagedFileError, NotAPolicyError

SERVING = "serving_default"
_INIT = "__saved_model_"


class SavedMetaGraph(Struct, frozen=True):
    """One MetaGraph of a SavedModel, and the signature that stands for the policy."""

    graph_def: Any
    tags: tuple[str, ...]
    signature: ModelSignature
    #: every signature's key
    keys: tuple[str, ...]
    #: whether what the signature computes is in functions
    calls: bool
    #: the node that restores the variables, empty where there is none
    restore: str = ""
    #: what of the graph lies beside it
    detached: Detached = field(default_factory=Detached)


def read_saved_model(data: bytes, key: str | None = None, detached: Detached | None = None) -> SavedMetaGraph:
    """The MetaGraph that is tagged for serving (else the first), and its signature ``key``.

    Without a key it is ``serving_default``, else the first. Large contents go to ``detached``, by default one of
    its own. Raises DamagedFileError, NotAPolicyError.
    """
    detached = detached or Detached()
    message = schema.parse(schema.SavedModel, data, "SavedModel", detached)
    if not message.meta_graphs:
        raise NotAPolicyError("the SavedModel has no graph", fix="save the model again")
    meta = next((m for m in message.meta_graphs if "serve" in m.meta_info_def.tags), message.meta_graphs[0])
    if len(meta.signature_def) > MAX_PORTS:
        raise NotAPolicyError(
            f"the SavedModel has {len(meta.signature_def)} signatures",
            why=f"no more than {MAX_PORTS} are looked at; a policy has one or two",
            fix="save the policy alone",
        )
    keys = tuple(sorted(k for k, s in meta.signature_def.items() if s.outputs and not k.startswith(_INIT)))
    if key not in keys:
        key = SERVING if SERVING in keys else next(iter(keys), None)
    signature = ModelSignature()
    if key is not None:
        definition = meta.signature_def[key]
        signature = ModelSignature(_tensors(definition.inputs), _tensors(definition.outputs), key)
    calls = _calls_functions(meta.graph_def, signature)
    restore = meta.saver_def.restore_op_name
    return SavedMetaGraph(
        graph_def=meta.graph_def,
        tags=tuple(meta.meta_info_def.tags),
        signature=signature,
        keys=keys,
        calls=calls,
        restore=restore,
        detached=detached,
    )


def _tensors(entries: Mapping[str, Any]) -> dict[str, TensorInfo]:
    found: dict[str, TensorInfo] = {}
    for key in sorted(entries):
        info = entries[key]
        if not info.name:
            raise DamagedFileError(f"the signature's {key!r} names no tensor", fix="save the model again, dense")
        shape = info.tensor_shape
        dims = tuple(None if d.size < 0 else int(d.size) for d in shape.dim)
        found[key] = TensorInfo(
            info.name, schema.dtype_of(info.dtype), TensorShape(None if shape.unknown_rank else dims)
        )
    return found


def _calls_functions(graph_def: Any, signature: ModelSignature) -> bool:
    """Whether a node upstream of the signature (of anything, where there is none) calls a function."""
    functions = {f.signature.name for f in graph_def.library.function} | CALLING
    calling = {n.name for n in graph_def.node if n.op in functions}
    if not calling or not signature.outputs:
        return bool(calling)
    inputs = {n.name: [node_of(i) for i in n.input if not i.startswith("^")] for n in graph_def.node}
    return not calling.isdisjoint(reachable(map(node_of, signature.roots), lambda name: inputs.get(name, ())))
