"""A policy: the hub where every reader ends and every writer starts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from msgspec import Struct, field

from export_model.converters.graph.nodes import Graph
from export_model.signatures.spec import PolicySignature, SourceMap


class Policy(Struct, frozen=True):
    """A graph with its signature: the hub between all readers and all writers.

    ``feeds`` maps an input's canonical name to the Placeholder that takes it, ``fetches`` an output's canonical name
    to the tensor that gives it. After the naming pass both map names to themselves. ``constants`` are outputs that are
    the same in every run and that a consumer reads beside the actions (``version_number``). ``kept`` are memories that
    the consumer's runtime carries from step to step by itself: the input, and the output that is its next value.
    """

    name: str
    graph: Graph
    signature: PolicySignature
    feeds: Mapping[str, str]
    fetches: Mapping[str, str]
    source: SourceMap = field(default_factory=SourceMap)
    constants: Mapping[str, np.ndarray] = field(default_factory=dict)
    kept: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Policy {self.name!r}: {self.signature.flow}, {len(self.graph.nodes)} nodes>"
