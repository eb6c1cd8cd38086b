"""A graph to an event file, which TensorBoard's graph tab shows; written without TensorFlow.

A TFRecord file (TensorFlow's record_writer.cc): per record its length as uint64, the masked CRC-32C of those eight
bytes, the data, the masked CRC-32C of the data; all little-endian. The records are Event messages (event.proto): the
first names the file's version, the second holds the GraphDef. Wall times are 0, so that the same graph gives the same
bytes.
"""

from __future__ import annotations

import struct

from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.formats.checkpoint.crc32c import crc32c, mask_crc
from export_model.converters.formats.frozen_graph.encode import as_read
from export_model.converters.graph.nodes import Graph

#: TensorBoard takes every file with "tfevents" in its name; the number is where a writer puts its time.
FILE_NAME = "events.out.tfevents.0.export-model"
_VERSION = "brain.Event:2"


def event_file(graph: Graph) -> bytes:
    """The bytes of an event file that shows ``graph`` as it was read: any op, its names and attributes.

    Control edges, which the readers leave behind, are not in it.
    """
    data = schema.serialise(as_read(graph))
    events = [schema.Event(file_version=_VERSION), schema.Event(graph_def=data)]
    return b"".join(_record(schema.serialise(event)) for event in events)


def _record(data: bytes) -> bytes:
    length = struct.pack("<Q", len(data))
    return b"".join([length, _checksum(length), data, _checksum(data)])


def _checksum(data: bytes) -> bytes:
    return struct.pack("<I", mask_crc(crc32c(data)))
