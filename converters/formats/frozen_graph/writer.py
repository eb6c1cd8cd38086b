"""Policy to ``<policy>.bytes``: a frozen GraphDef that loads in every TensorFlow from 1.4 on."""

from __future__ import annotations

from typing import Any

from export_model.converters.compiler.passes.weights import Storage, store_compactly
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.chunks import Pieces
from export_model.converters.files.external_data import Detached, is_readable
from export_model.converters.formats.embed import with_contract
from export_model.converters.formats.format import WriteOptions
from export_model.converters.formats.frozen_graph.encode import encode
from export_model.converters.graph.nodes import Graph
from export_model.converters.policy.policy import Policy
from export_model.signatures.errors import TooLargeError


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The ``.bytes`` artefact. Raises TooLargeError where no TensorFlow could read it."""
    made = frozen_graph(policy, options.contract, options.weights)
    if not is_readable(made):
        raise TooLargeError(
            f"a .bytes of {made.size} bytes cannot be read",
            where=policy.name,
            why="it is one protobuf message, which may have no more than 2 GiB",
            fix="write the other formats: --to saved_model,tfjs,onnx",
        )
    return {f"{policy.name}.bytes": made}


def frozen_graph(policy: Policy, contract: str = "{}", weights: Storage = "float32") -> Pieces:
    """The policy's GraphDef with its contract; without one, as the numpy reference needs it."""
    return serialise_graph(policy.graph, contract, weights)


def serialise_graph(graph: Graph, contract: str, weights: Storage) -> Pieces:
    """A graph as a GraphDef with the contract, made once."""
    made: dict[Any, Pieces] = graph.cache
    key = serialise_graph, contract, weights
    if key not in made:
        stored = with_contract(store_compactly(graph, weights), contract)
        detached = Detached.of(stored.values())
        made[key] = schema.pieces(encode(stored, detached=detached), detached)
    return made[key]
