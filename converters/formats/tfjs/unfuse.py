"""The official converter's fused ops as the plain ones that they stand for (tfjs-core ops/fused_util).

``_FusedMatMul``, ``_FusedConv2D`` and ``FusedDepthwiseConv2dNative`` compute a product, and what ``fused_ops`` lists
after it: BiasAdd, then an activation. ``Prelu`` has its slopes as a further input.
"""

from __future__ import annotations

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nn.activations import leaky_relu, prelu
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import TABLE
from export_model.signatures.errors import GraphError, UnsupportedOpError

_PLAIN = {
    **{op.fused: op.name for op in TABLE.values() if op.fused},
    "FusedDepthwiseConv2dNative": "DepthwiseConv2dNative",
}
#: What ``fused_ops`` may name: the ops that are activations, and one that is not in the table.
_ACTIVATIONS = frozenset(("Prelu", *(op.name for op in TABLE.values() if op.activation and op.elementwise)))
_OWN = frozenset(("fused_ops", "num_args", "epsilon", "leakyrelu_alpha"))


def unfuse(graph: Graph) -> Graph:
    """See the module; the last op of each keeps the fused one's name. Raises UnsupportedOpError."""
    editor = Editor(graph)
    for node in graph.nodes:
        if node.op in _PLAIN or node.op == "Prelu":
            editor.prefix = node.name
            value = _product(editor, node) if node.op in _PLAIN else _prelu(editor, node)
            editor.rename(value, node.name, node.origin)
        else:
            editor.keep(node)
    return editor.graph()


def _prelu(editor: Editor, node: Node) -> str:
    if len(node.inputs) != 2:
        raise GraphError(
            f"node {node.name!r} (Prelu) has {len(node.inputs)} inputs",
            why="it takes a tensor and its slopes",
            fix="download the model again: it is damaged",
        )
    return prelu(editor, node.inputs[0], node.inputs[1])


def _product(editor: Editor, node: Node) -> str:
    given = node.attrs.get("fused_ops")
    steps = given if isinstance(given, tuple) else (given,) if given else ()
    wanted = 2 + sum(s in ("BiasAdd", "Prelu") for s in steps)
    if any(s != "BiasAdd" and s not in _ACTIVATIONS for s in steps) or len(node.inputs) != wanted:
        raise UnsupportedOpError(
            f"cannot convert {node.op} (node {node.name!r}) with {', '.join(map(str, steps)) or 'nothing'} fused to it",
            issues=[(node.name, node.op)],
            why=f"it has {len(node.inputs)} inputs, and what is fused is not known here, or takes {wanted}",
            fix="give the SavedModel that the TensorFlow.js model was converted from",
        )
    operands = list(node.inputs[2:])
    attrs = {k: v for k, v in node.attrs.items() if k not in _OWN}
    layout = {k: v for k, v in attrs.items() if k == "data_format"}
    value = editor.add(_PLAIN[node.op], node.inputs[:2], **attrs)
    for step in steps:
        if step == "BiasAdd":
            value = editor.add(step, [value, operands.pop(0)], **layout)
        elif step == "Prelu":
            value = prelu(editor, value, operands.pop(0))
        elif step == "LeakyRelu":
            value = leaky_relu(editor, value, float(node.attrs.get("leakyrelu_alpha", 0.2)))
        else:
            value = editor.add(step, [value])
    return value
