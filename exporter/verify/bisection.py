"""Where a disagreement begins: the first tensor in graph order that differs in that runtime.

Expected values are those of the numpy kernels on a graph that agrees with the reference, the candidate's are fetched
from the runtime, for the same inputs. A constant must be the same to the bit; of everything else as much as of the
outputs is asked, rounding allowed for. What comes after a sampler in the graph cannot be compared.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from msgspec import Struct

from export_model.converters.files.children.process import RunFailedError
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.frozen_graph.reader import read_graph
from export_model.converters.formats.intermediate_tensors import InnerTensors
from export_model.converters.formats.registry import WRITTEN
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.samplers import SAMPLERS
from export_model.converters.graph.ops.table import traits
from export_model.converters.graph.run import run_graph
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.verify.difference import ONE_SIDED, Difference, compare
from export_model.exporter.verify.findings import Bisection
from export_model.exporter.verify.inner_tensors import inner_tensors, outputs_read
from export_model.exporter.verify.participants import Feeds, Participant, PolicyUnderTest
from export_model.exporter.verify.tolerances import Tolerance
from export_model.signatures.errors import ExportModelError

#: Bytes of expected values that one fetch may ask for: what a runtime holds and sends at a time.
FETCH_BYTES = 64 << 20

#: What rounding explains of a tensor of a graph, for inputs.
Rounding = Callable[[Graph, Feeds, str], np.ndarray]


class Bisector:
    """Bisects the failures of one policy.

    ``agrees`` says whether a graph, run by the numpy kernels, is right; ``rounding`` what it explains, in a runtime, of
    a tensor of a graph for inputs.
    """

    def __init__(
        self,
        tested: PolicyUnderTest,
        pool: RuntimePool,
        agrees: Callable[[Graph], bool],
        rounding: Callable[[str, Graph, Feeds, str], np.ndarray],
    ) -> None:
        self.tested, self.pool = tested, pool
        self._agrees, self._rounding = agrees, rounding
        self._opened: tuple[tuple[str, str], InnerTensors] | None = None
        self._stack = contextlib.ExitStack()
        #: artefacts whose constants were compared
        self.compared: set[Path] = set()

    def close(self) -> None:
        """Free what was loaded to look inside."""
        self._opened = None
        self._stack.close()

    def find(
        self, participant: Participant, output: str, feeds: Feeds, tolerance: Tolerance, branch: int = 0
    ) -> Bisection:
        """Where ``output`` of ``participant`` begins to differ for ``feeds``; ``branch`` is the one drawn wrongly."""
        graph = None if participant.path is None else self.graph
        if graph is None:
            return Bisection(None, reason="no graph at hand computes what the reference does")
        try:
            rounding = partial(self._rounding, participant.runtime)
            search = _Search(graph, self._within(participant), feeds, tolerance, rounding, self.source_of)
            return search.first(output, branch)
        except (ExportModelError, OSError) as error:
            why = getattr(error, "why", None)
            return Bisection(None, reason=f"the inside could not be looked at: {error if why is None else why}")

    def constants(self, participant: Participant, feeds: Feeds) -> list[Bisection]:
        """The policy's numbers that ``participant`` has otherwise, to the last bit; none where it cannot be told.

        Weights that were rounded change outputs by less than any tolerance where these hardly vary. A format is looked
        at in the first runtime that runs it.
        """
        if participant.path is None or participant.fed is not None or participant.path in self.compared:
            return []
        self.compared.add(participant.path)
        if not self._differing(self._runnable, participant, feeds):
            return []
        graph = self.graph  # a bundle's graph is that of its .bytes, which may be what is wrong
        return [] if graph is None else self._differing(graph, participant, feeds)

    def _differing(self, graph: Graph, participant: Participant, feeds: Feeds) -> list[Bisection]:
        upstream = graph.ancestors([s.name for s in self.tested.signature.outputs])
        known = {n.name: n.value for n in graph.nodes if n.name in upstream and n.value is not None}
        known = {name: value for name, value in known.items() if value.dtype.kind == "f" and value.size}
        found = []
        try:
            inner = self._within(participant)
            for chunk in _chunks(list(known), known):
                found += self._unequal(graph, known, inner.fetch(feeds, chunk))  # freed before the next is fetched
        except (ExportModelError, OSError):
            return found
        return found

    def _unequal(self, graph: Graph, known: Feeds, got: Feeds) -> list[Bisection]:
        found = []
        for name, array in got.items():
            if array.dtype == known[name].dtype and np.array_equal(array, known[name]):
                continue
            difference = compare(known[name], array, Tolerance(0, 0))
            if not difference.passed:
                found.append(_bisection_at(graph.producer(name), name, known[name], array, difference, self.source_of))
        return found

    @cached_property
    def graph(self) -> Graph | None:
        """The first graph that agrees with the reference: the policy's, the .bytes', another file's."""
        return next((g for g in self._graphs() if self._agrees(g)), None)

    def _graphs(self) -> Iterator[Graph]:
        yield self._runnable
        with contextlib.suppress(ExportModelError, OSError):
            yield runnable(read_graph(self.tested.reference.read_bytes()))
        for key, path in self.tested.artefacts.items():
            read = WRITTEN[key].graph
            if read is not None and path != self.tested.reference:
                with contextlib.suppress(ExportModelError, OSError):
                    yield runnable(read(path))

    @cached_property
    def _runnable(self) -> Graph:
        return runnable(self.tested.graph)

    def _within(self, participant: Participant) -> InnerTensors:
        key = (participant.name, participant.runtime)
        if self._opened is None or self._opened[0] != key:
            self.close()
            assert participant.path is not None
            nodes = () if participant.fed is None else self.tested.graph.nodes
            origins = {n.name: n.origin for n in nodes if isinstance(n.origin, str)}
            found = self._stack.enter_context(inner_tensors(participant, participant.path, self.pool, origins))
            self._opened = (key, found)
        return self._opened[1]

    @cached_property
    def _origins(self) -> dict[str, str]:
        """Node → the source's tensor, as the artefacts note it."""
        found: dict[str, str] = {}
        for key, path in self.tested.artefacts.items():
            origins = WRITTEN[key].origins
            with contextlib.suppress(ValueError, OSError):
                found.update({} if origins is None else origins(path))
        return found

    def source_of(self, node: Node) -> str | tuple[str, ...] | None:
        """Return the source's tensor: what the graph knows of it, else what an artefact notes."""
        if node.origin is None or node.origin == f"{node.name}:0":
            return self._origins.get(node.name, node.origin)
        return node.origin


class _Suspect(Struct, frozen=True):
    """A tensor with a NaN or infinity on one side, and those that differ because of it: what reads it may clip it."""

    begins: Bisection
    reached: set[str]


class _Search(Struct, frozen=True, eq=False):
    graph: Graph
    candidate: InnerTensors
    feeds: Feeds
    tolerance: Tolerance
    rounding: Rounding
    source: Callable[[Node], str | tuple[str, ...] | None]

    def first(self, output: str, branch: int) -> Bisection:
        upstream = self.graph.ancestors([output])
        nodes = [n for n in self.graph.nodes if n.name in upstream]
        samplers = [n for n in nodes if n.op in SAMPLERS]
        drawn = self.graph.descendants(n.name for n in samplers)
        read = outputs_read([n.name for n in nodes], [output, *(r for n in nodes for r in n.inputs)])
        tensors = [t for n in nodes if n.name not in drawn for t in read[n.name]]
        expected = run_graph(self.graph, self.feeds, tensors)
        if (begins := self._begin(tensors, expected, output)) is not None:
            return begins
        if samplers:  # one for each branch, in their order; a joint one for all
            sampler = samplers[min(branch, len(samplers) - 1)]
            reason = "what it draws from agrees, what it draws does not"
            return Bisection(sampler.name, sampler.op, self.source(sampler), reason=reason)
        return Bisection(None, reason="no tensor that leads to it differs by more than the tolerance")

    def _begin(self, tensors: Sequence[str], expected: Feeds, output: str) -> Bisection | None:
        """The first of ``tensors`` that differs; with a NaN or infinity on one side, one that reaches ``output``."""
        seen: set[str] = set()
        suspects: list[_Suspect] = []
        for chunk in _chunks(tensors, expected):
            got = self._fetch(chunk)
            seen |= got.keys()
            for tensor in chunk:
                found = self._wrong(tensor, expected[tensor], got[tensor], seen) if tensor in got else None
                if tensor in got and found is None:
                    continue
                inputs = self.graph.producer(tensor).inputs
                behind = [s for s in suspects if not s.reached.isdisjoint(inputs)]
                for suspect in behind:
                    suspect.reached.add(tensor)
                if found is not None and not behind:
                    suspects.append(_Suspect(found, {tensor}))
                if found is not None and suspects[0].begins.reason != ONE_SIDED:
                    return suspects[0].begins
        return next((s.begins for s in suspects if output in s.reached), suspects[0].begins if suspects else None)

    def _fetch(self, tensors: Sequence[str]) -> dict[str, np.ndarray]:
        """The candidate's values; one that it cannot give is left out, as one that it has not."""
        try:
            return self.candidate.fetch(self.feeds, tensors)
        except RunFailedError:
            if len(tensors) == 1:
                return {}
            half = len(tensors) // 2
            return {**self._fetch(tensors[:half]), **self._fetch(tensors[half:])}

    def _wrong(self, tensor: str, expected: np.ndarray, got: np.ndarray, seen: set[str]) -> Bisection | None:
        node = self.graph.producer(tensor)
        if got.dtype != expected.dtype:  # int64 as int32 in TensorFlow.js; the outputs' dtypes are compared elsewhere
            narrow = np.promote_types(got.dtype, expected.dtype)
            got, expected = got.astype(narrow), expected.astype(narrow)
        if self.candidate.foreign and got.shape != expected.shape:
            return None  # it only has the name
        exact = bool(traits(node).start)
        difference = compare(expected, got, Tolerance(0, 0) if exact else self.tolerance)
        if difference.passed:
            return None
        if not exact and not difference.reason and expected.dtype.kind == "f":
            rounding = self.rounding(self.graph, self.feeds, tensor)
            difference = compare(expected, got, self.tolerance, rounding=rounding)
            if difference.passed:
                return None
        hidden = tuple(r for r in dict.fromkeys(node.inputs) if r not in seen and not self._is_setting(r))
        return _bisection_at(
            node, tensor, expected=expected, got=got, difference=difference, source=self.source, hidden=hidden
        )

    def _is_setting(self, tensor: str) -> bool:
        """An axis, a shape: other formats have it as an attribute."""
        value = self.graph.producer(tensor).value
        return value is not None and value.dtype.kind != "f"


def _bisection_at(
    node: Node,
    tensor: str,
    expected: np.ndarray,
    got: np.ndarray,
    difference: Difference,
    source: Callable[[Node], str | tuple[str, ...] | None],
    hidden: tuple[str, ...] = (),
) -> Bisection:
    at = difference.worst
    index = None if at is None else tuple(int(i) for i in np.unravel_index(at, expected.shape))
    return Bisection(
        tensor=tensor,
        op=node.op,
        source=source(node),
        index=index,
        expected=None if index is None else float(expected[index]),
        got=None if index is None else float(got[index]),
        max_abs_diff=difference.max_abs,
        smallest_tolerance=difference.smallest_tolerance,
        hidden=hidden,
        reason=difference.reason,
    )


def _chunks(tensors: Sequence[str], values: Mapping[str, np.ndarray]) -> Iterator[list[str]]:
    """``tensors`` in order, as many at a time as ``FETCH_BYTES`` hold."""
    chunk: list[str] = []
    size = 0
    for tensor in tensors:
        if chunk and size + values[tensor].nbytes > FETCH_BYTES:
            yield chunk
            chunk, size = [], 0
        chunk.append(tensor)
        size += values[tensor].nbytes
    if chunk:
        yield chunk
