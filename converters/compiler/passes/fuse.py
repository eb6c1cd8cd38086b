"""MatMul + BiasAdd (+ activation) and Conv2D + BiasAdd (+ activation) as one op, for targets that have it.

TensorFlow.js has ``_FusedMatMul`` and ``_FusedConv2D``, ONNX has Gemm and a bias in Conv. ``.bytes`` and SavedModel
stay unfused: TF 1.x has neither.
"""

from __future__ import annotations

from collections.abc import Iterable

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.ops.table import op_of


def fuse(graph: Graph, roots: Iterable[str], *, activations: bool) -> Graph:
    """The graph with the pairs joined (and with ``activations`` the triples); the last node's name is kept.

    A product that something else reads too, or that is an output, stays as it is; so does a transposed one:
    TensorFlow.js's wasm backend adds the bias wrongly there (4.22).
    """
    consumers = graph.consumers()
    outputs = {node_of(r) for r in roots}
    replaced: dict[str, Node] = {}
    swallowed: set[str] = set()
    for node in graph.nodes:
        if not op_of(node).fused or node.name in outputs or len(consumers[node.name]) != 1:
            continue
        if node.attrs.get("transpose_a") or node.attrs.get("transpose_b"):
            continue
        bias = consumers[node.name][0]
        if bias.op != "BiasAdd" or node_of(bias.inputs[0]) != node.name or graph.constant(bias.inputs[1]) is None:
            continue
        last, names = bias, ["BiasAdd"]
        readers = consumers[bias.name]
        if bias.name not in outputs and len(readers) == 1 and activations and op_of(readers[0]).tfjs_fuses:
            last, names = readers[0], ["BiasAdd", readers[0].op]
        replaced[last.name] = Node(
            last.name,
            op_of(node).fused,
            (*node.inputs, bias.inputs[1]),
            {**node.attrs, "num_args": 1, "fused_ops": tuple(names), "epsilon": 0.0001},
            origin=last.origin,
        )
        swallowed |= {node.name, bias.name} - {last.name}
    if not replaced:
        return graph
    editor = Editor(graph)
    for node in graph.nodes:
        if node.name not in swallowed:
            editor.keep(replaced.get(node.name, node))
    return editor.graph()
