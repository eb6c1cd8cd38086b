"""Policy to a TensorFlow.js graph model, as ``tf.loadGraphModel`` reads it (tfjs-core io types, tfjs-converter).

- Weights are taken from the ``Const`` nodes by name; their bytes lie in shards of 4 MiB, as the official converter
  cuts them (so that browsers cache them).
- TensorFlow.js has float32, int32 and bool only: int64 is narrowed here (never out of range: checked), float64 and
  float16 become float32, and every dtype attribute says so. A shard may hold weights in fewer bytes (``quantization``),
  which are float32 once they are loaded.
- An output is a node of its own (the naming pass sees to it): tfjs-converter silently mixes up two outputs of one node
  and two names of one tensor.
- The signature has the canonical names for inputs *and* outputs (the official converter loses them where two tensors
  have the same shape), and ``structuredOutputKeys`` makes ``predict`` return results by name.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.compiler.passes.weights import Storage, are_steps, compact
from export_model.converters.compiler.targets import TFJS, TFJS_INT8, prepare
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.frozen_graph.encode import PRODUCER, attributes
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.base import AttrKind
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import FLOAT32, INT32
from export_model.converters.policy.policy import Policy
from export_model.signatures.errors import UnsupportedOpError
from export_model.signatures.spec import TensorSpec

SHARD_BYTES = 4 << 20
#: The module that acts with the model in a page, and its types; they lie beside it.
_JS = Path(__file__).with_name("js")
_ACTING = ("policy.mjs", "policy.d.mts")
_NARROW = {
    np.dtype(np.int64): INT32,
    np.dtype(np.float64): FLOAT32,
    np.dtype(np.float16): FLOAT32,
    np.dtype(np.uint8): INT32,
    np.dtype(np.int8): INT32,
    np.dtype(np.int16): INT32,
    np.dtype(np.uint16): INT32,
}
#: What a byte of 0 stands for where weights are int8.
_LOWEST = -128


def _narrow(node: Node) -> np.ndarray:
    value = node.value
    assert value is not None
    target = _NARROW.get(value.dtype, value.dtype)
    if target == INT32 and value.size and (value.max() > 2**31 - 1 or value.min() < -(2**31)):
        raise UnsupportedOpError(
            f"the constant {node.name!r} does not fit into 32 bits",
            issues=[(node.name, node.op)],
            why="TensorFlow.js has no int64",
            fix="write the other formats: --to bytes,saved_model,onnx",
        )
    return value.astype(target, copy=False)


# ------------------------------------------------------------------ GraphDef as JSON


def _attribute(kind: AttrKind, value: Any) -> dict[str, Any]:
    """An attribute as protobuf's JSON has it: whole numbers as text, floats at the precision of float32."""
    if isinstance(value, tuple):
        if kind == "str" and value:
            return {"list": {"s": [_text(v) for v in value]}}
        return {"list": {"i": [str(int(v)) for v in value]} if kind == "int" and value else {}}
    if kind == "type":
        return {"type": _dtype(value)}
    if kind == "int":
        return {"i": str(int(value))}
    if kind == "float":
        return {"f": float(np.float32(value))}
    if kind == "bool":
        return {"b": bool(value)}
    if kind == "str":
        return {"s": _text(value)}
    return {"shape": {"unknownRank": True} if value.dims is None else _shape(value.dims)}


def _text(value: str | bytes) -> str:
    return base64.b64encode(value if isinstance(value, bytes) else value.encode()).decode()


def _dtype(dtype: np.dtype) -> str:
    """What TensorFlow.js calls the dtype that it has in place of one."""
    return schema.dtype_name(_NARROW.get(dtype, dtype))


def _shape(dims: Sequence[int | None]) -> dict[str, Any]:
    return {"dim": [{"size": str(-1 if n is None else n)} for n in dims]}


def _topology(graph: Graph) -> dict[str, Any]:
    """The GraphDef with every attribute: TensorFlow.js applies no defaults to some of them (``dilations``)."""
    types, nodes = infer_types(graph), []
    for node in graph.nodes:
        entry: dict[str, Any] = {"name": node.name, "op": node.op}
        if node.inputs:
            entry["input"] = list(node.inputs)
        if node.op == "Const":
            assert node.value is not None
            # tfjs looks the values up among the weights; the attribute only says dtype and shape.
            kind = _dtype(node.value.dtype)
            entry["attr"] = {
                "dtype": {"type": kind},
                "value": {"tensor": {"dtype": kind, "tensorShape": _shape(node.value.shape)}},
            }
        else:
            values = attributes(node, types)
            entry["attr"] = {a.name: _attribute(a.kind, v) for a, v in sorted(values, key=lambda pair: pair[0].name)}
        nodes.append(entry)
    return {"node": nodes, "library": {}, "versions": {"producer": PRODUCER, "minConsumer": 12}}


# ------------------------------------------------------------------ signature and weights


def _tensor_info(spec: TensorSpec) -> dict[str, Any]:
    return {
        "name": f"{spec.name}:0",
        "dtype": _dtype(np.dtype(spec.dtype)),
        "tensorShape": _shape(spec.shape),
    }


def _weights(graph: Graph, storage: Storage) -> tuple[list[dict[str, Any]], list[np.ndarray]]:
    entries, values = [], []
    for node in graph.nodes:
        if node.op != "Const":
            continue
        value = _narrow(node)
        entry: dict[str, Any] = {"name": node.name, "shape": list(value.shape), "dtype": value.dtype.name}
        if storage == "float16" and (half := compact(value, storage)) is not None:
            value, entry["quantization"] = half[0], {"dtype": "float16"}
        elif storage == "int8" and are_steps(value):
            value = (value - _LOWEST).astype(np.uint8)
            entry["quantization"] = {"dtype": "uint8", "scale": 1, "min": _LOWEST}
        entries.append(entry)
        values.append(value)
    return entries, values


def _shards(weights: Pieces) -> Mapping[str, Pieces]:
    count = max(-(-weights.size // SHARD_BYTES), 1)
    return {
        f"group1-shard{i + 1}of{count}.bin": weights.part(i * SHARD_BYTES, (i + 1) * SHARD_BYTES) for i in range(count)
    }


@cache
def _acting() -> Mapping[str, Pieces]:
    return {name: Pieces((_JS / name).read_bytes()) for name in _ACTING}


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The TensorFlow.js artefact."""
    graph = prepare(policy, TFJS_INT8 if options.weights == "int8" else TFJS)
    entries, values = _weights(graph, options.weights)
    shards = _shards(Pieces(*values))
    contract = json.loads(options.contract)
    model = {
        "format": "graph-model",
        "generatedBy": f"export-model {contract.get('tool', {}).get('version', '')}".strip(),
        "convertedBy": "export-model",
        "signature": {
            "inputs": {s.name: _tensor_info(s) for s in policy.signature.inputs},
            "outputs": {s.name: _tensor_info(s) for s in policy.signature.outputs},
        },
        "modelTopology": _topology(graph),
        "weightsManifest": [{"paths": list(shards), "weights": entries}],
        "userDefinedMetadata": {
            "structuredOutputKeys": [s.name for s in policy.signature.outputs],
            "contract": contract,
        },
    }
    text = json.dumps(model, separators=(",", ":"), ensure_ascii=True).encode()
    files = {"model.json": Pieces(text), **shards, **_acting()}
    return {f"tfjs/{name}": data for name, data in files.items()}
