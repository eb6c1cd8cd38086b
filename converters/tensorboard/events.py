"""A graph to an event file, which TensorBoard's graph tab shows; written without TensorFlow.

A TFRecord file (TensorFlow's record_writer.cc): per record its length as uint64, the masked CRC-32C of those eight
bytes, the data, the masked CRC-32C of the data; all little-endian. The records are Event messages (event.proto): the
first names the file's version, the second holds the GraphDef. Wall times are 0, so that the same graph gives the same
bytes.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from converters import schema
from converters.checkpoint.crc32c import crc32c, masked
from converters.frozen_graph.encode import PRODUCER
from converters.frozen_graph.tensors import from_array
from converters.graph.nodes import Graph, TensorShape

#: TensorBoard takes every file with "tfevents" in its name; the number is where a writer puts its time.
FILE_NAME = "events.out.tfevents.0.export-model"
_VERSION = "brain.Event:2"


def event_file(graph: Graph) -> bytes:
    """The bytes of an event file that shows ``graph`` as it was read: any op, its names and attributes.

    Control edges, which the readers leave behind, are not in it.
    """
    data = schema.serialise(graph_def(graph))
    events = [schema.Event(file_version=_VERSION), schema.Event(graph_def=data)]
    return b"".join(_record(schema.serialise(event)) for event in events)


def _record(data: bytes) -> bytes:
    length = struct.pack("<Q", len(data))
    return b"".join([length, _checksum(length), data, _checksum(data)])


def _checksum(data: bytes) -> bytes:
    return struct.pack("<I", masked(crc32c(data)))


def graph_def(graph: Graph) -> Any:
    """A GraphDef message of a graph that need not be compiled: nothing is asked of its ops, nothing is derived."""
    message = schema.GraphDef()
    message.versions.producer = PRODUCER
    for node in graph.nodes:
        proto = message.node.add(name=node.name, op=node.op)
        proto.input.extend(node.inputs)
        attrs = dict(node.attrs)
        if node.value is not None:
            attrs.update(dtype=node.value.dtype, value=node.value)
        for key, value in sorted(attrs.items()):
            _set(proto.attr[key], value)
    return message


def _set(proto: Any, value: Any) -> None:
    if isinstance(value, tuple):
        proto.list.SetInParent()
        for item in value:
            _append(proto.list, item)
    elif isinstance(value, np.ndarray):
        proto.tensor.CopyFrom(from_array(value))
    elif isinstance(value, TensorShape):
        _shape(proto.shape, value)
    elif isinstance(value, np.dtype | type):
        proto.type = _type(np.dtype(value))
    elif isinstance(value, bool):
        proto.b = value
    elif isinstance(value, int):
        proto.i = value
    elif isinstance(value, float):
        proto.f = value
    elif isinstance(value, str | bytes):
        proto.s = value if isinstance(value, bytes) else value.encode()


def _append(items: Any, item: Any) -> None:
    if isinstance(item, TensorShape):
        _shape(items.shape.add(), item)
    elif isinstance(item, np.dtype | type):
        items.type.append(_type(np.dtype(item)))
    elif isinstance(item, bool):
        items.b.append(item)
    elif isinstance(item, int):
        items.i.append(item)
    elif isinstance(item, float):
        items.f.append(item)
    else:
        items.s.append(item if isinstance(item, bytes) else str(item).encode())


def _type(dtype: np.dtype) -> int:
    """The DataType; resources and variants, which numpy has not, are shown as DT_RESOURCE."""
    return 20 if dtype.kind == "O" else schema.dtype_number(dtype)


def _shape(proto: Any, shape: TensorShape) -> None:
    proto.SetInParent()
    if shape.dims is None:
        proto.unknown_rank = True
        return
    for size in shape.dims:
        proto.dim.add(size=-1 if size is None else size)
