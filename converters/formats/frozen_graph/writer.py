"""Policy to ``<policy>.bytes``: a frozen GraphDef that loads in every TensorFlow from 1.4 on."""

from __future__ import annotations

from typing import Any

from converters.compiler.passes.weights import Storage, store_compactly
from converters.files import tensorflow_messages as schema
from converters.files.chunks import Pieces
from converters.files.external_data import Detached, is_readable
from converters.formats.bundle.embed import with_contract
from converters.formats.format import WriteOptions
from converters.formats.frozen_graph.encode import encode
from converters.policy.policy import Policy
from signatures.errors import TooLargeError


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
    """The policy's GraphDef with its contract, made once; without one, as the numpy reference needs it."""
    made: dict[Any, Pieces] = policy.graph.cache
    key = frozen_graph, contract, weights
    if key not in made:
        graph = with_contract(store_compactly(policy.graph, weights), contract)
        detached = Detached.of(graph.values())
        made[key] = schema.pieces(encode(graph, detached=detached), detached)
    return made[key]
