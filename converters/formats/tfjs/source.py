"""A TensorFlow.js model as a source: its folder, or its model.json."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.passes.int8_products import join_products
from export_model.converters.files.fetch import Fetched
from export_model.converters.formats.embed import contract_of, facts_of, redrawn
from export_model.converters.formats.saved_model.signature import expose_signature
from export_model.converters.formats.source import ReadOptions, SourceModel
from export_model.converters.formats.tfjs.reader import content_of, model_file, read_model, weights_of
from export_model.converters.formats.tfjs.unfuse import unfuse
from export_model.converters.graph.nodes import Graph, NameScope, Node, topological
from export_model.signatures.contract import Contract


def read(given: Fetched, options: ReadOptions) -> list[SourceModel]:
    """The model's signature as a policy; one that this tool wrote is what its contract says."""
    content = content_of(given)
    if "node" not in content["modelTopology"]:
        return [_read_layers_model(content, given)]
    model = read_model(given)
    graph = unfuse(model.graph)
    if model.contract is None:
        graph, facts = expose_signature(graph, model.signature)
        return [SourceModel(graph, model.files, facts)]
    contract = contract_of(model.contract)
    graph = _cast_to_contract(redrawn(join_products(graph), contract), contract)
    return [SourceModel(graph, model.files, facts_of(graph, contract), contract.name)]


def _read_layers_model(content: Mapping[str, Any], given: Fetched) -> SourceModel:
    """A layers model: Keras' layers, and weights under their names."""
    from export_model.converters.formats.keras.source import of_web_model
    from export_model.converters.formats.keras.weights import Listed

    file = model_file(given.path)
    weights, shards = weights_of(content.get("weightsManifest") or [], given, file.parent)
    files, topology = (file, *shards), content["modelTopology"]
    return of_web_model(files, topology, Listed([*weights.items()]), content.get("trainingConfig"))


#: The dtypes that TensorFlow.js has.
_NARROW = ("float32", "int32", "bool")


def _cast_to_contract(graph: Graph, contract: Contract) -> Graph:
    """The graph with inputs and outputs in the dtypes of the contract, for a format that has not all of them.

    TensorFlow.js has no int64: what was narrowed to int32 is cast, behind an input and before an output.
    """
    scope = NameScope(n.name for n in graph.nodes)
    names = [s.name for s in (*contract.signature.inputs, *contract.signature.outputs) if s.dtype not in _NARROW]
    inner = {name: scope.fresh(f"{name}/narrow") for name in names if name in graph}
    nodes = {n.name: n for n in graph.rename(inner).nodes}
    for spec in contract.signature.inputs:
        if spec.name in inner:
            node = nodes[inner[spec.name]]
            cast = Node(node.name, "Cast", (spec.name,), {"DstT": node.attrs["dtype"]})
            wide = replace(node, name=spec.name, attrs={**node.attrs, "dtype": np.dtype(spec.dtype)})
            nodes.update({node.name: cast, spec.name: wide})
    for spec in contract.signature.outputs:
        if spec.name in inner:
            node = nodes[inner[spec.name]]
            attrs = {"DstT": np.dtype(spec.dtype)}
            nodes[spec.name] = Node(spec.name, "Cast", (node.name,), attrs, origin=node.origin)
    return Graph(topological(list(nodes.values())))
