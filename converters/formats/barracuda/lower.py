"""A policy as the layers of a ``.nn``, under the names and in the shapes that it has.

Where the axes of its inputs lie in a file is the format's to say: images [N, H, W, C], buffers [N, 1, W, C] with the
graph's [B, C, W], rows of numbers along C. A memory that Barracuda carries by itself (``Policy.kept``) is a row; one
that ML-Agents feeds and reads, from API version 3 on, is [N, 1, M, 1] (``RecurrentInputGenerator``,
``TensorProxy.ResizeTensor`` of 2.0 to 2.3). What a consumer calls them: ``converters/consumers/mlagents``.
"""

from __future__ import annotations

from export_model.converters.compiler.targets import BARRACUDA, prepare
from export_model.converters.formats.barracuda.assemble import assemble
from export_model.converters.formats.barracuda.format import NnInput, NnMemory, NnModel, draws_in_model
from export_model.converters.formats.barracuda.lower_graph import lower_graph
from export_model.converters.graph.nodes import Node, node_of
from export_model.converters.graph.ops.barracuda.arrays import as_row
from export_model.converters.graph.ops.barracuda.builder import NnBuilder
from export_model.converters.graph.ops.barracuda.values import FREE, Axes, Value, usual_axes
from export_model.converters.graph.ops.barracuda.vocabulary import C, H, LayerType, N, W
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import BATCH, Dim
from export_model.converters.policy.policy import Policy
from export_model.signatures.roles import VERSION_NUMBER, Role
from export_model.signatures.spec import PolicySignature, TensorSpec

_ROW: Axes = (N, C)
_IMAGE: Axes = (N, H, W, C)
#: How a memory [N, 1, M, 1] becomes a row [N, 1, 1, M], and back. Barracuda 1.4.0 and 2.0.0 leave a Flatten of it as it
#: is, so that what reads it throws (../shared/unity/r3/cases/recurrent_nn_barracuda-1.4); a Transpose of W and C is
#: right in 1.4.0 to 3.0.0 (../shared/unity/onnx_rules, Squeeze_01 and Unsqueeze_01, which are imported as that layer).
_SWAP_W_AND_C = (N, H, C, W)


def policy_model(policy: Policy) -> NnModel:
    """The policy as a model of version 16. Raises UnsupportedOpError."""
    signature, constants = policy.signature, policy.constants
    graph = prepare(policy, BARRACUDA)
    names = [s.name for s in (*signature.inputs, *signature.outputs)]
    version = constants.get(VERSION_NUMBER)
    draws = version is not None and draws_in_model(int(version.reshape(())))
    b = NnBuilder(infer_types(graph), [*names, *constants], draws=draws)
    laid = {s.name: _as_fed(b, s, signature) for s in signature.inputs if s.name in policy.feeds}
    given = {node_of(policy.feeds[name]): _input(b, name, value) for name, value in laid.items()}
    values = lower_graph(b, graph, given, policy.fetches.values())
    for spec in signature.outputs:
        b.node = Node(spec.name, "Identity")
        row = as_row(b, values[policy.fetches[spec.name]])
        name = b.stored_name(row)
        if spec.role is Role.MEMORY_OUT and spec.name not in policy.kept.values():
            name = b.layer(LayerType.TRANSPOSE, [name], (FREE, 1, row.size, 1), pool=_SWAP_W_AND_C, label="rows")
        b.name_tensor(spec.name, name)
    return assemble(
        b,
        [NnInput(name, value.dims) for name, value in laid.items() if name not in policy.kept],
        [s.name for s in signature.outputs if s.name not in policy.kept.values()],
        constants,
        [NnMemory((1, 1, 1, laid[taken].size), taken, given) for taken, given in policy.kept.items()],
    )


def _as_fed(b: NnBuilder, spec: TensorSpec, signature: PolicySignature) -> Value:
    """An input as it lies in the file. Raises UnsupportedOpError where it has no row of known length per agent."""
    shape: tuple[Dim, ...] = (BATCH, *(d or 0 for d in spec.shape[1:]))
    if not spec.batched or 0 in shape:
        b.node = Node(spec.name, "Placeholder")
        raise b.nn_error(f"it has the shape {list(spec.shape)}", "an input has a row per agent, of a known length")
    if spec.role is Role.VISUAL:
        turned = signature.preprocess.get(spec.name, {}).get("layout") == "NCHW"
        return Value(shape, (N, C, H, W) if turned else _IMAGE)
    if spec.is_sequence:
        return Value(shape, (N, C, W))
    if spec.role is Role.MEMORY_IN and len(shape) == 3:
        return Value(shape, (N, None, W))
    axes = _ROW if len(shape) == 2 else usual_axes(shape)
    assert axes is not None, spec
    return Value(shape, axes)


def _input(b: NnBuilder, name: str, value: Value) -> Value:
    """An input as the graph takes it: a memory along C, where it is cut as it was before there was a W."""
    b.note_input(name, value.dims)
    if value.axes != (N, None, W):
        return b.layer_value(name, value.shape, value.axes)
    b.node = Node(name, "Placeholder")
    flat = b.layer(LayerType.TRANSPOSE, [name], (FREE, 1, 1, value.size), pool=_SWAP_W_AND_C, label="row")
    return b.layer_value(flat, value.shape, (N, None, C))
