"""The numpy reference in its own process: a frozen graph of ours, run by the kernels of the op table.

A ``.nn`` of ours runs here as well, through this project's reader, since no runtime outside Unity has it.

``python -m converters.runtimes.numpy.child``
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from converters.bundle.embed import read_runnable
from converters.graph.nodes import Graph
from converters.graph.ops.samplers import reseed
from converters.graph.run import run_graph
from converters.runtimes.child import claim_stdout, serve
from converters.runtimes.wire import Tensors
from signatures.errors import ExportModelError


class _Model:
    def __init__(self, graph: Graph) -> None:
        self.graph = graph

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        jitter = request.get("jitter")
        return run_graph(self.graph, feeds, fetch, None if jitter is None else np.random.default_rng(jitter))


class _NnModel:
    def __init__(self, data: bytes) -> None:
        from converters.barracuda.answers import NnPolicy

        self.policy = NnPolicy(data)

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        jitter = request.get("jitter")
        return self.policy.run(feeds, fetch, None if jitter is None else np.random.default_rng(jitter))


def _load(header: Mapping[str, Any]) -> _Model | _NnModel:
    reseed(int(header.get("seed", 0)))
    data = Path(header["path"]).read_bytes()
    return _NnModel(data) if header["path"].endswith(".nn") else _Model(read_runnable(data))


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    serve("numpy", np.__version__, _load, (ExportModelError,), out)


if __name__ == "__main__":
    main()
