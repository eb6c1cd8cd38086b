"""From a source's graph to policies: the passes in their order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from converters.graph.editor import Editor
from converters.graph.nodes import Graph, Node, node_of, split_ref, topological
from converters.graph.options import CompileOptions
from converters.graph.passes.fold import fold
from converters.graph.passes.inputs import batch_size_rank, complete_shapes, constant_value, set_values, settle_inputs
from converters.graph.passes.memories import join_memories
from converters.graph.passes.naming import name_tensors
from converters.graph.passes.noise import lift_noise, samplers, unseeded
from converters.graph.passes.normalise import normalise
from converters.graph.passes.simplify import collapse_views, drop_identities
from converters.graph.passes.transposes import cancel_transposes
from converters.graph.passes.unroll import unroll
from converters.graph.shapes import Types, infer_types
from converters.graph.types import static_shape
from converters.policy import Policy
from converters.understand.action import ActionMeaning, action_meaning
from converters.understand.brains import Brain, Head, find_brains
from converters.understand.derived_outputs import LOG_PROBS, add_companions
from converters.understand.facts import SourceFacts
from converters.understand.inputs import classify_inputs
from converters.understand.signature import Compiled, branch_sizes, build_signature
from signatures.errors import UsageError
from signatures.memories import SourcePart
from signatures.roles import Constant, Role
from signatures.spec import SourceMap, sources

#: The name of the string constant in which our GraphDefs carry their contract.
CONTRACT_NODE = "export_model_contract"

Shapes = Mapping[str, tuple[int | None, ...]]


def compile_graph(
    graph: Graph, name: str, options: CompileOptions | None = None, facts: SourceFacts | None = None
) -> list[Policy]:
    """Every policy in ``graph``, ready for the writers. ``name`` is the source's stem.

    Raises NotAPolicyError, SignatureError, UnsupportedOpError, GraphError, UsageError.
    """
    options, facts = options or CompileOptions(), facts or SourceFacts()
    joined = join_memories(graph, _by_nodes(graph, options), facts)
    graph, options, facts = joined.graph, joined.options, joined.facts
    original, graph = graph, set_values(graph, options.values)
    brains = find_brains(graph, options.outputs, facts.outputs)
    return [
        _Compiler(graph, original, brain, options, facts, joined.parts).run(
            f"{name}-{brain.label}" if len(brains) > 1 else name
        )
        for brain in _chosen_brains(brains, options.brain)
    ]


def _by_nodes(graph: Graph, options: CompileOptions) -> CompileOptions:
    """The options with nodes in place of names that only the source has (ONNX values are named more freely)."""
    names = {n.origin: n.name for n in graph.nodes if isinstance(n.origin, str)}

    def moved(given: Mapping[str, Any]) -> dict[str, Any]:
        return {k if node_of(k) in graph else names.get(k, k): v for k, v in given.items()}

    return replace(options, inputs=moved(options.inputs), outputs=moved(options.outputs), values=moved(options.values))


def _chosen_brains(brains: tuple[Brain, ...], wanted: str | None) -> tuple[Brain, ...]:
    if wanted is None:
        return brains
    chosen = tuple(b for b in brains if b.label == wanted)
    if not chosen:
        names = ", ".join(b.label or "(no scope)" for b in brains)
        raise UsageError(f"--brain {wanted}: there is no such brain", fix=f"this graph has: {names}")
    return chosen


@dataclass
class _Compiler:
    """One brain on its way through the passes."""

    graph: Graph
    original: Graph
    brain: Brain
    options: CompileOptions
    facts: SourceFacts
    #: the source's tensors that the memory was joined from
    parts: Mapping[Role, tuple[SourcePart, ...]] = field(default_factory=dict)
    meanings: dict[str, ActionMeaning] = field(default_factory=dict)

    def run(self, name: str) -> Policy:
        roles = classify_inputs(
            self.graph, self.brain, self.options.inputs, self.facts.roles, declared=bool(self.facts.outputs)
        )
        canonical = self.brain.canonical
        outputs = [(canonical[base], reference) for base, _, reference in self.brain.outputs if base in canonical]
        upstream = self.graph.pruned([reference for _, reference in outputs])
        roles = {n: r for n, r in roles.items() if n in upstream}
        sources = {out: self._source_of(reference) for out, reference in outputs}
        # Outputs are pinned by nodes of their own, which every pass keeps.
        fetches = {out: f"__output_{i}" for i, (out, _) in enumerate(outputs)}
        pins = [Node(fetches[out], "Identity", (reference,), origin=sources[out]) for out, reference in outputs]
        pinned = Graph(topological([*upstream.nodes, *pins]))

        work = unroll(complete_shapes(normalise(settle_inputs(pinned, roles)), roles))
        work, fetches = drop_identities(fold(work).pruned(fetches.values()), fetches)
        work, fetches = cancel_transposes(*collapse_views(work, fetches))

        types = infer_types(work)
        masked = Role.MASKS in roles.values()
        for head in self.brain.heads:
            dtype = types[fetches[head.name]].dtype
            scores = masked and head.base != "continuous_actions"
            self.meanings[head.name] = action_meaning(work, fetches[head.name], dtype, scores)
        # Sizes are looked up before the source's own action without chance takes the place of one with branches.
        sizes = branch_sizes(types, [b for m in self.meanings.values() for b in m.branches])
        work, fetches = _settle_single_draws(work, fetches, list(self.meanings.values()), types)
        draws = {n.name: _dims(types, n.name) for n in samplers(work)}
        deterministic = self.options.deterministic
        kept = self.options.noise == "keep" and not deterministic
        fed = {n: _dims(types, n) for n, r in roles.items() if r is Role.NOISE and n in work}
        before = work
        work = lift_noise(work, "keep" if kept else "zero" if deterministic else self.options.noise, fed)
        work = unseeded(work)
        noise = {**draws, **fed}
        tensors = {n: _tensor(before[n]) for n in noise}
        branches = self._branch_origins(work, pinned)
        for head in self.brain.heads:
            work, fetches = add_companions(work, fetches, head, self.meanings[head.name], noise)
        squashed = work.producer(fetches[self.brain.heads[0].name]).op == "Tanh"
        if deterministic:
            fetches = self._without_chance(fetches, sources)
        work, fetches = drop_identities(fold(work).pruned(fetches.values()), fetches)
        compiled = Compiled(
            work, fetches, sources, self.brain, self.options, self.facts, roles, self.meanings, draws,
            {n.op for n in upstream.nodes}, sizes, squashed,
        )  # fmt: skip
        signature, feeds, named = build_signature(compiled)
        policy = self._named(name, Policy(name, work, signature, feeds, named), roles)
        return replace(
            policy, source=self._source_map(policy, pinned, roles, branches, {tensors[n]: s for n, s in noise.items()})
        )

    def _source_of(self, reference: str) -> str | tuple[str, ...] | None:
        """The source's name for a tensor: what its node carries, ``node:k`` for further outputs."""
        name, index = split_ref(reference)
        return self.graph[name].origin if index == 0 else f"{name}:{index}"

    def _branch_origins(self, work: Graph, pinned: Graph) -> tuple[str | None, ...]:
        """The source's tensors that a sampled action is drawn from."""
        known = {n.origin for n in pinned.nodes}
        found: list[str | None] = []
        for meaning in self.meanings.values():
            for branch in meaning.branches:
                origin = work.producer(branch).origin if split_ref(branch)[1] == 0 else None
                found.append(origin if isinstance(origin, str) and origin in known else None)
        return tuple(found)

    def _without_chance(self, fetches: dict[str, str], sources: dict[str, Any]) -> dict[str, str]:
        """``--deterministic``: the actions are the ones without chance. A discrete one is then made here."""
        for head in self.brain.heads:
            meaning = self.meanings[head.name]
            if meaning.role is Role.DETERMINISTIC:
                continue
            fetches = {**fetches, head.name: fetches[head.deterministic]}
            if meaning.role is not Role.CONTINUOUS:
                self.meanings[head.name] = ActionMeaning(Role.DETERMINISTIC, meaning.branches)
                sources[head.name] = None
        return {n: r for n, r in fetches.items() if n != LOG_PROBS}

    def _named(self, name: str, policy: Policy, roles: Mapping[str, Role]) -> Policy:
        """Inputs and outputs under the signature's names.

        With ``--names source`` the trainer's constants are kept too, and ``sequence_length``, read by nothing: Unity's
        internal brain of 0.3 to 0.5 feeds it to every recurrent policy without asking whether it is there.
        """
        scope, source = self.brain.scope, self.options.names == "source"
        kept = {**self.facts.constants, **self.brain.constants} if source else {}
        unread = [n for n, r in roles.items() if r is Role.SEQUENCE_LENGTH and source]
        reserved = (CONTRACT_NODE, *(scope + k for k in kept), *unread)
        graph = name_tensors(policy.graph, policy.feeds, policy.fetches, reserved)
        constants = [
            Node(scope + key, "Const", value=self._constant(value), origin=f"{scope}{key}:0")
            for key, value in kept.items()
        ]
        return Policy(
            name,
            Graph((*graph.nodes, *constants, *(self.original[n] for n in unread))),
            policy.signature,
            {s.name: s.name for s in policy.signature.inputs},
            {s.name: s.name for s in policy.signature.outputs},
        )

    def _constant(self, value: Constant) -> np.ndarray:
        """A constant as the trainer writes it: TensorFlow's are int32 scalars, torch's rows of float32."""
        if isinstance(value, list):
            return np.array([value], np.float32)
        torch = self.facts.family is not None and "PyTorch" in self.facts.family
        return np.array([value], np.float32) if torch else np.array(value, np.int32)

    def _source_map(
        self, policy: Policy, source: Graph, roles: Mapping[str, Role], branches: tuple[str | None, ...], noise: Shapes
    ) -> SourceMap:
        """How to run the source, from what became of its placeholders."""
        fixed = {
            _tensor(source[n]): constant_value(source[n], 1) for n, r in roles.items() if r is Role.SEQUENCE_LENGTH
        }
        given = {_tensor(self.original[n]): constant_value(self.original[n], v) for n, v in self.options.values.items()}
        signature = policy.signature
        parts = {s.name: self.parts[s.role] for s in (*signature.inputs, *signature.outputs) if s.role in self.parts}
        return SourceMap(
            feeds=sources(signature.inputs, parts),
            fetches=sources(signature.outputs, parts),
            fixed={**fixed, **given},
            batch_sizes={
                _tensor(source[n]): batch_size_rank(source, source[n]) for n, r in roles.items() if r is Role.BATCH_SIZE
            },
            noise=dict(noise),
            noise_kept=self.options.noise == "keep" and not self.options.deterministic,
            branches=branches,
            rows=self.facts.rows,
            parts=parts,
        )


def _tensor(node: Node) -> str:
    """The source's name for what a placeholder or a sampler gives."""
    return node.origin if isinstance(node.origin, str) else f"{node.name}:0"


def _settle_single_draws(
    graph: Graph, fetches: dict[str, str], meanings: Sequence[ActionMeaning], types: Types
) -> tuple[Graph, dict[str, str]]:
    """A draw from a single class is always class 0: an ArgMax says so (TensorFlow.js refuses to draw from one)."""
    single = {
        sampler
        for meaning in meanings
        for sampler, branch in zip(meaning.samplers, meaning.branches, strict=False)
        if (types[branch].shape or (None,))[-1] == 1
    }
    if not single:
        return graph, fetches
    editor = Editor(graph)
    for node in graph.nodes:
        if node.name not in single:
            editor.keep(node)
            continue
        axis = editor.const(np.array(1, np.int32), f"{node.name}/axis")
        best = editor.add("ArgMax", [node.inputs[0], axis], f"{node.name}/only", output_type=node.attrs["output_dtype"])
        shape = editor.const(np.array([-1, 1], np.int32), f"{node.name}/column_shape")
        editor.redirect(node.name, editor.add("Reshape", [best, shape], f"{node.name}/column", node.origin))
    return editor.graph(), {out: editor.resolve(reference) for out, reference in fetches.items()}


def _dims(types: Types, name: str) -> tuple[int | None, ...]:
    return static_shape(types[name].shape) or ()


__all__ = ["CONTRACT_NODE", "CompileOptions", "Head", "compile_graph"]
