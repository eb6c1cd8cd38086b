"""Samplers as inputs: the policy, and an artefact of it, cut where they draw, so that what is drawn is numbers.

Both sides are given the same noise and the same classes; what comes of it is compared over every input, as all else is.
The scores that classes are drawn from become outputs, as the log-probabilities that they stand for. How a sampler
itself is distributed is another question (exporter/verify/checks/draws.py).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from functools import partial
from itertools import islice, permutations
from pathlib import Path

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.compiler.passes.noise import tensor_of
from export_model.converters.files import tensorflow_messages as schema
from export_model.converters.files.children.process import LoadedModel
from export_model.converters.files.external_data import Detached
from export_model.converters.formats.embed import runnable
from export_model.converters.formats.frozen_graph.encode import encode
from export_model.converters.formats.intermediate_tensors import InnerTensors, RunAll, Sampler
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, TensorShape
from export_model.converters.graph.ops.samplers import KINDS
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import static_shape
from export_model.converters.runtimes.pool import RuntimePool
from export_model.exporter.verify.inner_tensors import inner_tensors
from export_model.exporter.verify.participants import Feeds, Participant, PolicyUnderTest, Run
from export_model.signatures.batches import batches_of, put_together, rows_of
from export_model.signatures.roles import Role
from export_model.signatures.spec import TensorSpec

Arrays = dict[str, np.ndarray]
#: Log-probabilities below that of one in 10⁹ say "never": ML-Agents leaves masked actions about 10⁻¹⁰.
NEVER = float(np.log(1e-9))
#: The file that the numpy kernels run.
CUT = "cut.bytes"
#: Orders in which the samplers of a file that another tool wrote are tried, to find which is which.
_ORDERS = 24
#: Kind of a sampler → what it may draw, for a generator and a shape.
_DRAWS: dict[str, Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]] = {
    "uniform": lambda rng, shape: rng.random(shape),
    "truncated normal": lambda rng, shape: rng.uniform(-2, 2, shape),
    "categorical": lambda rng, shape: np.zeros(shape),
}


class CutSampler(Struct, frozen=True):
    """A sampler of the policy as an input (``spec``); ``odds`` is the output that has its log-probabilities."""

    spec: TensorSpec
    kind: str
    odds: TensorSpec | None = None
    #: the policy itself has it as an input
    given: bool = False

    @property
    def name(self) -> str:
        """The name of the input, which is that of the sampler's node."""
        return self.spec.name


class CutPolicy(Struct, frozen=True):
    """A policy under test whose samplers are inputs; ``actions`` says which outputs each sampler decides."""

    tested: PolicyUnderTest
    samplers: tuple[CutSampler, ...]
    actions: Mapping[str, Sequence[str]]

    def draw(self, inputs: Sequence[dict[str, np.ndarray]], model: LoadedModel, seed: int) -> None:
        """Put what samplers may draw into ``inputs``, each of every class that is allowed there. Raises RunFailedError.

        Noise of N(0, 1) is there already, as far out as the noise of any policy is tried. A class may decide what the
        next one is drawn from.
        """
        rng, signature = np.random.default_rng([seed, 3]), self.tested.signature
        for feeds in inputs:
            for sampler in self.samplers:
                if sampler.kind != "normal":
                    shape = (signature.rows(feeds), *(n or 1 for n in sampler.spec.shape[1:]))
                    feeds[sampler.name] = _DRAWS[sampler.kind](rng, shape).astype(sampler.spec.dtype)
        for wave in self._waves():
            answers = model.run_all(inputs, list(wave.values()))
            for feeds, answer in zip(inputs, answers, strict=True):
                for name, odds in wave.items():
                    chance = np.where(answer[odds] > NEVER, rng.random(answer[odds].shape), -1)
                    feeds[name][:] = np.argmax(chance, axis=-1).reshape(-1, 1)

    def _waves(self) -> list[dict[str, str]]:
        """Samplers of classes → their odds, in groups that hang on the groups before, and on nothing of their own."""
        graph, waves = runnable(self.tested.graph), list[dict[str, str]]()
        for sampler in (s for s in self.samplers if s.odds is not None):
            assert sampler.odds is not None
            if not waves or sampler.odds.name in graph.descendants(waves[-1]):
                waves.append({})
            waves[-1][sampler.name] = sampler.odds.name
        return waves


def cut_policy(tested: PolicyUnderTest, folder: Path) -> CutPolicy | None:
    """The policy with its samplers as inputs; None where it has none, or their shapes are not known before it runs.

    The noise inputs of a policy that has no others count too: a candidate may draw for itself what they are fed.
    """
    graph, signature = runnable(tested.graph), tested.signature
    outputs = [s.name for s in signature.outputs if s.name in graph]
    upstream = graph.ancestors(outputs)
    nodes = [n for n in graph.nodes if n.op in KINDS and n.name in upstream]
    given = [CutSampler(spec, "normal", given=True) for spec in signature.noise]
    samplers = [*given]
    if nodes:
        made = _with_inputs(graph, nodes)
        if made is None:
            return None
        graph, cut = made
        samplers += cut
        tested = _cut_tested(tested, graph, cut, folder)
    actions = {}
    for sampler in samplers:
        below = graph.descendants([sampler.name])
        actions[sampler.name] = [name for name in outputs if name in below]
    return CutPolicy(tested, tuple(samplers), actions) if samplers else None


def _with_inputs(graph: Graph, nodes: Sequence[Node]) -> tuple[Graph, list[CutSampler]] | None:
    """The graph with placeholders for the samplers ``nodes``, and the odds of classes."""
    types = infer_types(graph)
    editor, samplers = Editor(graph), []
    names = {n.name for n in nodes}
    for node in graph.nodes:
        if node.name not in names:
            editor.keep(node)
            continue
        dims, dtype = static_shape(types[node.name].shape), types[node.name].dtype
        if not dims or dims[0] is not None or None in dims[1:]:
            return None
        attrs = {"dtype": dtype, "shape": TensorShape(dims)}
        editor.nodes.append(Node(node.name, "Placeholder", attrs=attrs, origin=node.origin))
        role, odds = Role.NOISE if KINDS[node.op] == "normal" else Role.OTHER, None
        if KINDS[node.op] == "categorical":
            scores = types[node.inputs[0]].shape
            width = scores[-1] if scores and len(scores) == 2 else None
            if not isinstance(width, int):
                return None
            normal = editor.add("LogSoftmax", [node.inputs[0]], f"{node.name}/log_probs")
            never = editor.const(np.float32(NEVER), f"{node.name}/never")
            name = editor.add("Maximum", [normal, never], f"{node.name}/odds")
            odds = TensorSpec(name, Role.OTHER, "float32", (None, width))
        samplers.append(CutSampler(TensorSpec(node.name, role, dtype.name, dims), KINDS[node.op], odds))
    return editor.graph(), samplers


def _cut_tested(tested: PolicyUnderTest, graph: Graph, samplers: Sequence[CutSampler], folder: Path) -> PolicyUnderTest:
    """What is tested, cut. The source takes part where it can be given the noise that the policy draws."""
    signature, source = tested.signature, tested.source_map
    old = runnable(tested.graph)
    fed = {s.name: tensor_of(old[s.name]) for s in samplers if s.kind == "normal"}
    fed = {name: tensor for name, tensor in fed.items() if tensor in source.noise}
    others = [s.name for s in samplers if s.name not in fed]
    apart = graph.descendants(others)
    fetches = {n: t for n, t in source.fetches.items() if n not in apart}
    heads = source.branches if apart.isdisjoint(s.odds.name for s in samplers if s.odds) else ()
    mapped = replace(source, feeds={**source.feeds, **fed}, fetches=fetches, branches=heads, noise_kept=False)
    folder.mkdir(exist_ok=True)
    file, detached = folder / CUT, Detached.of(graph.values())
    schema.pieces(encode(graph, explicit=True, detached=detached), detached).write(file)
    odds = [s.odds for s in samplers if s.odds is not None]
    return replace(
        tested,
        signature=replace(
            signature,
            inputs=(*signature.inputs, *(s.spec for s in samplers)),
            outputs=(*signature.outputs, *odds),
        ),
        graph=graph,
        reference=file,
        artefacts={},
        source=tested.source if fed else None,
        source_map=mapped,
    )


class CutArtefact(Struct, frozen=True):
    """An artefact that is run cut, and the same file as it is: ``own`` has its sampler for each of the policy's."""

    participant: Participant
    own: Mapping[str, Sampler]
    #: runs the file as it is, with any of its tensors fetched by its own names
    as_it_is: RunAll
    #: another tool may have made it
    foreign: bool
    #: there is no other way
    last: bool


def cut_artefacts(
    cut: CutPolicy, participant: Participant, outputs: Sequence[str], pool: RuntimePool
) -> Generator[CutArtefact]:
    """Ways to cut an artefact that are worth a try, loaded one at a time: none where its samplers are not the policy's.

    Raises RunFailedError where a runtime refuses the cut.
    """
    if participant.path is None:
        return
    wanted = [s for s in cut.samplers if not set(outputs).isdisjoint(cut.actions[s.name])]
    wanted = [s for s in wanted if not _is_fed(participant, s)]
    nodes = runnable(cut.tested.graph).nodes
    origins = {n.name: n.origin for n in nodes if isinstance(n.origin, str)}
    with inner_tensors(participant, participant.path, pool, origins) as inner:
        pairs = _pairs(wanted, inner) if inner.opened is not None else []
        for number, own in enumerate(pairs, 1):
            odds = {s.odds.name: own[s.name].scores or "" for s in wanted if s.odds is not None}
            names = {n: participant.called.get(n, n) for n in outputs} | odds
            assert inner.opened is not None
            drawn = {own[s.name].tensor: len(s.spec.shape) for s in wanted}
            with inner.opened(drawn, list(dict.fromkeys(names.values()))) as run_all:
                run: Run = partial(_run, run_all, partial(_feeds, participant, own), names, odds.keys())
                if cut.tested.batch is not None:
                    run = partial(_run_in_batches, run, cut.tested)
                taking_part = Participant(
                    format=participant.format,
                    runtime=participant.runtime,
                    run=run,
                    outputs=list(names),
                    model=participant.model,
                    label=participant.label,
                    path=participant.path,
                    fed=participant.fed,
                )
                as_it_is = partial(_as_it_is, inner, participant, cut.tested)
                yield CutArtefact(taking_part, own, as_it_is, foreign=inner.foreign, last=number == len(pairs))


def _run(
    run_all: RunAll,
    own_feeds: Callable[[Feeds], Feeds],
    names: Mapping[str, str],
    odds: Collection[str],
    inputs: Sequence[Feeds],
    fetch: Sequence[str],
) -> list[Arrays]:
    """Outputs of a cut artefact by the policy's names; the scores of classes as ``odds``."""
    answers = run_all([own_feeds(feeds) for feeds in inputs], list(dict.fromkeys(names[n] for n in fetch)))
    return [{n: _as_odds(a[names[n]]) if n in odds else a[names[n]] for n in fetch} for a in answers]


def _as_it_is(
    inner: InnerTensors,
    participant: Participant,
    tested: PolicyUnderTest,
    inputs: Sequence[Feeds],
    fetch: Sequence[str],
) -> list[Arrays]:
    """As ``CutArtefact.as_it_is``."""
    assert inner.opened is not None
    own = [feeds if participant.fed is None else participant.fed(feeds) for feeds in inputs]
    with inner.opened({}, fetch) as run_all:
        return run_all(own, fetch) if tested.batch is None else _run_in_batches(run_all, tested, own, fetch)


def _is_fed(participant: Participant, sampler: CutSampler) -> bool:
    """Whether an artefact takes noise as an input of its own."""
    return sampler.given and (participant.fed is None or sampler.name in participant.called)


def _pairs(wanted: Sequence[CutSampler], inner: InnerTensors) -> list[dict[str, Sampler]]:
    """The policy's samplers and a file's, by name, else in any order that their kinds allow."""
    by_tensor = {s.tensor: s for s in inner.samplers}
    named = {s.name: by_tensor.get(view.name) for s in wanted if (view := inner.view(s.name)) is not None}
    found = {s.name: own for s in wanted if (own := named.get(s.name)) is not None and own.kind == s.kind}
    if len(found) == len(wanted):
        return [found]
    if len(wanted) != len(inner.samplers):
        return []
    orders = [zip(wanted, order, strict=True) for order in islice(permutations(inner.samplers), _ORDERS)]
    pairs = [list(order) for order in orders]
    return [{s.name: own for s, own in p} for p in pairs if all(s.kind == own.kind for s, own in p)]


def _feeds(participant: Participant, own: Mapping[str, Sampler], feeds: Feeds) -> Arrays:
    """What an artefact is fed that is cut."""
    given = {name: array for name, array in feeds.items() if name not in own}
    placed = given if participant.fed is None else participant.fed(given)
    drawn = {s.tensor: feeds[name].astype(s.dtype or feeds[name].dtype, copy=False) for name, s in own.items()}
    return {**placed, **drawn}


def _as_odds(scores: np.ndarray) -> np.ndarray:
    """The log-probabilities that scores of classes stand for, no smaller than ``NEVER``."""
    wide = scores.astype(np.float64)
    with np.errstate(all="ignore"):
        shifted = wide - wide.max(axis=-1, keepdims=True)
        shifted -= np.log(np.exp(shifted).sum(axis=-1, keepdims=True))
    return np.asarray(np.maximum(shifted, NEVER).astype(np.float32))


def _run_in_batches(run: Run, tested: PolicyUnderTest, inputs: Sequence[Feeds], fetch: Sequence[str]) -> list[Arrays]:
    """``run`` of a file for a fixed number of agents, for any number of them."""
    assert tested.batch is not None
    batched = {s.name for s in tested.signature.inputs if s.batched}
    parts = [batches_of(feeds, tested.batch, batched) for feeds in inputs]
    return [put_together(run(p, fetch), rows_of(f, batched)) for p, f in zip(parts, inputs, strict=True)]
