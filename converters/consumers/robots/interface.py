"""What a loader sees of an ONNX file: its inputs and outputs, in order, and its versions."""

from __future__ import annotations

from typing import Any

from msgspec import Struct

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
    """The inputs and outputs of a file, its opset of ONNX's own operators and its IR version."""

    inputs: tuple[FileTensor, ...]
    outputs: tuple[FileTensor, ...]
    opset: int
    ir: int


def interface_of(model: Any) -> FileInterface:
    """The interface of a ModelProto."""
    stored = {t.name for t in model.graph.initializer}
    return FileInterface(
        tuple(_tensor(v) for v in model.graph.input if v.name not in stored),
        tuple(_tensor(v) for v in model.graph.output),
        max((o.version for o in model.opset_import if o.domain in ("", "ai.onnx")), default=1),
        model.ir_version,
    )


def _tensor(value: Any) -> FileTensor:
    kind = value.type.tensor_type
    dims = (d.dim_value if d.HasField("dim_value") else None for d in kind.shape.dim)
    return FileTensor(value.name, kind.elem_type == FLOAT, tuple(dims))
