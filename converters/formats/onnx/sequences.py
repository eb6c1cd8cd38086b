"""Sequences of tensors whose lengths the file states, as slices: PyTorch's exporter writes GRUCell's ``chunk`` so.

A runtime has lists of tensors (SplitToSequence, SequenceConstruct, SequenceAt, ConcatFromSequence), the graph has not.
What stays in a form that is not known here is refused by its operator, as any other.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.files.external_data import Detached
from export_model.converters.formats.onnx.proto import array_of

_INT64 = 7  # TensorProto.DataType
#: Elements of a sequence that is cut: a recurrent cell has four.
_MOST = 4096
#: A length, or a position, that is believed.
_LONGEST = 1 << 31


def flatten_sequences(graph: Any, detached: Detached | None) -> None:
    """Let each SequenceAt and ConcatFromSequence of a GraphProto read the tensors themselves, in place."""
    makers = {name: node for node in graph.node for name in node.output}
    if not any(node.op_type.startswith("Sequence") or node.op_type == "ConcatFromSequence" for node in graph.node):
        return
    constants = {t.name: t for t in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant" and len(node.attribute) == 1 and node.attribute[0].name == "value":
            constants[node.output[0]] = node.attribute[0].t
    for node in list(graph.node):
        made = makers.get(node.input[0]) if node.input else None
        if made is None or node.domain or made.domain:
            continue
        if node.op_type == "ConcatFromSequence":
            _join(node, made)
        elif node.op_type == "SequenceAt" and len(node.input) == 2 and node.input[1] in constants:
            position = array_of(constants[node.input[1]], detached)
            if position.size == 1 and _are_lengths(position):
                _take(graph, node, made, int(position.reshape(())), constants, detached)


def _join(node: Any, made: Any) -> None:
    """Make a ConcatFromSequence of a SequenceConstruct a Concat of its tensors."""
    if made.op_type == "SequenceConstruct" and not _integer(node, "new_axis"):
        node.op_type, node.input[:] = "Concat", list(made.input)
        kept = [a for a in node.attribute if a.name == "axis"]
        del node.attribute[:]
        node.attribute.extend(kept)


def _take(
    graph: Any, node: Any, made: Any, position: int, constants: Mapping[str, Any], detached: Detached | None
) -> None:
    """Make a SequenceAt what it takes: a tensor of a SequenceConstruct, a slice of what is split."""
    if made.op_type == "SequenceConstruct" and -len(made.input) <= position < len(made.input):
        node.op_type, node.input[:] = "Identity", [made.input[position]]
    if made.op_type != "SplitToSequence":
        return
    split = made.input[1] if len(made.input) > 1 else ""
    if split and split not in constants:
        return
    lengths = array_of(constants[split], detached) if split else np.ones((), np.int64)
    if not _are_lengths(lengths):
        return
    if lengths.ndim == 1 and -lengths.size <= position < lengths.size:
        bounds = np.concatenate(([0], np.cumsum(lengths.astype(np.int64))))
        start, end = bounds[position % lengths.size :][:2]
    elif lengths.ndim == 0 and 0 <= position < _MOST:
        start, end = position * int(lengths), (position + 1) * int(lengths)
    else:
        return
    axis = _integer(made, "axis")
    if not split and not _integer(made, "keepdims", 1):
        name = _constant(graph, f"{node.output[0]}/position", np.array(start))
        node.op_type, node.input[:] = "Gather", [made.input[0], name]
        node.attribute.add(name="axis", i=axis, type=2)
        return
    numbers = {"starts": start, "ends": end, "axes": axis}
    node.op_type = "Slice"
    node.input[:] = [
        made.input[0],
        *(_constant(graph, f"{node.output[0]}/{k}", np.array([v])) for k, v in numbers.items()),
    ]


def _are_lengths(array: np.ndarray) -> bool:
    return array.dtype.kind == "i" and array.size <= _MOST and bool((np.abs(array) < _LONGEST).all())


def _integer(node: Any, name: str, default: int = 0) -> int:
    return next((int(a.i) for a in node.attribute if a.name == name), default)


def _constant(graph: Any, name: str, value: np.ndarray) -> str:
    graph.initializer.add(name=name, data_type=_INT64, dims=value.shape, raw_data=value.astype("<i8").tobytes())
    return name
