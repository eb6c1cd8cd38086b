"""A policy in the names of API version 3 (ML-Agents from release 17 on) as a ``.nn``, which Barracuda 1.4 to 3.0 load.

What it takes and gives is what its ONNX does (``converters/targets/mlagents/version3.py``), laid out as that ONNX is
after its import: images [N, H, W, C], buffers [N, 1, W, C] with the graph's [B, C, W], ``recurrent_in`` and
``recurrent_out`` [N, 1, M, 1], which ML-Agents feeds and reads along W; it keeps the memory itself, so that the file
has no memories of its own (``RecurrentInputGenerator``, ``TensorProxy.ResizeTensor`` of 2.0 to 2.3).
"""

from __future__ import annotations

from converters.barracuda.assemble import assembled
from converters.barracuda.format import NnInput, NnModel
from converters.barracuda.lower_arrays import as_row
from converters.barracuda.lower_base import FREE, Axes, Dims, NnBuilder, Value
from converters.barracuda.lower_table import lower_graph
from converters.barracuda.vocabulary import C, H, LayerType, N, W
from converters.graph.nodes import Node, node_of
from converters.graph.passes.fuse import fuse
from converters.graph.shapes import infer_types
from converters.graph.types import BATCH, Dim
from converters.policy import Policy
from signatures.roles import Role
from signatures.spec import TensorSpec

#: Where the axes of an input lie; the others are rows of numbers, along C.
_AXES: dict[Role, Axes] = {Role.VISUAL: (N, C, H, W), Role.ENTITIES: (N, C, W), Role.MEMORY_IN: (N, None, W)}


def dressed_model(policy: Policy) -> NnModel:
    """The policy as a model of version 16. Raises UnsupportedOpError."""
    signature, constants = policy.signature, policy.constants
    graph = fuse(policy.graph, policy.fetches.values(), activations=False)
    names = [s.name for s in (*signature.inputs, *signature.outputs)]
    b = NnBuilder(infer_types(graph), [*names, *constants], draws=True)
    inputs = [NnInput(s.name, _as_fed(s).dims) for s in signature.inputs]
    given = {node_of(policy.feeds[s.name]): _input(b, s) for s in signature.inputs}
    values = lower_graph(b, graph, given, policy.fetches.values())
    for spec in signature.outputs:
        b.node = Node(spec.name, "Identity")
        row = as_row(b, values[policy.fetches[spec.name]])
        name = b.stored(row)
        if spec.role is Role.MEMORY_OUT:
            dims: Dims = (FREE, 1, row.size, 1)
            name = b.layer(LayerType.RESHAPE, [name], dims, pool=dims, label="rows")
        b.named(spec.name, name)
    return assembled(b, inputs, [s.name for s in signature.outputs], constants)


def _as_fed(spec: TensorSpec) -> Value:
    """An input as it lies in the file."""
    shape: tuple[Dim, ...] = (BATCH, *(d or 0 for d in spec.shape[1:]))
    return Value(shape, _AXES.get(spec.role, (N, C)))


def _input(b: NnBuilder, spec: TensorSpec) -> Value:
    """An input as the graph takes it: a memory along C, where it is cut as it was before there was a W."""
    value = _as_fed(spec)
    b.given(spec.name, value.dims)
    if spec.role is not Role.MEMORY_IN:
        return b.made(spec.name, value.shape, value.axes)
    b.node = Node(spec.name, "Placeholder")
    flat = b.layer(LayerType.FLATTEN, [spec.name], (FREE, 1, 1, value.size), label="row")
    return b.made(flat, value.shape, (N, None, C))
