"""The reference: the source in a runtime that reads it by itself, where one does, the numpy kernels for the rest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from converters.graph.nodes import Graph
from converters.graph.ops.samplers import SAMPLERS
from converters.runtimes.pool import RuntimePool
from converters.runtimes.process import LoadedModel, RunFailedError
from exporter.verify.findings import Failure, failure
from exporter.verify.original import Original
from exporter.verify.participants import PolicyUnderTest, unload

Arrays = Mapping[str, np.ndarray]


class Reference:
    """What all others are held against; to leave the context frees it. Raises RunFailedError where numpy fails."""

    def __init__(self, tested: PolicyUnderTest, runtimes: Sequence[str], pool: RuntimePool, seed: int) -> None:
        self.signature = tested.signature
        #: the numpy kernels, in their child
        # A bundle of one format that no other runtime runs (a .nn) is its own reference.
        form = next((kind for kind, path in tested.artefacts.items() if path == tested.reference), "bytes")
        self.model: LoadedModel = pool.process("numpy").load(str(tested.reference), seed=seed, format=form)
        self.original: Original | None = None
        #: outputs that a sampler in the graph decides
        self.drawn = random_outputs(tested.graph, [s.name for s in self.signature.outputs])
        #: what the source's own runtime refused
        self.failures: list[Failure] = []
        self.name = "numpy"
        self._loaded = [self.model]
        source = tested.source
        if source is None or source.runtime not in runtimes:
            return
        try:
            with source.loadable() as (path, options):
                model = pool.process(source.runtime).load(path, **options)
        except RunFailedError as error:
            self.failures.append(failure("source", source.runtime, error))
            return
        self._loaded.append(model)
        self.original = Original(model, self.signature, tested.source_map)
        self.name = f"source/{source.runtime}"

    @property
    def runtime(self) -> str:
        """The runtime that answers first."""
        return self.name.split("/")[-1]

    def answers(self, feeds: Arrays) -> dict[str, np.ndarray]:
        """The outputs that are not drawn; the numpy kernels answer for what the source cannot be asked."""
        answers = {} if self.original is None else self.original.run(feeds)
        rest = [s.name for s in self.signature.outputs if s.name not in answers and s.name not in self.drawn]
        if rest:
            answers.update(self.model.run(feeds, rest))
        return answers

    def __enter__(self) -> Reference:
        return self

    def __exit__(self, *error: object) -> None:
        for model in self._loaded:
            unload(model)


def random_outputs(graph: Graph, names: Iterable[str]) -> frozenset[str]:
    """The outputs that depend on a sampler inside the graph."""
    drawn = graph.descendants(n.name for n in graph.nodes if n.op in SAMPLERS)
    return frozenset(name for name in names if name in drawn)
