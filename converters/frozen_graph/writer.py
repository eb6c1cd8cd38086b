"""Policy to ``<policy>.bytes``: a frozen GraphDef that loads in every TensorFlow from 1.4 on."""

from __future__ import annotations

from converters import schema
from converters.bundle.embed import with_contract
from converters.detached import Detached
from converters.format import WriteOptions
from converters.frozen_graph.encode import encode
from converters.pieces import Pieces
from converters.policy import Policy


def write(policy: Policy, options: WriteOptions) -> dict[str, Pieces]:
    """The ``.bytes`` artefact."""
    return {f"{policy.name}.bytes": frozen(policy, options.contract)}


def frozen(policy: Policy, contract: str = "{}") -> Pieces:
    """The policy's GraphDef with its contract; without one, as the numpy reference needs it."""
    detached = Detached()
    return schema.pieces(encode(with_contract(policy.graph, contract), detached=detached), detached)
