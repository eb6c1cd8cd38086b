"""A policy: the hub where every reader ends and every writer starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from converters.graph.nodes import Graph
from signatures.spec import PolicySignature, SourceMap


@dataclass(frozen=True, slots=True)
class Policy:
    """A graph with its signature: the hub between all readers and all writers.

    ``feeds`` maps an input's canonical name to the Placeholder that takes it, ``fetches`` an output's canonical name
    to the tensor that gives it. After the naming pass both map names to themselves.
    """

    name: str
    graph: Graph
    signature: PolicySignature
    feeds: Mapping[str, str]
    fetches: Mapping[str, str]
    source: SourceMap = field(default_factory=SourceMap)
