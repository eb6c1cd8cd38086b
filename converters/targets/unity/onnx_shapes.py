"""Shapes of an ONNX graph in a run in which every free length of an input is 1, as Sentis' trial run has it.

By ONNX's own shape inference, asked node by node: asked for a whole graph it aborts the process where a length comes
out negative (Slice, onnx 1.23), and files are untrusted. What cannot be told is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from converters.targets.unity.onnx_file import OnnxFile

#: Operands that say a shape, axes or bounds, by operator: their values are needed too.
_SAYING = {
    "Reshape": (1,),
    "Expand": (1,),
    "Tile": (1,),
    "ConstantOfShape": (0,),
    "Slice": (1, 2, 3, 4),
    "Squeeze": (1,),
    "Unsqueeze": (1,),
    "Split": (1,),
    "Pad": (1,),
    "ReduceSum": (1,),
    "ReduceMean": (1,),
    "OneHot": (1,),
    "TopK": (1,),
}


def inferred_shapes(file: OnnxFile) -> tuple[Mapping[str, tuple[int | None, ...]], bool]:
    """(value → shape, of inputs, initializers and results; whether a length came out negative)."""
    types, negative = _given(file), False
    for node in file.model.graph.node:
        if any(name and name not in types for name in node.input) or any(a.HasField("g") for a in node.attribute):
            continue
        for name, kind in _results(file, node, types).items():
            if any(d.HasField("dim_value") and d.dim_value < 0 for d in kind.tensor_type.shape.dim):
                negative = True
            elif name:
                types[name] = kind
    shapes = {
        name: tuple(int(d.dim_value) if d.HasField("dim_value") else None for d in kind.tensor_type.shape.dim)
        for name, kind in types.items()
        if kind.tensor_type.HasField("shape")
    }
    return shapes, negative


def _given(file: OnnxFile) -> dict[str, Any]:
    import onnx

    types = {}
    for tensor in file.initializers.values():
        if min(tensor.dims, default=0) >= 0:
            types[tensor.name] = onnx.helper.make_tensor_type_proto(tensor.data_type, list(tensor.dims))
    for value in file.model.graph.input:
        if value.name not in types and value.type.HasField("tensor_type"):
            kind = onnx.TypeProto()
            kind.CopyFrom(value.type)
            for dim in kind.tensor_type.shape.dim:
                if not dim.HasField("dim_value") or dim.dim_value < 0:
                    dim.dim_value = 1
            types[value.name] = kind
    return types


def _results(file: OnnxFile, node: Any, types: Mapping[str, Any]) -> dict[str, Any]:
    import onnx
    import onnx.checker
    import onnx.shape_inference

    refused = (onnx.defs.SchemaError, onnx.shape_inference.InferenceError, onnx.checker.ValidationError)
    data = {}
    for index in _SAYING.get(node.op_type, ()):
        name = node.input[index] if index < len(node.input) else ""
        value = file.trial_value(name) if name else None
        if value is not None:
            data[name] = onnx.numpy_helper.from_array(value)
    try:
        schema = onnx.defs.get_schema(node.op_type, file.opset, "")
        known = {name: types[name] for name in node.input if name}
        made: dict[str, Any] = onnx.shape_inference.infer_node_outputs(schema, node, known, data)
    except (*refused, RuntimeError, ValueError):
        return {}
    return made
