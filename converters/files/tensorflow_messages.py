"""The TensorFlow messages this project reads and writes.

Only the fields that are needed, by the numbers of TensorFlow's public .proto files (graph.proto, node_def.proto,
attr_value.proto, tensor.proto, tensor_shape.proto, versions.proto, saved_model.proto, meta_graph.proto,
function.proto, op_def.proto, saver.proto, tensor_bundle.proto, tensor_slice.proto, trackable_object_graph.proto,
event.proto). Fields that are not listed survive as unknown fields.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from export_model.converters.files.chunks import Pieces
from export_model.converters.files.external_data import LARGE_FILE, Detached, Fields
from export_model.converters.files.message_limits import check_size
from export_model.converters.files.protobuf_messages import message_classes
from export_model.converters.files.wire_format import varint
from export_model.signatures.dtypes import DATA_TYPES
from export_model.signatures.errors import DamagedFileError, NotAPolicyError

#: Nodes of a file, training part and functions included.
MAX_GRAPHDEF_NODES = 1 << 17

#: Graphs of a SavedModel, one for each set of tags.
_MAX_GRAPHS = 1 << 6

#: message → fields, as converters/files/protobuf_messages.py reads them
_MESSAGES = {
    "Dim": "1 size int64, 2 name string",
    "TensorShapeProto": "2 dim Dim*, 3 unknown_rank bool",
    "TensorProto": (
        "1 dtype int32, 2 tensor_shape TensorShapeProto, 4 tensor_content bytes, 5 float_val float*, "
        "6 double_val double*, 7 int_val int32*, 8 string_val bytes*, 10 int64_val int64*, 11 bool_val bool*, "
        "13 half_val int32*, 16 uint32_val uint32*, 17 uint64_val uint64*"
    ),
    "ListValue": (
        "2 s bytes*, 3 i int64*, 4 f float*, 5 b bool*, 6 type int32*, 7 shape TensorShapeProto*, 8 tensor TensorProto*"
    ),
    "NameAttrList": "1 name string",
    "AttrValue": (
        "1 list ListValue, 2 s bytes, 3 i int64, 4 f float, 5 b bool, 6 type int32, 7 shape TensorShapeProto, "
        "8 tensor TensorProto, 9 placeholder string, 10 func NameAttrList"
    ),
    "NodeDef": "1 name string, 2 op string, 3 input string*, 4 device string, 5 attr <AttrValue",
    "VersionDef": "1 producer int32, 2 min_consumer int32, 3 bad_consumers int32*",
    "ArgDef": "1 name string, 3 type int32",
    "OpDef": "1 name string, 2 input_arg ArgDef*, 3 output_arg ArgDef*",
    "FunctionDef": "1 signature OpDef, 3 node_def NodeDef*, 4 ret <string, 6 control_ret <string",
    "FunctionDefLibrary": "1 function FunctionDef*",
    "GraphDef": "1 node NodeDef*, 2 library FunctionDefLibrary, 4 versions VersionDef",
    "TensorInfo": "1 name string, 2 dtype int32, 3 tensor_shape TensorShapeProto",
    "SignatureDef": "1 inputs <TensorInfo, 2 outputs <TensorInfo, 3 method_name string",
    "MetaInfoDef": "1 meta_graph_version string, 4 tags string*, 5 tensorflow_version string",
    "SaverDef": "1 filename_tensor_name string, 2 save_tensor_name string, 3 restore_op_name string, 7 version int32",
    "MetaGraphDef": (
        "1 meta_info_def MetaInfoDef, 2 graph_def GraphDef, 3 saver_def SaverDef, 5 signature_def <SignatureDef"
    ),
    "SavedModel": "1 saved_model_schema_version int64, 2 meta_graphs MetaGraphDef*",
    # tensor_bundle.proto, tensor_slice.proto
    "Extent": "1 start int64, 2 length int64",
    "TensorSliceProto": "1 extent Extent*",
    "BundleHeaderProto": "1 num_shards int32, 2 endianness int32, 3 version VersionDef",
    "BundleEntryProto": (
        "1 dtype int32, 2 shape TensorShapeProto, 3 shard_id int32, 4 offset int64, 5 size int64, 6 crc32c fixed32, "
        "7 slices TensorSliceProto*"
    ),
    # trackable_object_graph.proto
    "SerializedTensor": "2 full_name string, 3 checkpoint_key string",
    "TrackableObject": "2 attributes SerializedTensor*",
    "TrackableObjectGraph": "1 nodes TrackableObject*",
    # event.proto
    "Event": "1 wall_time double, 2 step int64, 3 file_version string, 4 graph_def bytes",
}
#: Fields of AttrValue and TensorInfo that are members of a oneof: presence must be visible even at the default value.
_ONEOFS = {"AttrValue": "value"}


_CLASSES = message_classes("export_model", _MESSAGES, _ONEOFS, "proto3")
GraphDef = _CLASSES["GraphDef"]
NodeDef = _CLASSES["NodeDef"]
AttrValue = _CLASSES["AttrValue"]
TensorProto = _CLASSES["TensorProto"]
MetaGraphDef = _CLASSES["MetaGraphDef"]
SavedModel = _CLASSES["SavedModel"]
BundleHeaderProto = _CLASSES["BundleHeaderProto"]
BundleEntryProto = _CLASSES["BundleEntryProto"]
TrackableObjectGraph = _CLASSES["TrackableObjectGraph"]
Event = _CLASSES["Event"]


#: Where the contents of tensors lie: GraphDef.node.attr.value.tensor.tensor_content, in functions too.
_NODE: Fields = {5: {2: {8: {4: None}}}}
_GRAPH: Fields = {1: _NODE, 2: {1: {3: _NODE}}}
_CONTENTS: dict[str, Fields] = {"GraphDef": _GRAPH, "MetaGraphDef": {2: _GRAPH}, "SavedModel": {2: {2: _GRAPH}}}


def parse(message_class: Any, data: bytes | memoryview, what: str, detached: Detached | None = None) -> Any:
    """The message in ``data``. Of a large one ``detached`` is given the tensors' contents.

    Raises DamagedFileError that calls it ``what``, NotAPolicyError where it is made of too many parts.
    """
    fields = _CONTENTS.get(message_class.DESCRIPTOR.name)
    if detached is not None and fields is not None and len(data) >= LARGE_FILE:
        content = detached.without(data, fields)
    else:
        content = bytes(data)
    check_size(message_class, content)
    message = message_class()
    try:
        message.ParseFromString(content)
    except DecodeError as error:
        raise DamagedFileError(
            f"this is not a whole {what}",
            why=f"protobuf cannot decode it ({str(error) or 'truncated message'})",
            fix="copy the file again (binary, not through a text filter), or fetch it from where it was trained",
        ) from error
    for graph in _graphs(message):
        check_nodes(len(graph.node) + sum(1 + len(f.node_def) for f in graph.library.function))
    return message


def _graphs(message: Any) -> list[Any]:
    """The GraphDefs in a message. Raises NotAPolicyError where there are too many."""
    kind = message.DESCRIPTOR.name
    if kind == "SavedModel":
        if len(message.meta_graphs) > _MAX_GRAPHS:
            raise NotAPolicyError(
                f"the SavedModel has {len(message.meta_graphs)} graphs",
                why=f"no more than {_MAX_GRAPHS} are looked at; a policy has one",
                fix="save the policy alone",
            )
        return [meta.graph_def for meta in message.meta_graphs]
    return [message] if kind == "GraphDef" else [message.graph_def] if kind == "MetaGraphDef" else []


def check_nodes(count: int) -> None:
    """Raise NotAPolicyError where a file has more nodes than any is read with."""
    if count > MAX_GRAPHDEF_NODES:
        raise NotAPolicyError(
            f"the graph has {count} nodes",
            why=f"no more than {MAX_GRAPHDEF_NODES} are read; the training graphs of ML-Agents have some thousands",
            fix="freeze the policy's own outputs",
        )


def node_def(name: str, op: str, inputs: Iterable[str] = (), **types: int) -> Any:
    """A NodeDef whose attributes are DataTypes."""
    made = NodeDef(name=name, op=op, input=inputs)
    for key, number in types.items():
        made.attr[key].type = number
    return made


def serialise(message: Any) -> bytes:
    """Bytes with map entries in a fixed order."""
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def pieces(message: Any, detached: Detached) -> Pieces:
    """As ``serialise``, with what is detached in its place."""
    return detached.whole(serialise(message))


def field(number: int, content: Pieces) -> Pieces:
    """A field of a message that holds another, which is serialised already."""
    return Pieces(varint(number << 3 | 2), varint(content.size), content)


# ------------------------------------------------------------------ dtypes (types.proto)

#: DataType → numpy dtype; resources and variants have none.
_TEXT = np.dtype(np.bytes_)
_DTYPES: dict[int, np.dtype] = {t.tensorflow: t.dtype for t in DATA_TYPES} | {
    7: _TEXT,
    **dict.fromkeys((20, 21), np.dtype(object)),
}
_NUMBERS = {t.dtype: t.tensorflow for t in DATA_TYPES} | {_TEXT: 7}
#: How JSON forms of a GraphDef write a DataType → its number.
BY_NAME = {t.name: t.tensorflow for t in DATA_TYPES} | {"DT_STRING": 7, "DT_RESOURCE": 20, "DT_VARIANT": 21}
_NAMES = {number: name for name, number in BY_NAME.items()}


def dtype_of(number: int) -> np.dtype:
    """The numpy dtype of a DataType; reference types (number + 100) count as their base."""
    dtype = _DTYPES.get(number - 100 if number > 100 else number)
    if dtype is None:
        raise DamagedFileError(
            f"dtype number {number} is not one this tool knows",
            why="quantised, complex and bfloat16 tensors do not occur in ML-Agents policies",
            fix="export the policy in float32",
        )
    return dtype


def dtype_number(dtype: np.dtype) -> int:
    """The DataType of a numpy dtype. Raises DamagedFileError for those that no policy has: resources are objects."""
    number = _NUMBERS.get(_TEXT if dtype.kind == "S" else dtype)
    if number is None:
        raise DamagedFileError(
            f"a tensor of {dtype} is given or taken",
            why="policies take and give numbers; a signature may name a variable's handle",
            fix="save the policy with tensors alone as inputs and outputs",
        )
    return number


def dtype_name(dtype: np.dtype) -> str:
    """``"DT_FLOAT"``: how JSON forms of a GraphDef write a DataType."""
    return _NAMES[dtype_number(dtype)]
