"""What is inside ONNX messages, checked: tensors, attributes, the data that lies in files of its own.

A model file is untrusted. Sizes are compared with the bytes that are there before anything is allocated, and external
data is read from the model's own folder only.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from export_model.converters.files import fetch
from export_model.converters.files.external_data import LARGE, LARGE_FILE, Detached, Fields
from export_model.converters.files.fetch import MAX_WEIGHTS, read_bytes
from export_model.converters.files.message_limits import check_size
from export_model.converters.files.tensorflow_messages import check_nodes
from export_model.converters.formats.onnx.messages import ModelProto
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.dtypes import DATA_TYPES
from export_model.signatures.errors import DamagedFileError, NotAPolicyError, UnsupportedOpError

_MAX_AXES, _MAX_ELEMENTS = 32, 1 << 31
#: Messages of a file: nodes, attributes, types, axes. An empty one has two bytes, and takes a hundred in memory.
_MAX_MESSAGES = 1 << 19
#: Where the bytes of weights lie: ModelProto.graph.initializer.raw_data.
_CONTENTS: Fields = {7: {5: {9: None}}}
_EXTERNAL = 1  # TensorProto.DataLocation
#: How often all bytes of the files beside a model may be named as weights: layers share some.
_MAX_TIMES = 4
_DOUBLE, _STRING = 11, 8
_TEXT = 9  # FieldDescriptor.TYPE_STRING
#: TensorProto.DataType → (dtype, field of values that are not raw bytes); halves are widened before.
_FIELD = {1: "float_data", 7: "int64_data", 11: "double_data", 12: "uint64_data", 13: "uint64_data"}
_STORED = {t.onnx: (t.dtype, _FIELD.get(t.onnx, "int32_data")) for t in DATA_TYPES if t.name != "DT_HALF"}
#: AttributeProto.AttributeType → field, for the kinds that are read
_FIELDS = {1: "f", 2: "i", 3: "s", 4: "t", 5: "g", 6: "floats", 7: "ints", 8: "strings"}


def decode_model(data: bytes | memoryview, detached: Detached | None = None) -> Any:
    """The ModelProto in ``data``, all of whose names are text. Of a large one ``detached`` is given the weights' bytes.

    Raises DamagedFileError, NotAPolicyError where it has too many parts.
    """
    content = bytes(data) if detached is None or len(data) < LARGE_FILE else detached.without(data, _CONTENTS)
    check_size(ModelProto, content)
    try:
        model = ModelProto.FromString(content)
        model.DiscardUnknownFields()  # what no reader knows is handed to no runtime
    except DecodeError as error:
        raise DamagedFileError(
            "cannot be decoded as ONNX", why="the file is cut off or damaged", fix="export or download it again"
        ) from error
    _check_texts(model)
    _check_metadata(model)
    return model


def _check_metadata(model: Any) -> None:
    """Raise DamagedFileError where a key of the metadata, such as the contract's, stands twice; onnx.checker does, too.

    onnxruntime takes the last.
    """
    counts = Counter(entry.key for entry in model.metadata_props)
    for key, count in counts.most_common(1):
        if count > 1:
            raise DamagedFileError(
                f"its metadata has {key[:80]!r} twice",
                why="readers differ in which of the two they take",
                fix="export it again, or remove one of them",
            )


def _check_texts(model: Any) -> None:
    """Raise DamagedFileError where a text is none: protobuf gives its bytes then, as ONNX is written in proto2.

    NotAPolicyError where there are more nodes, or messages, than any file is read with.
    """
    stack, nodes, messages = [model], 0, 0
    while stack:
        message = stack.pop()
        if message.DESCRIPTOR.name == "GraphProto":
            nodes += len(message.node) + len(message.initializer)
            check_nodes(nodes)
        tensor = message.DESCRIPTOR.name == "TensorProto"
        fields = [(f, getattr(message, f)) for f in ("name", "external_data")] if tensor else ()
        for field, value in fields or ((f.name, v) for f, v in message.ListFields()):
            items = value if hasattr(value, "append") or hasattr(value, "add") else (value,)
            if not items:
                continue
            if hasattr(items[0], "ListFields"):
                messages += len(items)
                if messages > _MAX_MESSAGES:
                    raise NotAPolicyError(
                        f"the model is made of more than {_MAX_MESSAGES} parts",
                        why=f"of {field} alone it has {len(items)}; a policy has some thousands of all",
                        fix="export the policy alone",
                    )
                stack.extend(items)
            elif isinstance(items[0], str | bytes) and message.DESCRIPTOR.fields_by_name[field].type == _TEXT:
                broken = next((i for i in items if isinstance(i, bytes)), None)
                if broken is not None:
                    raise DamagedFileError(
                        f"the {field} of a {message.DESCRIPTOR.name.removesuffix('Proto')} is {broken[:40]!r}",
                        why="it must be text (UTF-8)",
                        fix="export or download it again",
                    )


def array_of(tensor: Any, detached: Detached | None) -> np.ndarray:
    """The values of a TensorProto, a view of what is ``detached``; float64 narrowed to float32.

    Raises DamagedFileError, UnsupportedOpError.
    """
    name = tensor.name or "(constant)"
    if tensor.data_type not in _STORED:
        raise UnsupportedOpError(
            f"the tensor {name!r} has data type {tensor.data_type}, which is not converted",
            issues=[(name, "Constant")],
            why="policies compute in float32; half precision, quantised numbers and strings are not supported",
            fix="export the model in float32, without quantisation",
        )
    dtype, field = _STORED[tensor.data_type]
    shape = tuple(int(d) for d in tensor.dims)
    count = math.prod(shape)
    if len(shape) > _MAX_AXES or any(d < 0 for d in shape) or math.prod(d or 1 for d in shape) > _MAX_ELEMENTS:
        raise _damaged_error(name, f"its shape is {list(shape[:8])}")
    array: np.ndarray
    if tensor.HasField("raw_data"):
        size = count * dtype.itemsize
        data = raw_of(tensor, detached)
        if data.size != size:
            raise _damaged_error(name, f"it holds {data.size} bytes where its shape needs {size}")
        array = data.view(dtype.newbyteorder("<")).astype(dtype, copy=False)
    else:
        values = getattr(tensor, field)
        if len(values) != count:
            raise _damaged_error(name, f"it holds {len(values)} values where its shape needs {count}")
        # Of whole numbers no object is kept each: those of int32_data are counted by their bytes (counting).
        array = (np.fromiter(values, np.int64, count) if field == "int32_data" else np.array(values)).astype(dtype)
    array = array.reshape(shape)
    if tensor.data_type == _DOUBLE:
        with np.errstate(over="ignore"):
            return array.astype(FLOAT32)
    return array


def raw_of(tensor: Any, detached: Detached | None) -> np.ndarray:
    """A TensorProto's raw bytes."""
    content = tensor.raw_data
    held = None if detached is None else detached.array(content)
    return np.frombuffer(content, np.uint8) if held is None else held


def dtype_name(kind: int) -> str | None:
    """A TensorProto.DataType by numpy's name; None for those that no policy has."""
    return _STORED[kind][0].name if kind in _STORED else None


def _damaged_error(name: str, why: str) -> DamagedFileError:
    return DamagedFileError(
        f"the tensor {name!r} cannot be read", why=why, fix="export the model again; this file is damaged"
    )


def attribute_of(attribute: Any, detached: Detached | None) -> Any:
    """The value of an attribute: number, text, tuple, array, or the message of a subgraph.

    tf2onnx 1.5.5 wrote ``seed`` with type INT where the operator says FLOAT; the type that is there is taken.
    """
    field = _FIELDS.get(attribute.type)
    if field is None:
        field = next((f for f in _FIELDS.values() if _is_set(attribute, f)), None)
    if field is None:
        return None
    value = getattr(attribute, field)
    if field == "t":
        return array_of(value, detached)
    if field == "s":
        return value.decode("utf-8", "replace")
    if field == "strings":
        return tuple(v.decode("utf-8", "replace") for v in value)
    return tuple(value) if field in ("floats", "ints") else value


def _is_set(attribute: Any, field: str) -> bool:
    """Models before IR version 3 do not say which kind an attribute is of."""
    if field in ("floats", "ints", "strings"):
        return len(getattr(attribute, field)) > 0
    return bool(attribute.HasField(field))


# ------------------------------------------------------------------ external data


def inside(message: Any, kind: str) -> Iterator[Any]:
    """Every message of a kind in another, wherever it stands.

    It may be in attributes, in subgraphs, or in defaults of a function's attributes. What is in a TensorProto is not
    looked at.
    """
    stack = [message]
    while stack:
        each = stack.pop()
        name = each.DESCRIPTOR.name
        if name == kind:
            yield each
        if name == "TensorProto":
            continue
        for _, value in each.ListFields():
            if hasattr(value, "ListFields"):
                stack.append(value)
            elif hasattr(value, "add"):
                stack.extend(value)


def bodies(part: Any) -> Iterator[Any]:
    """A graph or function and, each behind the one that it is in, the graphs that its nodes hold."""
    yield part
    for node in part.node:
        for attribute in node.attribute:
            if attribute.HasField("g"):
                yield from bodies(attribute.g)


def tensors(part: Any) -> Iterator[Any]:
    """Every TensorProto of a graph or function: initializers, constants, those of subgraphs and defaults."""
    return inside(part, "TensorProto")


def load_external(
    parts: Iterable[Any],
    folder: Path,
    detached: Detached | None = None,
    read: Callable[..., bytes | memoryview] = read_bytes,
) -> list[Path]:
    """Bring data that lies in files beside the model into its tensors; returns the files.

    The tensors are those of its graph and functions (large ones are ``detached``). ``read`` opens a file, as
    ``read_bytes`` does.

    Raises DamagedFileError where a file is missing, too short, or outside of ``folder``, or all are too large.
    """
    files: dict[Path, bytes | memoryview] = {}
    total = 0
    for tensor in (t for part in parts for t in tensors(part)):
        if tensor.data_location == _EXTERNAL:
            total += _bring(tensor, folder, files, detached, read)
            if total > MAX_WEIGHTS:
                raise _damaged_error(
                    tensor.name, f"the model's weights together are larger than {MAX_WEIGHTS >> 30} GiB"
                )
            if total > _MAX_TIMES * sum(map(len, files.values())):
                raise _damaged_error(tensor.name, "the same bytes of a file are named again and again as weights")
    return sorted(files)


def _bring(
    tensor: Any,
    folder: Path,
    files: dict[Path, bytes | memoryview],
    detached: Detached | None,
    read: Callable[..., bytes | memoryview],
) -> int:
    entries = {e.key: e.value for e in tensor.external_data}
    path = _inside(folder, entries.get("location", ""), tensor.name)
    if path not in files:
        left = MAX_WEIGHTS - sum(map(len, files.values()))
        if path.stat().st_size >= left:
            raise _damaged_error(
                tensor.name, f"the files beside the model are {MAX_WEIGHTS >> 30} GiB or more together"
            )
        files[path] = read(path, most=left)
    data = files[path]
    try:
        offset = int(entries.get("offset") or 0)
        length = int(entries.get("length") or len(data) - offset)
    except ValueError as error:
        raise _damaged_error(tensor.name, f"it says to be at {entries}") from error
    if offset < 0 or length < 0 or offset + length > len(data):
        raise _damaged_error(tensor.name, f"{path.name} has {len(data)} bytes, it wants {length} from {offset} on")
    if detached is None or length < LARGE:
        tensor.raw_data = bytes(data[offset : offset + length])
    else:
        tensor.raw_data = detached.mark(np.frombuffer(data, np.uint8, length, offset))
    del tensor.external_data[:]
    tensor.data_location = 0
    return length


def _inside(folder: Path, location: str, name: str) -> Path:
    """The file of a tensor's data, which must lie in the model's folder (or below it) and be a plain file."""
    path = fetch.inside(folder, location) if location and "\0" not in location else None
    if path is None or path == folder.resolve():
        raise DamagedFileError(
            f"the weights of {name!r} are said to be in {location!r}, outside the model's folder",
            why="a model file is untrusted: nothing else of this machine is read for it",
            fix="put the file beside the model (cp -L where it is a link) and export the model again",
        )
    if not path.is_file():
        raise DamagedFileError(
            f"the weights of {name!r} lie in {location!r}, which is not there",
            why="PyTorch writes large weights to a file beside the model",
            fix=f"put {location} beside the model",
        )
    return path
