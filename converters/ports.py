"""What an artefact calls its inputs and outputs, as whoever feeds it must: read from the file, whichever tool wrote it.

Nothing is understood here and no op is converted, so that a file which this project could not read itself, or which is
wrong, can still be run in its own runtime and be held against another.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

from converters.frozen_graph.reader import read_graph
from converters.recognise import read_bytes, recognise_path
from converters.saved_model.reader import read_saved_model
from converters.saved_model.signature import ModelSignature
from converters.tfjs.reader import read_signature
from signatures.errors import DamagedFileError, NotAPolicyError, SourceError

Dims = tuple[int | None, ...]


@dataclass(frozen=True, slots=True)
class Port:
    """An input or output: the name that a caller uses, its dtype (numpy's name) and shape where the file tells them.

    ``tensor`` is the tensor behind the name, where the format has both (the signatures of TensorFlow).
    """

    name: str
    dtype: str | None = None
    shape: Dims | None = None
    tensor: str | None = None


@dataclass(frozen=True)
class Interface:
    """One artefact: its format (a key of the parity runtimes), the path and options that its loader takes, its ports.

    ``open`` is set where any node can be asked for (a frozen graph): ``outputs`` are then all nodes that can be.
    """

    format: str
    path: Path
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    open: bool = False


def interfaces_of(path: Path) -> list[Interface]:
    """The artefacts at ``path``: one file or folder, or every format of a bundle.

    Raises SourceError where the kind of file has no runtime of its own, DamagedFileError, NotAPolicyError.
    """
    kind = recognise_path(path)
    if kind.key == "bundle":
        return _bundle(path)
    reader = _READERS.get(kind.key)
    if reader is None:
        raise SourceError(
            f"{kind.label} cannot be compared as it is",
            where=str(path),
            why=f"no runtime loads it by itself; what can be compared: {', '.join(_READERS)}, bundle",
            fix="export it, and compare the bundle",
        )
    return [reader(path)]


def _bundle(folder: Path) -> list[Interface]:
    name = json.loads(read_bytes(folder / "policy.json"))["name"]
    found = [folder / f"{name}.bytes", folder / "saved_model", folder / "tfjs", folder / f"{name}.onnx"]
    interfaces = [interfaces_of(path)[0] for path in found if path.exists()]
    if not interfaces:
        raise SourceError("the bundle holds no model", where=str(folder), fix="export the policy again")
    return interfaces


def _frozen(path: Path) -> Interface:
    graph = read_graph(read_bytes(path))
    places = [n for n in graph.nodes if n.op in ("Placeholder", "PlaceholderWithDefault")]
    inputs = tuple(Port(n.name, n.attrs["dtype"].name if "dtype" in n.attrs else None, _dims(n)) for n in places)
    return Interface("bytes", path, inputs, tuple(Port(n.name) for n in graph.nodes), {"kind": "graph"}, open=True)


def _dims(node: Any) -> Dims | None:
    shape = node.attrs.get("shape")
    return None if shape is None or shape.dims is None else tuple(shape.dims)


def _saved_model(path: Path) -> Interface:
    file = path / "saved_model.pb" if path.is_dir() else path
    signature = read_saved_model(read_bytes(file)).signature
    if signature.key is None:
        raise NotAPolicyError(
            "the SavedModel has no signature",
            where=str(path),
            why="nobody can call it by name",
            fix="save it with signatures={'serving_default': …}",
        )
    options = {"kind": "saved_model", "signature": signature.key}
    return Interface("saved_model", file.parent, *_ports(signature), options)


def _tfjs(path: Path) -> Interface:
    file = path / "model.json" if path.is_dir() else path
    signature, nodes = read_signature(file)
    inputs, outputs = _ports(signature)
    if not inputs:  # the official converter writes none for a frozen graph: placeholders are fed
        inputs = tuple(Port(name) for name, op in nodes.items() if op == "Placeholder")
    return Interface("tfjs", file.parent, inputs, outputs)


def _ports(signature: ModelSignature) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    inputs, outputs = (
        tuple(Port(k, None if t.dtype is None else t.dtype.name, t.shape.dims, t.name) for k, t in side.items())
        for side in (signature.inputs, signature.outputs)
    )
    return inputs, outputs


def _onnx(path: Path) -> Interface:
    import onnx
    from google.protobuf.message import DecodeError

    from converters.onnx.proto import dtype_name

    try:
        graph = onnx.ModelProto.FromString(read_bytes(path)).graph
    except DecodeError as error:
        raise DamagedFileError(
            "cannot be decoded as ONNX", where=str(path), why="the file is cut off or damaged", fix="export it again"
        ) from error
    stored = {t.name for t in graph.initializer}

    def port(value: Any) -> Port:
        tensor = value.type.tensor_type
        dims = tuple(d.dim_value if d.HasField("dim_value") else None for d in tensor.shape.dim)
        return Port(value.name, dtype_name(tensor.elem_type), dims if tensor.HasField("shape") else None)

    inputs = tuple(port(v) for v in graph.input if v.name not in stored)
    return Interface("onnx", path, inputs, tuple(port(v) for v in graph.output))


_READERS: Mapping[str, Callable[[Path], Interface]] = MappingProxyType(
    {"frozen_graph": _frozen, "saved_model": _saved_model, "tfjs": _tfjs, "onnx": _onnx}
)
