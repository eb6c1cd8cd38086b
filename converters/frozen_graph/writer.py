"""Policy to ``<policy>.bytes``: a frozen GraphDef that loads in every TensorFlow from 1.4 on."""

from __future__ import annotations

from converters import schema
from converters.format import WriteOptions
from converters.frozen_graph.encode import encode, string_constant
from converters.graph.compile import CONTRACT_NODE
from converters.graph.nodes import Graph
from converters.policy import Policy


def with_contract(graph: Graph, contract: str) -> Graph:
    """The graph with the contract as an unconnected string constant."""
    return Graph((*graph.nodes, string_constant(CONTRACT_NODE, contract)))


def write(policy: Policy, options: WriteOptions) -> dict[str, bytes]:
    """The ``.bytes`` artefact."""
    return {f"{policy.name}.bytes": frozen(policy, options.contract)}


def frozen(policy: Policy, contract: str = "{}") -> bytes:
    """The policy's GraphDef with its contract; without one, as the numpy reference needs it."""
    return schema.serialise(encode(with_contract(policy.graph, contract)))
