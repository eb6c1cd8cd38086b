"""What a loader sees of an ONNX or LiteRT file: its inputs and outputs, in order, its versions, its operators."""

from __future__ import annotations

from typing import Any

from msgspec import Struct

from export_model.converters.consumers.robots.byte_array import bytes_of_array
from export_model.converters.formats.litert.artifact import operator_of
from export_model.converters.formats.litert.flatbuffer import decode
from export_model.converters.formats.litert.tensors import dims_of, dtype_of, entry_of
from export_model.converters.graph.types import FLOAT32

#: TensorProto.DataType
FLOAT = 1


class FileTensor(Struct, frozen=True):
    """An input or output; in ``dims`` None is a free length."""

    name: str
    is_float: bool
    dims: tuple[int | None, ...]

    @property
    def text(self) -> str:
        """For people: ``obs [1, 12]``."""
        return f"{self.name} [{', '.join('?' if d is None else str(d) for d in self.dims)}]"


class FileInterface(Struct, frozen=True):
    """The inputs and outputs of a file; the versions of ONNX's own operators and of its IR, or of LiteRT's schema.

    ``operators`` are LiteRT's; ``array``: whether the bytes of the C source beside it are the file's own.
    """

    inputs: tuple[FileTensor, ...]
    outputs: tuple[FileTensor, ...]
    opset: int
    ir: int
    operators: frozenset[str] = frozenset()
    array: bool = True


def interface_of(model: Any) -> FileInterface:
    """The interface of a ModelProto."""
    stored = {t.name for t in model.graph.initializer}
    return FileInterface(
        tuple(_tensor(v) for v in model.graph.input if v.name not in stored),
        tuple(_tensor(v) for v in model.graph.output),
        max((o.version for o in model.opset_import if o.domain in ("", "ai.onnx")), default=1),
        model.ir_version,
    )


def interface_of_litert(data: bytes, source: str) -> FileInterface:
    """The interface of a LiteRT file's first subgraph. ``source`` is the C source that has its bytes, empty for none.

    Raises DamagedFileError.
    """
    model = decode(data)
    subgraph = entry_of(model, "subgraphs", 0)

    def side(name: str) -> tuple[FileTensor, ...]:
        tensors = [entry_of(subgraph, "tensors", int(i)) for i in subgraph.get(name, ())]
        return tuple(FileTensor(str(t.get("name", "")), dtype_of(t) == FLOAT32, dims_of(t)) for t in tensors)

    operators = frozenset(map(operator_of, model.get("operator_codes", ())))
    return FileInterface(
        side("inputs"), side("outputs"), 0, model.get("version", 0), operators, array=bytes_of_array(source) == data
    )


def _tensor(value: Any) -> FileTensor:
    kind = value.type.tensor_type
    dims = (d.dim_value if d.HasField("dim_value") else None for d in kind.shape.dim)
    return FileTensor(value.name, kind.elem_type == FLOAT, tuple(dims))
