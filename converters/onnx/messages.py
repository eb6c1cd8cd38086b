"""The messages of an ONNX model, as far as they are written: onnx.proto of ONNX 1.16 has the numbers.

The package ``onnx`` costs a cold start as much as numpy does; it is imported where its checker is asked.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np

from converters.messages import message_classes

_CLASSES = message_classes(
    "export_model_onnx",
    {
        "Dimension": "1 dim_value int64, 2 dim_param string",
        "TensorShapeProto": "1 dim Dimension*",
        "Tensor": "1 elem_type int32, 2 shape TensorShapeProto",
        "TypeProto": "1 tensor_type Tensor",
        "ValueInfoProto": "1 name string, 2 type TypeProto",
        "TensorProto": (
            "1 dims int64*, 2 data_type int32, 8 name string, 9 raw_data bytes, "
            "13 external_data StringStringEntryProto*, 14 data_location int32"
        ),
        "AttributeProto": (
            "1 name string, 2 f float, 3 i int64, 4 s bytes, 5 t TensorProto, 7 floats float*, 8 ints int64*, "
            "9 strings bytes*, 20 type int32"
        ),
        "NodeProto": "1 input string*, 2 output string*, 3 name string, 4 op_type string, 5 attribute AttributeProto*",
        "GraphProto": (
            "1 node NodeProto*, 2 name string, 5 initializer TensorProto*, 11 input ValueInfoProto*, "
            "12 output ValueInfoProto*"
        ),
        "OperatorSetIdProto": "1 domain string, 2 version int64",
        "StringStringEntryProto": "1 key string, 2 value string",
        "ModelProto": (
            "1 ir_version int64, 2 producer_name string, 7 graph GraphProto, 8 opset_import OperatorSetIdProto*, "
            "14 metadata_props StringStringEntryProto*"
        ),
    },
    {},
    "proto2",
)
#: numpy dtype → TensorProto.DataType
_DATA_TYPES = {
    np.dtype(kind): number
    for kind, number in (
        (np.float32, 1),
        (np.uint8, 2),
        (np.int8, 3),
        (np.uint16, 4),
        (np.int16, 5),
        (np.int32, 6),
        (np.int64, 7),
        (np.bool_, 9),
        (np.float16, 10),
        (np.float64, 11),
        (np.uint32, 12),
        (np.uint64, 13),
    )
}


def tensor(array: np.ndarray, name: str = "", raw: bytes | None = None) -> Any:
    """A TensorProto with raw bytes, which are little-endian: the array's, or ``raw`` in their place."""
    if raw is None:
        raw = (array if sys.byteorder == "little" else array.astype(array.dtype.newbyteorder("<"))).tobytes()
    made = _CLASSES["TensorProto"](dims=array.shape, data_type=_DATA_TYPES[array.dtype], raw_data=raw)
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
        value = _DATA_TYPES[value]
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


def value_info(name: str, dtype: np.dtype, dims: Sequence[int | str]) -> Any:
    """A ValueInfoProto: an axis is a size, or the name of one that is not known."""
    made = _CLASSES["ValueInfoProto"](name=name)
    made.type.tensor_type.elem_type = _DATA_TYPES[dtype]
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
    made = _CLASSES["ModelProto"](ir_version=ir_version, producer_name=producer)
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
