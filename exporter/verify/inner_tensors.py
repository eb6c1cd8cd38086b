"""Intermediate tensors of a participant, named as in the graph (converters/formats/intermediate_tensors.py)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from msgspec.structs import replace

from export_model.converters.formats.intermediate_tensors import InnerTensors, Loaded, View, no_tensors
from export_model.converters.formats.registry import FROZEN_GRAPH, WRITTEN
from export_model.converters.graph.nodes import ref, split_ref
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.verify.participants import Participant


@contextmanager
def inner_tensors(
    participant: Participant, path: Path, pool: RuntimePool, origins: Mapping[str, str] | None = None
) -> Iterator[InnerTensors]:
    """Those of ``participant``, whose file is ``path``. To enter it raises RunFailedError where it is not loaded.

    What any tool may have made is fed by its own names, and its tensors may be called as the source's (``origins``).
    """
    key, _, signature = participant.format.partition(":")
    model = participant.model
    loaded = Loaded(path, participant.runtime, model.run, model.run_all, pool, signature)
    form = WRITTEN.get(key, FROZEN_GRAPH)  # the reference and the original are frozen graphs
    with (form.inner or no_tensors)(loaded) as found:
        if participant.fed is None:
            yield found
            return
        own, run, view, origins = participant.fed, found.run, found.view, origins or {}

        def find_view(tensor: str) -> View | None:
            source = origins.get(tensor, tensor)
            names = (tensor, source, source.removesuffix(":0"), f"{source.removesuffix(':0')}:0")
            return next((v for name in names if (v := view(name)) is not None), None)

        yield replace(found, view=find_view, run=lambda feeds, fetch: run(own(feeds), fetch), foreign=True)


def outputs_read(nodes: Sequence[str], reads: Sequence[str]) -> dict[str, list[str]]:
    """Node → its tensors that something reads, output 0 where nothing does, in order."""
    found: dict[str, set[int]] = {name: set() for name in nodes}
    for reference in reads:
        name, index = split_ref(reference)
        if name in found:
            found[name].add(index)
    return {name: [ref(name, i) for i in sorted(indices or {0})] for name, indices in found.items()}
