"""Compute what does not depend on an input; give every Reshape a constant shape.

Precondition: no control flow. Postcondition: a node whose result is known is a Const; a Reshape whose target depends
on the batch alone has -1 there. Transcendental functions are folded in float64 and rounded once; matrix products and
samplers are never folded, so the bytes do not depend on the processor.
"""

from __future__ import annotations

import numpy as np

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, ref
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import infer_types, outputs_of
from export_model.converters.graph.types import INT32


def fold(graph: Graph) -> Graph:
    """See the module."""
    types = infer_types(graph)
    editor = Editor(graph)
    for node in graph.nodes:
        if op_of(node).start:
            editor.keep(node)
            continue
        constants = [types[ref(node.name, i)].constant for i in range(outputs_of(types, node.name))]
        if all(c is not None for c in constants):
            for i, constant in enumerate(constants):
                assert constant is not None
                if i == 0:
                    editor.replace_const(node.name, np.asarray(constant), node.origin)
                else:
                    editor.redirect(ref(node.name, i), editor.const(np.asarray(constant), f"{node.name}/{i}"))
        elif node.op == "Reshape" and (target := types[node.inputs[1]].value) is not None and target.dtype == object:
            cells = target.reshape(-1).tolist()
            if -1 in cells and graph.producer(node.inputs[1]).op != "Pack":
                # What is left of the operand may be known. tf.layers.flatten packs it, which Unity has played as it is.
                cells = list(types[node.name].shape or cells)
            open_axes = [c for c in cells if isinstance(c, str)]
            if len(open_axes) == 1 and -1 not in cells:
                shape = np.array([-1 if isinstance(c, str) else int(c) for c in cells], INT32)
                constant_shape = editor.const(shape, f"{node.name}/shape")
                editor.keep(node.with_inputs((node.inputs[0], constant_shape)))
            else:
                editor.keep(node)
        else:
            editor.keep(node)
    return editor.graph()
