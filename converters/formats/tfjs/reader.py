"""A TensorFlow.js graph model to a Graph: model.json and its weight shards (tfjs-core io/types.ts, tfjs-converter).

``modelTopology`` is a GraphDef as protobuf writes JSON: integers as strings, bytes in base64, enum values by name or
number. Constants have their values in the shards: ``weightsManifest`` is a list of groups; a group's shards, joined,
hold its weights one after the other. A weight may be quantised (``quantization``): float16, or uint8 and uint16 with
``value = stored · scale + min``. Fused ops of the official converter become the plain ones that they stand for.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.fetch import Fetched, inside, read_bytes
from export_model.converters.files.file_probe import json_in
from export_model.converters.formats.saved_model.signature import ModelSignature, TensorInfo
from export_model.converters.graph.nodes import Graph, Node, TensorShape, normal_ref, topological
from export_model.converters.graph.ops.table import IFS, WHILES, is_fed
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, SourceError

MODEL = "model.json"
_NAMES = ("float32", "int32", "bool", "uint8", "uint16", "float16", "int64")
_DTYPES = {name: np.dtype(name) for name in _NAMES}
_MAX_AXES = 32
#: How many files of a folder are looked into, and how far, for one that is not called model.json.
_MAX_FILES, _HEAD = 16, 1 << 16
_FIX = "copy the model again: model.json (before 1.0: the .pb and its manifest) and all the shards beside it"


class WebModel(Struct, frozen=True):
    """What a model.json and its shards hold."""

    graph: Graph
    signature: ModelSignature
    files: tuple[Path, ...]
    #: the contract, where this tool wrote it
    contract: Any = None


def model_file(path: Path) -> Path:
    """The JSON file of a model: ``path``, or in a folder model.json, else the one file that is such.

    No other name is agreed on: ``model.save('downloads://walker')`` writes walker.json.
    """
    if not path.is_dir():
        return path
    named = [p for p in sorted(path.glob("*.json"))[:_MAX_FILES] if p.is_file() and b'"modelTopology"' in _head(p)]
    return named[0] if len(named) == 1 and not (path / MODEL).exists() else path / MODEL


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEAD)


def content_of(given: Fetched) -> dict[str, Any]:
    """The object in a model.json, which has a topology. Raises DamagedFileError."""
    try:
        model = json_in(given.bytes_of(model_file(given.path)))
    except (ValueError, RecursionError) as error:
        raise _damaged_error("model.json is not JSON", str(error)[:200]) from error
    if not isinstance(model, dict) or not isinstance(model.get("modelTopology"), dict):
        raise _damaged_error("model.json has no modelTopology")
    nodes = model["modelTopology"].get("node")
    schema.check_nodes(len(nodes) if isinstance(nodes, list) else 0)
    return model


def read_model(given: Fetched) -> WebModel:
    """Read a model.json (or its folder) and its shards.

    Raises DamagedFileError, NotAPolicyError, SourceError, GraphError.
    """
    path = model_file(given.path)
    model = content_of(given)
    topology = model["modelTopology"]
    if "node" not in topology:
        raise NotAPolicyError("is a TensorFlow.js layers model", where=path.name, why="it holds layers, not a graph")
    try:
        weights, shards = weights_of(model.get("weightsManifest") or [], given, path.parent)
        if topology.get("library", {}).get("function"):
            _refuse_functions(topology)
        graph = Graph(topological([_node(entry, weights) for entry in topology["node"]]))
        extra = model.get("userDefinedMetadata") or {}
        signature = _signature(model.get("signature") or extra.get("signature") or {})
        return WebModel(graph, signature, (path, *shards), extra.get("contract"))
    except (AttributeError, ArithmeticError, KeyError, TypeError, ValueError, binascii.Error) as error:
        raise _damaged_error(
            "model.json is not in TensorFlow.js's form", f"{type(error).__name__}: {error}"[:200]
        ) from error


def embedded_contract(path: Path) -> Any:
    """The contract that a model of ours embeds. Raises SourceError, DamagedFileError."""
    try:
        return (json_in(read_bytes(path / MODEL if path.is_dir() else path)).get("userDefinedMetadata") or {}).get(
            "contract"
        )
    except (AttributeError, ArithmeticError, ValueError, RecursionError) as error:
        raise _damaged_error(
            "model.json is not in TensorFlow.js's form", f"{type(error).__name__}: {error}"[:200]
        ) from error


def read_signature(path: Path) -> tuple[ModelSignature, dict[str, str]]:
    """(the signature, node → op) of a model.json, without its weights. Raises SourceError, DamagedFileError."""
    try:
        model = json_in(read_bytes(path))
        signature = model.get("signature") or (model.get("userDefinedMetadata") or {}).get("signature") or {}
        nodes = {str(n["name"]): str(n["op"]) for n in model["modelTopology"]["node"]}
        return _signature(signature), nodes
    except (AttributeError, ArithmeticError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise _damaged_error(
            "model.json is not in TensorFlow.js's form", f"{type(error).__name__}: {error}"[:200]
        ) from error


def _refuse_functions(topology: Mapping[str, Any]) -> None:
    names = {f["signature"]["name"] for f in topology["library"]["function"]}
    calls = [n for n in topology["node"] if n["op"] in names or n["op"] in WHILES | IFS]
    if calls:
        raise NotAPolicyError(
            f"node {calls[0]['name']!r} ({calls[0]['op']}) calls a function",
            why="loops of TensorFlow 2 are functions, which are not read from TensorFlow.js models",
            fix="give the SavedModel that it was converted from",
        )


# ------------------------------------------------------------------ weights


def weights_of(
    manifest: Sequence[Mapping[str, Any]], given: Fetched, folder: Path
) -> tuple[dict[str, np.ndarray], list[Path]]:
    """(name → value, the shards) of a model's groups of weights. Raises DamagedFileError, SourceError."""
    try:
        return _weights(manifest, given, folder)
    except (AttributeError, ArithmeticError, KeyError, TypeError, ValueError) as error:
        raise _damaged_error(
            "weightsManifest is not in TensorFlow.js's form",
            f"{type(error).__name__}: {error}"[:200],
        ) from error


def _weights(
    manifest: Sequence[Mapping[str, Any]], given: Fetched, folder: Path
) -> tuple[dict[str, np.ndarray], list[Path]]:
    found: dict[str, np.ndarray] = {}
    files: list[Path] = []
    known: set[Path] = set()
    for group in manifest:
        paths = []
        for name in group["paths"]:
            paths.append(shard(folder, name))
            place = paths[-1].resolve()
            if place in known:  # a file that is named again and again would be any amount of memory
                raise _damaged_error(f"the weights {name[:120]!r} are named twice")
            known.add(place)
        files.extend(paths)
        data = b"".join(_bytes(given, p) for p in paths)
        at = 0
        for entry in group["weights"]:
            stored, shape = _stored_type(entry)
            size = math.prod(shape) * stored.itemsize
            if size > len(data) - at:
                raise _damaged_error(f"the weight {entry['name']!r} is beyond the end of its files")
            raw = np.frombuffer(data, stored.newbyteorder("<"), math.prod(shape), at)
            found[entry["name"]] = _dequantise(raw.astype(stored), entry).reshape(shape)
            at += size
        if at != len(data):
            raise _damaged_error(
                f"{len(data) - at} bytes are left over after the last weight", f"in {', '.join(p.name for p in paths)}"
            )
    return found, files


def shard(folder: Path, name: str) -> Path:
    """A shard's path, which must stay inside the model's folder."""
    if not name or "://" in name or inside(folder, name) is None:
        raise SourceError(
            f"names the weights {name[:120]!r}",
            where=MODEL,
            why="the weights of a model must be in its folder; nothing else is read",
            fix="put the .bin files beside model.json (cp -rL where they are links), and their bare names into "
            "weightsManifest",
        )
    return folder / name


def _bytes(given: Fetched, path: Path) -> bytes:
    """A shard; that of a model without weights is empty."""
    try:
        return given.bytes_of(path, empty=True)
    except SourceError as error:
        raise SourceError("cannot be read", where=path.name, why=error.why or error.what, fix=_FIX) from error


def _stored_type(entry: Mapping[str, Any]) -> tuple[np.dtype, tuple[int, ...]]:
    """(dtype in the shard, shape) of a weight."""
    quantised = entry.get("quantization") or {}
    name = quantised.get("dtype", entry["dtype"])
    shape = tuple(entry["shape"])
    if name not in _DTYPES:
        raise NotAPolicyError(
            f"the weight {entry['name']!r} has dtype {name}", where=MODEL, fix="convert the model again, in float32"
        )
    if len(shape) > _MAX_AXES or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise _damaged_error(f"the weight {entry['name']!r} has the shape {str(entry['shape'])[:80]}")
    return _DTYPES[name], shape


def _dequantise(stored: np.ndarray, entry: Mapping[str, Any]) -> np.ndarray:
    """A weight in its own dtype."""
    dtype = _DTYPES[entry["dtype"]]
    quantised = entry.get("quantization")
    if not quantised or stored.dtype == np.float16:
        return stored.astype(dtype)
    values = stored.astype(np.float32) * np.float32(quantised["scale"]) + np.float32(quantised["min"])
    return np.rint(values).astype(dtype) if dtype.kind in "iu" else values.astype(dtype)


# ------------------------------------------------------------------ topology


def _node(entry: Mapping[str, Any], weights: Mapping[str, np.ndarray]) -> Node:
    name, op = str(entry["name"]), str(entry["op"])
    attrs = {key: _attribute(value) for key, value in (entry.get("attr") or {}).items() if not key.startswith("_")}
    if op == "Const":
        if name not in weights:
            raise _damaged_error(f"the constant {name!r} has no values", "weightsManifest does not name it")
        tensor = ((entry.get("attr") or {}).get("value") or {}).get("tensor")
        dims = _shape(tensor.get("tensorShape") or {}).dims if tensor else None
        value = weights[name] if dims is None else reshape_constant(weights[name], dims)
        return Node(name, op, value=value, origin=f"{name}:0")
    inputs = tuple(normal_ref(i) for i in entry.get("input") or () if not i.startswith("^"))
    node = Node(name, op, inputs, attrs, origin=f"{name}:0")
    if is_fed(node):
        attrs.setdefault("shape", TensorShape(None))
        if not isinstance(attrs.get("dtype"), np.dtype) or not isinstance(attrs["shape"], TensorShape):
            raise _damaged_error(f"the placeholder {name!r} does not say its dtype or shape")
    return node


def reshape_constant(value: np.ndarray, dims: Sequence[int | None]) -> np.ndarray:
    """A constant in the shape that the graph says; the manifest may have a scalar as a vector of one."""
    if None in dims or math.prod(d or 0 for d in dims) != value.size:
        return value
    return value.reshape([d or 0 for d in dims])


def _attribute(value: Mapping[str, Any]) -> Any:
    """One AttrValue in its JSON form."""
    if not value:
        return None
    (kind, content), *_ = value.items()
    if kind == "list":
        if not content:
            return ()
        (inner, items), *_ = content.items()
        return tuple(_attribute({inner: item}) for item in items)
    read = _VALUES.get(kind)
    return None if read is None else read(content)


def _dtype(value: Any) -> np.dtype:
    number = value if isinstance(value, int) else schema.BY_NAME.get(value)
    if number is None:
        raise _damaged_error(f"the dtype {value!r} is not known")
    return schema.dtype_of(number)


def _shape(value: Mapping[str, Any]) -> TensorShape:
    if value.get("unknownRank"):
        return TensorShape(None)
    sizes = [int(d.get("size", 0)) for d in value.get("dim") or ()]
    return TensorShape(tuple(None if n < 0 else n for n in sizes))


_VALUES: Mapping[str, Callable[[Any], Any]] = {
    "s": lambda content: base64.b64decode(content).decode("utf-8", "replace"),
    "i": int,
    "f": float,
    "b": bool,
    "type": _dtype,
    "shape": _shape,
}


def _signature(value: Mapping[str, Any]) -> ModelSignature:
    def tensor(info: Mapping[str, Any]) -> TensorInfo:
        dtype = _dtype(info["dtype"]) if "dtype" in info else None
        return TensorInfo(str(info["name"]), dtype, _shape(info.get("tensorShape") or {"unknownRank": True}))

    inputs, outputs = (
        {key: tensor(info) for key, info in (value.get(side) or {}).items()} for side in ("inputs", "outputs")
    )
    return ModelSignature(inputs, outputs)


def _damaged_error(what: str, why: str | None = None) -> DamagedFileError:
    return DamagedFileError(what, why=why, fix=_FIX)
