"""The values of small constants of an ONNX graph, computed node by node from what is stored.

An importer folds constants before it looks at them, so ``version_number`` may be an initializer, a Constant, the cast
of one, a sum; where a run is looked at, it may hang on the inputs too. Untrusted files: whatever would grow beyond
``_LIMIT`` elements is not computed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from converters.onnx.proto import array_of
from signatures.errors import ExportModelError

if TYPE_CHECKING:
    from converters.targets.unity.onnx_file import OnnxFile

#: Ops that draw: what hangs on them is never a constant.
RANDOM_OPS = frozenset(
    {"RandomNormal", "RandomNormalLike", "RandomUniform", "RandomUniformLike", "Multinomial", "Bernoulli"}
)
_LIMIT = 1 << 16
_DEPTH = 200
#: TensorProto.DataType of float16 and bfloat16.
_NARROW = (10, 16)
#: Ops whose result may be of any size whatever goes in, and the input that says which.
_GROWING = {"Expand": 1, "ConstantOfShape": 0, "Tile": 1}
_NOT_COMPUTED = frozenset({"Loop", "Scan", "If", "Range", "Resize", "Upsample", "Pad", "EyeLike", "OneHot", "Einsum"})


def value_of(file: OnnxFile, name: str, fed: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """A value under what is fed to the inputs, None where it is large, drawn, or cannot be computed here."""
    wanted, order = [name], []
    seen: set[str] = set()
    while wanted:
        value = wanted.pop()
        if value in seen or value in file.initializers or value in fed or not value:
            continue
        seen.add(value)
        node = file.producers.get(value)
        if node is None or node.op_type in RANDOM_OPS or len(seen) > _DEPTH:
            return None
        order.append(node)
        wanted.extend(node.input)
    needed = {id(node) for node in order}
    values: dict[str, np.ndarray | None] = dict(fed)
    for node in file.model.graph.node:
        if id(node) in needed:
            inputs = [_stored(file, n) if n in file.initializers else values.get(n) if n else None for n in node.input]
            made = _computed(node, inputs, file.opset)
            if made is None:
                return None
            values.update(zip(node.output, made, strict=False))
    return _stored(file, name) if name in file.initializers else values.get(name)


def _stored(file: OnnxFile, name: str) -> np.ndarray | None:
    return _read(file.initializers[name])


def _read(tensor: Any) -> np.ndarray | None:
    if np.prod(tensor.dims, dtype=np.float64) > _LIMIT:
        return None
    try:
        return array_of(tensor, None) if tensor.data_type not in _NARROW else _narrow(tensor)
    except (ExportModelError, ValueError):
        return None


def _narrow(tensor: Any) -> np.ndarray:
    """Half precision, which no policy is converted from but a constant may be stored in."""
    import onnx

    return np.asarray(onnx.numpy_helper.to_array(tensor)).astype(np.float32)


def _computed(node: Any, inputs: list[np.ndarray | None], opset: int) -> list[np.ndarray] | None:
    """A node's results, None where it is not computed."""
    if any(value is None and name for value, name in zip(inputs, node.input, strict=True)):
        return None
    if node.op_type == "Identity" and len(inputs) == 1 and inputs[0] is not None:
        return [inputs[0]]
    if node.op_type == "Constant" and len(node.attribute) == 1 and node.attribute[0].name == "value":
        value = _read(node.attribute[0].t)
        return None if value is None else [value]
    return None if _may_grow(node.op_type, inputs) else _run(node, inputs, opset)


def _may_grow(kind: str, inputs: list[np.ndarray | None]) -> bool:
    sizes = [float(value.size) for value in inputs if value is not None]
    if kind in _NOT_COMPUTED or float(np.prod(sizes)) > _LIMIT:
        return True
    if kind in _GROWING:
        asked = inputs[_GROWING[kind]] if len(inputs) > _GROWING[kind] else None
        return asked is None or float(np.prod(np.abs(asked.astype(np.float64)))) * float(np.prod(sizes)) > _LIMIT
    return False


def _run(node: Any, inputs: list[np.ndarray | None], opset: int) -> list[np.ndarray] | None:
    """By ONNX's reference implementation; a node that it does not take has no value here."""
    import onnx
    from onnx.reference import ReferenceEvaluator

    graph = onnx.GraphProto(name="constant")
    graph.node.append(node)
    for name in dict.fromkeys(n for n in node.input if n):
        graph.input.append(onnx.ValueInfoProto(name=name))
    for name in node.output:
        graph.output.append(onnx.ValueInfoProto(name=name))
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", opset)])
    try:
        with np.errstate(all="ignore"):
            made = ReferenceEvaluator(model).run(None, dict(zip(node.input, inputs, strict=True)))
    except (RuntimeError, ValueError, TypeError, LookupError, NotImplementedError, AttributeError, ArithmeticError):
        return None
    return [np.asarray(value) for value in made]
