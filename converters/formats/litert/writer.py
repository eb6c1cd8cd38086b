"""Policy to a LiteRT model (``.tflite``), without TensorFlow: each node through its lowering in the op table.

Builtin operators alone, in the lowest versions that do; a free axis for the agents; each signature is a subgraph of its
own (``deterministic`` takes no noise), and they share the bytes of their constants. The contract is in the metadata.
"""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.compiler.targets import LITERT, prepare
from export_model.converters.files.chunks import Pieces
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.intermediate_tensors import View
from export_model.converters.formats.litert.flatbuffer import Table, encode
from export_model.converters.formats.litert.schema import VERSION
from export_model.converters.formats.litert.subgraph import Shared, Subgraph
from export_model.converters.formats.onnx.tensor_map import TENSORS_KEY, TensorMap
from export_model.converters.formats.saved_model.writer import signatures_of
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.policy import Policy
from export_model.signatures.contract import EMBEDDED
from export_model.signatures.spec import TensorSpec


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The LiteRT artefact. Raises UnsupportedOpError, TooLargeError."""
    graph = prepare(policy, LITERT)
    shared = Shared()
    subgraphs, signatures = list[Table](), list[Table]()
    turned: dict[str, View | None] = {}
    for key, (inputs, outputs) in signatures_of(policy).items():
        if signatures and (*inputs,) == policy.signature.inputs and (*outputs,) == policy.signature.outputs:
            signatures.append({**signatures[0], "signature_key": key})
            continue
        subgraph, signature, views = _function(policy, graph, inputs, outputs, shared, options)
        signatures.append({**signature, "signature_key": key, "subgraph_index": len(subgraphs)})
        subgraphs.append({**subgraph, "name": key})
        turned.update(views)
    notes = {EMBEDDED: options.contract, TENSORS_KEY: TensorMap(turned).dumps()}
    shared.drop_unread(tensor for subgraph in subgraphs for tensor in subgraph["tensors"])
    metadata = [{"name": name, "buffer": shared.text(text)} for name, text in notes.items() if text]
    model = {
        "version": VERSION,
        "operator_codes": shared.codes(),
        "subgraphs": subgraphs,
        "description": "export-model",
        "buffers": shared.buffers,
        "metadata": metadata,
        "signature_defs": signatures,
    }
    return {f"{policy.name}.tflite": encode(model)}


def _function(
    policy: Policy,
    graph: Graph,
    inputs: list[TensorSpec],
    outputs: list[TensorSpec],
    shared: Shared,
    options: WriteOptions,
) -> tuple[Table, Table, Mapping[str, View]]:
    """The subgraph of a signature, what the signature says of it, and which tensors have their axes otherwise."""
    fetches = [policy.fetches[s.name] for s in outputs]
    part = graph.prune(fetches)
    made = Subgraph(part, fetches, shared, options)
    fed = {s.name: made.input(s, policy.feeds[s.name]) for s in inputs if policy.feeds[s.name] in graph}
    for node in part.nodes:
        made.lower(node)
    given: dict[str, int] = {}
    for spec, reference in zip(outputs, fetches, strict=True):
        given[spec.name] = made.output(spec, reference, given.values())
    numbers = made.drop_unread([*given.values()], [*fed.values()])
    fed, given = ({name: numbers[v] for name, v in tensors.items()} for tensors in (fed, given))
    subgraph = {
        "tensors": made.tensors,
        "inputs": list(fed.values()),
        "outputs": list(given.values()),
        "operators": made.operators,
    }
    return subgraph, {"inputs": _map(fed), "outputs": _map(given)}, made.turned


def _map(tensors: dict[str, int]) -> list[Table]:
    return [{"name": name, "tensor_index": index} for name, index in tensors.items()]
