"""A model as files: one, or with its weights in another, where protobuf could not hold it (onnx.proto)."""

from __future__ import annotations

from typing import Any

from converters.detached import Detached, is_readable
from converters.pieces import Pieces

_EXTERNAL = 1  # TensorProto.DataLocation
#: Runtimes map a file's weights into memory by whole pages.
_PAGE = 1 << 12


def files_of(model: Any, detached: Detached, name: str) -> dict[str, Pieces]:
    """The files of a ModelProto, by their names: the model, and if it is too large for one, ``<name>.data``."""
    whole = detached.whole(model.SerializeToString(deterministic=True))
    if is_readable(whole):
        return {name: whole}
    parts: list[Any] = []
    at = 0
    for tensor in model.graph.initializer:
        array = detached.array(tensor.raw_data)
        if array is None:
            continue
        tensor.ClearField("raw_data")
        tensor.data_location = _EXTERNAL
        for key, value in (("location", f"{name}.data"), ("offset", at), ("length", array.nbytes)):
            tensor.external_data.add(key=key, value=str(value))
        padding = -array.nbytes % _PAGE
        parts += [array, bytes(padding)]
        at += array.nbytes + padding
    whole = detached.whole(model.SerializeToString(deterministic=True))  # constants in nodes and bodies stay in it
    return {name: whole, f"{name}.data": Pieces(*parts)}
