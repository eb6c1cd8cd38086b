"""The reference: the source in a runtime that reads it by itself, where one does, the numpy kernels for the rest."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path

import numpy as np

from export_model.converters.consumers.named_files import answered_outputs
from export_model.converters.files.children.process import LoadedModel, RunFailedError
from export_model.converters.formats.registry import FROZEN_GRAPH, WRITTEN
from export_model.converters.graph.nodes import Graph
from export_model.converters.graph.ops.samplers import SAMPLERS
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.verify.baked import apply_stated
from export_model.exporter.verify.findings import Undecided, undecided_reference
from export_model.exporter.verify.original import Original
from export_model.exporter.verify.participants import Participant, PolicyUnderTest
from export_model.signatures.roles import Role

Arrays = Mapping[str, np.ndarray]
Answers = list[dict[str, np.ndarray]]


class Reference(AbstractContextManager["Reference"]):
    """What all others are held against; to leave the context frees it. Raises RunFailedError where numpy fails."""

    def __init__(self, tested: PolicyUnderTest, runtimes: Sequence[str], pool: RuntimePool, seed: int) -> None:
        self.signature = tested.signature
        #: the numpy kernels, in their child
        # A bundle of one format that no other runtime runs (a .nn) is its own reference.
        form = next((kind for kind, path in tested.artefacts.items() if path == tested.reference), FROZEN_GRAPH.key)
        self.model: LoadedModel = pool.process("numpy").load(str(tested.reference), seed=seed, format=form)
        self.original: Original | None = None
        #: outputs that a sampler in the graph decides
        self.drawn = random_outputs(tested.graph, [s.name for s in self.signature.outputs])
        #: what the source's own runtime refused
        self.failures: list[Undecided] = []
        self.name = "numpy"
        #: the outputs that the source answered for
        self._given: frozenset[str] = frozenset()
        #: the outputs that the kernels have
        self.asked = answered_outputs(WRITTEN[form], self.signature, tested.code)
        #: id of inputs → these, and what the kernels answered
        self._known: dict[int, tuple[Arrays, dict[str, np.ndarray]]] = {}
        self._loaded = [self.model]
        source = tested.source
        if source is None or source.runtime not in runtimes:
            return
        try:
            with source.loadable() as (path, options):
                model = pool.process(source.runtime).load(path, **options)
        except RunFailedError as error:
            self.failures.append(undecided_reference("source", source.runtime, error))
            return
        self._loaded.append(model)
        stated = None if tested.before is None else partial(apply_stated, tested.before.signature)
        self.original = Original(model, self.signature, tested.source_map, stated)
        self.name = f"source/{source.runtime}"

    def participant(
        self, name: str, outputs: Sequence[str], *, runtime: str = "numpy", path: Path | None = None
    ) -> Participant:
        """The kernels as one that takes part, for these outputs."""
        return Participant(format=name, runtime=runtime, run=self.run, outputs=outputs, model=self.model, path=path)

    @property
    def runtime(self) -> str:
        """The runtime that answers first."""
        return self.name.split("/")[-1]

    def answers(self, inputs: Sequence[Arrays]) -> Answers:
        """The outputs that are not drawn; the numpy kernels answer for what the source cannot be asked."""
        answers: Answers = [{} for _ in inputs] if self.original is None else self.original.run_all(inputs)
        given = answers[0] if answers else {}
        self._given |= given.keys()
        rest = [s.name for s in self.signature.outputs if s.name not in given and s.name not in self.drawn]
        if rest:
            for answer, own in zip(answers, self.run(inputs, rest), strict=True):
                answer.update(own)
        return answers

    def apart(self) -> frozenset[str]:
        """The requested draws whose odds no tensor of the source tells, and what else of them the kernels answered for.

        The kernels answered in the source's stead. Empty where the source takes no part: what all is held against says
        it then.
        """
        if self.original is None:
            return frozenset()
        told = any(s.role is Role.LOG_PROBS and s.name in self._given for s in self.signature.outputs)
        heads = [h for h in self.signature.heads if h.name in self.drawn and not (h.spec.role is Role.SAMPLED and told)]
        drawn = {h.name for h in heads}
        follow = {h.plain.name for h in heads if h.plain is not None}
        if any(h.spec.role is Role.SAMPLED for h in heads):
            follow |= {s.name for s in self.signature.outputs if s.role is Role.LOG_PROBS}
        return frozenset(drawn | (follow - self._given))

    def remember(self, inputs: Sequence[Arrays]) -> None:
        """Have the kernels answer for inputs that are asked about several times."""
        with suppress(RunFailedError):  # who asks again is told
            found = self.model.run_all(inputs, self.asked)
            self._known.update({id(i): (i, answer) for i, answer in zip(inputs, found, strict=True)})

    def run(self, inputs: Sequence[Arrays], fetch: Sequence[str]) -> Answers:
        """What the kernels answer."""
        known = [self._known[id(feeds)][1] for feeds in inputs if id(feeds) in self._known]
        if len(known) < len(inputs) or any(name not in self.asked for name in fetch):
            return self.model.run_all(inputs, fetch)
        return [{name: answer[name] for name in fetch} for answer in known]

    def __exit__(self, *error: object) -> None:
        for model in self._loaded:
            model.unload()


def random_outputs(graph: Graph, names: Iterable[str]) -> frozenset[str]:
    """The outputs that depend on a sampler inside the graph."""
    drawn = graph.descendants(n.name for n in graph.nodes if n.op in SAMPLERS)
    return frozenset(name for name in names if name in drawn)
