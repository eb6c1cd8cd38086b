"""Whether a model reads a list of entities in the order in which ML-Agents writes it into Barracuda's tensor."""

from __future__ import annotations

import math
from typing import Any

from export_model.converters.consumers.unity.onnx_file import OnnxFile, attributes
from export_model.converters.formats.barracuda.format import NnModel
from export_model.converters.graph.ops.barracuda.vocabulary import LayerType

_SWAPPED = (0, 2, 1)
_VIEWS = frozenset({"Reshape", "Flatten"})
_REDUCTIONS = frozenset({"ReduceMean", "ReduceSum", "ReduceMax", "ReduceMin"})


def reads_flat(name: str, file: OnnxFile | None, nn: NnModel | None) -> bool:
    """Whether every reader of input ``name`` takes its numbers one after the other, or in no order at all.

    ML-Agents writes [E, F] flat; Barracuda holds an ONNX input [N, E, F] transposed. Transpose (0, 2, 1) undoes that,
    once a Reshape or Flatten says so (measured: rank2_transposed_first and rank2_transposed_flat in release 20), which
    as many entities as numbers need not.
    """
    if file is not None:
        (raw,) = {i.name for i in file.inputs if i.name.removesuffix(":0") == name} or {name}
        return all(_undoes(file, node) or _is_orderless(file, node) for node in file.readers(raw))
    if nn is not None:
        return all(layer.type in (LayerType.RESHAPE, LayerType.FLATTEN) for layer in nn.layers if name in layer.inputs)
    return True


def _undoes(file: OnnxFile, node: Any) -> bool:
    perm = attributes(node).get("perm")
    if node.op_type != "Transpose" or perm is None or tuple(perm.ints) != _SWAPPED:
        return False
    shape = file.shapes.get(node.output[0], ())
    square = len(shape) == len(_SWAPPED) and shape[1] == shape[2] is not None  # a Reshape would say nothing
    return square or all(reader.op_type in _VIEWS for reader in file.readers(node.output[0]))


def _is_orderless(file: OnnxFile, node: Any) -> bool:
    """One reduction after the other, of one kind, until a single number is left."""
    kind = node.op_type
    while node.op_type == kind and kind in _REDUCTIONS:
        shape = file.shapes.get(node.output[0], (None,))
        if None not in shape and math.prod(d or 1 for d in shape) == 1:
            return True
        readers = list(file.readers(node.output[0]))
        if len(readers) != 1:
            return False
        node = readers[0]
    return False
