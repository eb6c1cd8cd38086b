"""What an ONNX model takes and gives, and the contract that it holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from converters.detached import Detached
from converters.fetch import read_bytes
from converters.format import Port, Ports
from converters.onnx.messages import CONTRACT_KEY
from converters.onnx.proto import decoded, dtype_name


def ports(path: Path) -> Ports:
    """The ports of a file. Raises SourceError, DamagedFileError."""
    graph = decoded(read_bytes(path), Detached()).graph
    stored = {t.name for t in graph.initializer}
    inputs = tuple(_port(v) for v in graph.input if v.name not in stored)
    return Ports(path, inputs, tuple(_port(v) for v in graph.output))


def _port(value: Any) -> Port:
    """A length of 0 or below, and a named one, is free (as the importer reads it)."""
    tensor = value.type.tensor_type
    dims = tuple(int(d.dim_value) if d.dim_value > 0 else None for d in tensor.shape.dim)
    return Port(value.name, dtype_name(tensor.elem_type), dims if tensor.HasField("shape") else None)


def held(path: Path) -> str | None:
    """The contract that a model of ours embeds. Raises SourceError, DamagedFileError."""
    model = decoded(read_bytes(path), Detached())
    return next((str(p.value) for p in model.metadata_props if p.key == CONTRACT_KEY), None)
