"""The messages of an ONNX model, as far as they are read and written: onnx.proto of ONNX 1.16 has the numbers.

What is not listed acts on no value (documentation, annotations, a trainer's graphs) and is dropped from what is read.
The package ``onnx`` costs a cold start as much as numpy does; it is imported where its checker, its inliner or its
shape inference is asked.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np

from export_model.converters.files.chunks import Pieces
from export_model.converters.files.external_data import Detached, is_readable
from export_model.converters.files.protobuf_messages import message_classes
from export_model.signatures.dtypes import DATA_TYPES
from export_model.signatures.errors import UnsupportedOpError

_CLASSES = message_classes(
    "export_model_onnx",
    {
        "Dimension": "1 dim_value int64, 2 dim_param string",
        "TensorShapeProto": "1 dim Dimension*",
        "Tensor": "1 elem_type int32, 2 shape TensorShapeProto",
        "Sequence": "1 elem_type TypeProto",
        "Map": "1 key_type int32, 2 value_type TypeProto",
        "TypeProto": (
            "1 tensor_type Tensor, 4 sequence_type Sequence, 5 map_type Map, 8 sparse_tensor_type Tensor, "
            "9 optional_type Sequence"
        ),
        "ValueInfoProto": "1 name string, 2 type TypeProto",
        "TensorProto": (
            "1 dims int64*, 2 data_type int32, 4 float_data float*, 5 int32_data int32*, 6 string_data bytes*, "
            "7 int64_data int64*, 8 name string, 9 raw_data bytes, 10 double_data double*, 11 uint64_data uint64*, "
            "13 external_data StringStringEntryProto*, 14 data_location int32"
        ),
        "SparseTensorProto": "1 values TensorProto, 2 indices TensorProto, 3 dims int64*",
        "AttributeProto": (
            "1 name string, 2 f float, 3 i int64, 4 s bytes, 5 t TensorProto, 6 g GraphProto, 7 floats float*, "
            "8 ints int64*, 9 strings bytes*, 10 tensors TensorProto*, 11 graphs GraphProto*, 14 tp TypeProto, "
            "15 type_protos TypeProto*, 20 type int32, 21 ref_attr_name string, 22 sparse_tensor SparseTensorProto, "
            "23 sparse_tensors SparseTensorProto*"
        ),
        "NodeProto": (
            "1 input string*, 2 output string*, 3 name string, 4 op_type string, 5 attribute AttributeProto*, "
            "7 domain string, 8 overload string, 9 metadata_props StringStringEntryProto*"
        ),
        "GraphProto": (
            "1 node NodeProto*, 2 name string, 5 initializer TensorProto*, 11 input ValueInfoProto*, "
            "12 output ValueInfoProto*, 13 value_info ValueInfoProto*, 15 sparse_initializer SparseTensorProto*"
        ),
        "FunctionProto": (
            "1 name string, 4 input string*, 5 output string*, 6 attribute string*, 7 node NodeProto*, "
            "9 opset_import OperatorSetIdProto*, 10 domain string, 11 attribute_proto AttributeProto*, "
            "12 value_info ValueInfoProto*, 13 overload string"
        ),
        "OperatorSetIdProto": "1 domain string, 2 version int64",
        "StringStringEntryProto": "1 key string, 2 value string",
        "ModelProto": (
            "1 ir_version int64, 2 producer_name string, 3 producer_version string, 7 graph GraphProto, "
            "8 opset_import OperatorSetIdProto*, 14 metadata_props StringStringEntryProto*, "
            "25 functions FunctionProto*"
        ),
    },
    {"Dimension": "value", "TypeProto": "value"},
    "proto2",
)
ModelProto = _CLASSES["ModelProto"]
#: numpy dtype → TensorProto.DataType
_DATA_TYPES = {t.dtype: t.onnx for t in DATA_TYPES}


def data_type(dtype: np.dtype, name: str = "") -> int:
    """TensorProto.DataType of a dtype. Raises UnsupportedOpError for text, which no policy computes with in ONNX."""
    if dtype not in _DATA_TYPES:
        raise UnsupportedOpError(
            f"{name or 'a tensor'} is {'text' if dtype.kind in 'SUO' else dtype}, which is not written to ONNX",
            why="a policy takes and gives numbers; an output that is made from text can be left out",
            fix="leave onnx out of --to, or name the outputs: --output NODE=ROLE",
        )
    return _DATA_TYPES[dtype]


def tensor(array: np.ndarray, name: str = "", raw: bytes | None = None) -> Any:
    """A TensorProto with raw bytes, which are little-endian: the array's, or ``raw`` in their place."""
    if raw is None:
        raw = (array if sys.byteorder == "little" else array.astype(array.dtype.newbyteorder("<"))).tobytes()
    made = _CLASSES["TensorProto"](dims=array.shape, data_type=data_type(array.dtype, name), raw_data=raw)
    if name:
        made.name = name
    return made


def node(kind: str, inputs: Sequence[str], outputs: Sequence[str], name: str = "", **attributes: Any) -> Any:
    """A NodeProto, its attributes by name. A dtype is written as ONNX's number of it, an array as a tensor."""
    made = _CLASSES["NodeProto"](op_type=kind, input=inputs, output=outputs)
    if name:
        made.name = name
    made.attribute.extend(_attribute(k, v) for k, v in sorted(attributes.items()) if v is not None)
    return made


def _attribute(name: str, value: Any) -> Any:
    """An AttributeProto, its ``type`` (AttributeType) by the value's."""
    made = _CLASSES["AttributeProto"](name=name)
    if isinstance(value, np.dtype):
        value = data_type(value)
    if isinstance(value, Integral):
        made.i, made.type = int(value), 2
    elif isinstance(value, Real):
        made.f, made.type = float(value), 1
    elif isinstance(value, str):
        made.s, made.type = value.encode(), 3
    elif isinstance(value, np.ndarray):
        made.t.CopyFrom(tensor(value))
        made.type = 4
    else:
        values = list(value)
        if all(isinstance(v, Integral) for v in values):
            made.ints.extend(int(v) for v in values)
            made.type = 7
        elif all(isinstance(v, Real) for v in values):
            made.floats.extend(float(v) for v in values)
            made.type = 6
        else:
            made.strings.extend(v.encode() for v in values)
            made.type = 8
    return made


def value_info(name: str, dtype: np.dtype, dims: Sequence[int | str] | None) -> Any:
    """A ValueInfoProto: an axis is a size, or the name of one that is not known; None: any number of them."""
    made = _CLASSES["ValueInfoProto"](name=name)
    made.type.tensor_type.elem_type = data_type(dtype)
    if dims is None:
        return made
    made.type.tensor_type.shape.SetInParent()  # a scalar has a shape of no axes
    for dim in dims:
        made.type.tensor_type.shape.dim.add(**{"dim_param" if isinstance(dim, str) else "dim_value": dim})
    return made


def model(
    name: str,
    nodes: Sequence[Any],
    initializers: Sequence[Any],
    inputs: Sequence[Any],
    outputs: Sequence[Any],
    *,
    producer: str,
    ir_version: int,
    opset: int,
    props: Mapping[str, str],
) -> Any:
    """A ModelProto of ONNX's own ops."""
    made = ModelProto(ir_version=ir_version, producer_name=producer)
    made.opset_import.add(domain="", version=opset)
    for key, value in props.items():
        made.metadata_props.add(key=key, value=value)
    graph = made.graph
    graph.name = name
    graph.node.extend(nodes)
    graph.initializer.extend(initializers)
    graph.input.extend(inputs)
    graph.output.extend(outputs)
    return made


def as_onnx_message(model: Any) -> Any:
    """A ModelProto as the message of the package ``onnx``, for what that package is asked."""
    import onnx

    return model if isinstance(model, onnx.ModelProto) else onnx.ModelProto.FromString(model.SerializeToString())


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
