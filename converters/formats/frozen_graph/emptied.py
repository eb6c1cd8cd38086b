"""Constants whose values were taken out of a GraphDef: they must not be read as zeros.

TensorFlow reads a tensor without a value field as zeros, and its constant folding (grappler of 2.21, ``constfold``)
writes zeros so: biases of [70] and of [5], states and scalars alike. (``tf.constant``, ``tf.zeros`` and freezing write
all bytes, or one value for all.) TensorFlow.js before 1.0 took them all out, other tools clear one field of several.

So a graph's values were taken out where no float constant of several elements has any, or where one without is the
kernel of a product: no trained network multiplies by zeros alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from export_model.converters.files.tensorflow_messages import dtype_number
from export_model.converters.graph.nodes import node_of
from export_model.converters.graph.ops.table import TABLE

_FLOATS = frozenset(dtype_number(np.dtype(name)) for name in ("float16", "float32", "float64"))

#: How a kernel comes to its product, and over how many nodes: as it is, under another shape, with other axes first.
_PASSED_ON, _MOST_PASSED_ON = frozenset(("same", "view", "turn")), 16


def lacks_values(graph_def: Any) -> bool:
    """Whether the values of a graph's constants were taken out of it."""
    nodes = {n.name: n for n in graph_def.node}
    floats = {n.name: _is_empty(n.attr["value"].tensor) for n in graph_def.node if _is_float_array(n)}
    if not any(floats.values()):
        return False
    return all(floats.values()) or any(floats.get(_kernel(nodes, n), False) for n in graph_def.node)


def _is_float_array(node: Any) -> bool:
    if node.op != "Const" or "value" not in node.attr:
        return False
    tensor = node.attr["value"].tensor
    return tensor.dtype in _FLOATS and math.prod(d.size for d in tensor.tensor_shape.dim) > 1


def _is_empty(tensor: Any) -> bool:
    return not (tensor.tensor_content or tensor.float_val or tensor.double_val or tensor.half_val)


def _kernel(nodes: Mapping[str, Any], node: Any) -> str:
    """The name of the constant that a matrix product or a convolution multiplies by; empty where there is none."""
    entry = TABLE.get(node.op)
    if entry is None or entry.layer not in ("dense", "convolution") or len(node.input) < 2:
        return ""
    made = nodes.get(node_of(node.input[1]))
    for _ in range(_MOST_PASSED_ON):
        if made is None or made.op not in TABLE or TABLE[made.op].moves not in _PASSED_ON or not made.input:
            break
        made = nodes.get(node_of(made.input[0]))
    return "" if made is None else str(made.name)
