"""Two nodes that ONNX has one for, where nothing reads what is between them: a runtime starts an op for each.

Of a small policy's run the start of its ops is most. What is made computes the same numbers (a zero's sign apart). The
models for one consumer (``--for``) stay as they were tried in it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from export_model.converters.formats.onnx import messages


def simplify_nodes(
    nodes: Sequence[Any], constants: Mapping[str, np.ndarray], ranks: Mapping[str, int], outputs: Collection[str]
) -> list[Any]:
    """The nodes with one op in place of some pairs.

    Clip stands for a Max of a Min, LeakyRelu for the larger of a tensor and a part of it, and ArgMax as a column for
    one that is reshaped to a column. ``constants`` are the initializers' values by name, ``ranks`` the number of axes
    of the values that it is known of.
    """
    reads = Counter(name for node in nodes for name in node.input)
    makers = {name: node for node in nodes for name in node.output}
    left_out: set[str] = set()
    kept = []
    for node in nodes:
        made = (
            _clip(node, makers, constants) or _leaky(node, makers, constants) or _column(node, makers, constants, ranks)
        )
        if made is not None and reads[made[1]] == 1 and made[1] not in outputs:
            left_out.add(made[1])
            kept.append(made[0])
        else:
            kept.append(node)
    return [node for node in kept if left_out.isdisjoint(node.output)]


def pooled_first(nodes: Sequence[Any], outputs: Collection[str], fresh: Callable[[str], str]) -> list[Any]:
    """The nodes, changed in place, with an Elu or Selu behind the MaxPool that alone reads it: they only rise.

    There is less to compute, and onnxruntime, which has neither in a Conv, keeps its own layout from Conv to MaxPool.
    """
    reads = Counter(name for node in nodes for name in node.input)
    makers = {name: node for node in nodes for name in node.output}
    made = list(nodes)
    for node in nodes:
        act = makers.get(node.input[0]) if node.op_type == "MaxPool" and len(node.output) == 1 else None
        if act is None or act.op_type not in ("Elu", "Selu") or reads[act.output[0]] > 1 or act.output[0] in outputs:
            continue
        pooled, result = fresh(f"{node.output[0]}/before"), node.output[0]
        node.input[0], node.output[0], node.name = act.input[0], pooled, pooled
        act.input[0], act.output[0], act.name = pooled, result, result
        made.remove(act)
        made.insert(made.index(node) + 1, act)
    return made


def _scalar_operand(node: Any, kind: str, constants: Mapping[str, np.ndarray]) -> tuple[str, str] | None:
    """(value, number) of a Min, Max or Mul with a scalar."""
    if node is None or node.op_type != kind or len(node.input) != 2:
        return None
    for value, bound in (node.input, node.input[::-1]):
        if bound in constants and constants[bound].shape == () and constants[bound].dtype == np.float32:
            return value, bound
    return None


def _clip(node: Any, makers: Mapping[str, Any], constants: Mapping[str, np.ndarray]) -> tuple[Any, str] | None:
    above = _scalar_operand(node, "Max", constants)
    below = None if above is None else _scalar_operand(makers.get(above[0]), "Min", constants)
    if above is None or below is None or not constants[above[1]] <= constants[below[1]]:
        return None
    clip = messages.node("Clip", [below[0], above[1], below[1]], node.output, node.name)
    return clip, above[0]


def _leaky(node: Any, makers: Mapping[str, Any], constants: Mapping[str, np.ndarray]) -> tuple[Any, str] | None:
    if node.op_type != "Max" or len(node.input) != 2:
        return None
    for value, part in (node.input, node.input[::-1]):
        slope = _scalar_operand(makers.get(part), "Mul", constants)
        if slope is not None and slope[0] == value and 0 < constants[slope[1]] < 1:
            alpha = float(constants[slope[1]])
            return messages.node("LeakyRelu", [value], node.output, node.name, alpha=alpha), part
    return None


def _column(
    node: Any, makers: Mapping[str, Any], constants: Mapping[str, np.ndarray], ranks: Mapping[str, int]
) -> tuple[Any, str] | None:
    best = makers.get(node.input[0]) if node.op_type == "Reshape" else None
    if best is None or best.op_type != "ArgMax" or ranks.get(best.output[0]) != 1:
        return None
    target = constants.get(node.input[1])
    attributes = {a.name: a.i for a in best.attribute}
    if target is None or target.tolist() != [-1, 1] or (attributes.get("axis"), attributes.get("keepdims")) != (1, 0):
        return None
    return messages.node("ArgMax", best.input, node.output, node.name, **attributes | {"keepdims": 1}), best.output[0]
