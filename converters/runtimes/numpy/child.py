"""The numpy reference in its own process: a frozen graph of ours, run by the kernels of the op table.

What no other runtime loads (a ``.nn``, formats that name numpy alone) runs here as well, through its own reader.

``python -m export_model.converters.runtimes.numpy.child``
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from export_model.converters.consumers.named_files import kernels
from export_model.converters.files.children.child import claim_stdout, serve
from export_model.converters.files.children.frames import Tensors
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.format import Format
from export_model.converters.formats.registry import FROZEN_GRAPH, WRITTEN
from export_model.converters.graph.jitter import Jitter
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.ops.samplers import reseed
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.underflow import End, Whole
from export_model.signatures.errors import ExportModelError


class _Model:
    def __init__(self, compute: Callable[[Tensors, Sequence[str], Jitter | None], Tensors]) -> None:
        self.compute = compute

    def run(self, feeds: Tensors, fetch: Sequence[str], request: Mapping[str, Any]) -> Tensors:
        seed = request.get("jitter")
        jitter = None if seed is None else Jitter(seed, request.get("arithmetic", "processor"))
        if (end := request.get("end")) is not None:
            jitter = Whole(0) if end == "float64" else End(request["arithmetic"], kept=end == "kept")
        return self.compute(feeds, fetch, jitter)


def _load(header: Mapping[str, Any]) -> _Model:
    reseed(int(header.get("seed", 0)))
    path = Path(header["path"])
    form = WRITTEN[header["format"]] if "format" in header else FROZEN_GRAPH
    named = kernels(form, path)
    return _Model(partial(run_graph, runnable(_graph(path, form))) if named is None else named)


def _graph(path: Path, form: Format) -> Graph:
    """The graph of an artefact: of one in a format that no other runtime runs, as its own reader gives it."""
    if form.graph is not None:
        return form.graph(path)
    from export_model.converters.compiler.compile import compile_graph
    from export_model.converters.files.fetch import Fetched
    from export_model.converters.formats.source import ReadOptions

    assert form.read is not None, f"{form.key} is not read"
    (model,) = form.read(Fetched(path), ReadOptions())
    (policy,) = compile_graph(model.graph, "policy", None, model.facts)
    return policy.graph


def main() -> None:
    """Entry of the child process."""
    out = claim_stdout()
    serve("numpy", np.__version__, _load, (ExportModelError,), out)


if __name__ == "__main__":
    main()
