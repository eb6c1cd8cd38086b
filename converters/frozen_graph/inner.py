"""The inner tensors of a frozen graph: any node can be fetched, by the graph's own name."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from contextlib import AbstractContextManager

import numpy as np

from converters import schema
from converters.detached import Detached
from converters.inner import Feeds, InnerTensors, Loaded, own_names


def inner(loaded: Loaded) -> AbstractContextManager[InnerTensors]:
    """Those of a ``.bytes``."""
    graph = schema.parse(schema.GraphDef, loaded.path.read_bytes(), "GraphDef", Detached())  # for its names alone

    def run(feeds: Feeds, fetch: Sequence[str]) -> dict[str, np.ndarray]:
        """TensorFlow 1.x refuses to fetch what it is fed, by the same name: it is what was fed."""
        others = [name for name in fetch if name not in feeds]
        values = {name: feeds[name] for name in fetch if name in feeds}
        return {**values, **loaded.run(feeds, others)} if others else values

    return contextlib.nullcontext(InnerTensors(own_names(n.name for n in graph.node), run))
