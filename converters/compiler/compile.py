"""From a source's graph to policies: the passes in their order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec.structs import replace

from export_model.converters.compiler.compilation import Compilation, Pass, on_graph, on_inputs, on_tensors
from export_model.converters.compiler.options import MAX_PORTS, CompileOptions
from export_model.converters.compiler.passes import conditions as has
from export_model.converters.compiler.passes.batch_axis import for_any_number, without_agents
from export_model.converters.compiler.passes.best_action import rank_actions
from export_model.converters.compiler.passes.doubles import narrow_doubles
from export_model.converters.compiler.passes.fold import fold
from export_model.converters.compiler.passes.inputs import complete_shapes, give_rows, set_values, settle_inputs
from export_model.converters.compiler.passes.memories import Joined, join_memories
from export_model.converters.compiler.passes.mixtures import settle_mixtures
from export_model.converters.compiler.passes.naming import name_ports
from export_model.converters.compiler.passes.noise import clear_seeds, settle_noise, settle_single_draws
from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.compiler.passes.outputs import derive_outputs, leave_out_without_rows, without_chance
from export_model.converters.compiler.passes.passed_through import drop_passed_through
from export_model.converters.compiler.passes.ranks import settle_ranks
from export_model.converters.compiler.passes.signature import sign, source_map, understand_actions
from export_model.converters.compiler.passes.simplify import collapse_views, drop_identities
from export_model.converters.compiler.passes.small_integers import widen_small_integers
from export_model.converters.compiler.passes.transposes import cancel_transposes
from export_model.converters.compiler.passes.unroll import MAX_POLICY_NODES, unroll
from export_model.converters.graph.nodes import Graph, Node, SourceName, node_of, split_ref, topological
from export_model.converters.graph.ops.table import is_fed
from export_model.converters.policy.brains import GraphBrain, explain_outputs, find_brains
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.policy.inputs import classify_inputs, explain_inputs
from export_model.converters.policy.policy import Policy
from export_model.converters.policy.rules import RoleDecision
from export_model.signatures.errors import NotAPolicyError, UsageError
from export_model.signatures.roles import OBSERVATIONS

FOLD = Pass("fold", on_graph(fold), (has.no_control_flow,), (has.constants_folded,))
DROP = Pass(
    "drop identities", on_tensors(drop_identities), (has.no_control_flow,), (has.no_identities, has.no_dead_nodes)
)
PASSES = (
    Pass("settle inputs", on_inputs(settle_inputs), (has.pinned_outputs,), (has.pinned_outputs, has.settled_inputs)),
    Pass("normalise", on_graph(normalise), (has.settled_inputs,), (has.one_spelling,)),
    Pass("complete shapes", on_inputs(complete_shapes), (has.one_spelling,), (has.one_spelling,)),
    Pass("unroll", on_graph(unroll), (has.one_spelling,), (has.one_spelling, has.no_control_flow, has.pinned_outputs)),
    Pass("settle ranks", on_graph(settle_ranks), (has.no_control_flow,), (has.one_spelling,)),
    FOLD,
    DROP,
    Pass("collapse views", on_tensors(collapse_views), (has.no_identities,), (has.no_identities, has.no_dead_nodes)),
    Pass("cancel transposes", on_tensors(cancel_transposes), (has.constants_folded,), (has.no_dead_nodes,)),
    Pass("rank actions", rank_actions, (has.no_identities,), (has.no_identities,)),
    Pass("settle mixtures", settle_mixtures, (has.no_identities,), (has.no_identities,)),
    Pass("understand actions", understand_actions, (has.no_identities,), (has.meanings,)),
    Pass("leave out", leave_out_without_rows, (has.meanings,), (has.meanings,)),
    Pass("settle single draws", settle_single_draws, (has.meanings,), (has.one_spelling,)),
    Pass("settle noise", settle_noise, (has.no_control_flow,), (has.noise_as_asked,)),
    Pass("remove seeds", on_graph(clear_seeds), (), (has.no_seeds,)),
    Pass("derive outputs", derive_outputs, (has.meanings, has.noise_as_asked), (has.actions_without_chance,)),
    Pass("leave chance out", without_chance, (has.actions_without_chance,), (has.actions_without_chance,)),
    FOLD,
    DROP,
    Pass("sign", sign, (has.no_dead_nodes, has.meanings), (has.signature,)),
    Pass("name", name_ports, (has.signature,), (has.signature, has.names_of_the_signature, has.one_spelling)),
)


#: Tensors that a policy's nodes read, all together: a sum may name one of five bytes a million times.
MAX_READ = 1 << 15


def compile_graph(
    graph: Graph, name: str, options: CompileOptions | None = None, facts: SourceFacts | None = None
) -> list[Policy]:
    """Every policy in ``graph``, ready for the writers. ``name`` is the source's stem.

    Raises NotAPolicyError, SignatureError, UnsupportedOpError, GraphError, UsageError.
    """
    policies = []
    with np.errstate(all="ignore"):  # weights may be any numbers
        for label, c in compilations(graph, options or CompileOptions(), facts or SourceFacts()):
            for step in PASSES:
                c = step.run(c)
            assert c.signature is not None
            own = f"{name}-{label}" if label else name
            policies.append(Policy(own, c.graph, c.signature, c.feeds, c.fetches, source_map(c)))
    return policies


def compilations(graph: Graph, options: CompileOptions, facts: SourceFacts) -> list[tuple[str, Compilation]]:
    """(what tells a brain from the others of its graph, the brain before the first pass)."""
    joined = _prepare(graph, options, facts)
    original, options, facts = joined.graph, joined.options, joined.facts
    given = set_values(original, options.values)
    brains = find_brains(given, options.outputs, facts.outputs, facts.decisions)
    found = []
    for brain in _chosen_brains(brains, options.brain):
        roles = classify_inputs(given, brain, options.inputs, facts.roles, declared=bool(facts.outputs))
        observation = next((n for n, r in roles.items() if r in OBSERVATIONS), None)
        graph = given
        if options.values and observation is not None:
            graph = give_rows(given, original, options.values, observation)
        canonical = brain.canonical
        outputs = [(canonical[base], reference) for base, _, reference in brain.outputs if base in canonical]
        upstream = graph.prune([reference for _, reference in outputs])
        for what, count, most in (
            ("nodes", len(upstream.nodes), MAX_POLICY_NODES),
            ("tensors that its nodes read", sum(len(n.inputs) for n in upstream.nodes), MAX_READ),
            ("inputs", sum(map(is_fed, upstream.nodes)), MAX_PORTS),
            ("outputs", len(outputs), MAX_PORTS),
        ):
            if count > most:
                raise NotAPolicyError(
                    f"the policy has {count} {what}",
                    why=f"no more than {most} are converted; a policy has some hundreds of nodes, and a few inputs",
                    fix="give the policy alone, or say which node is its action: --output NODE=action",
                )
        sources = {out: _source_of(graph, reference) for out, reference in outputs}
        # Outputs are pinned by nodes of their own, which every pass keeps.
        fetches = {out: f"__output_{i}" for i, (out, _) in enumerate(outputs)}
        pins = [Node(fetches[out], "Identity", (reference,), origin=sources[out]) for out, reference in outputs]
        pinned = Graph(topological([*upstream.nodes, *pins]))
        roles = {n: r for n, r in roles.items() if n in upstream}
        c = Compilation(
            graph=pinned,
            brain=brain,
            options=options,
            facts=facts,
            original=original,
            source=pinned,
            roles=roles,
            fetches=fetches,
            sources=sources,
            parts=joined.parts,
        )
        found.append((brain.label if len(brains) > 1 else "", c))
    return found


def explanations(
    graph: Graph, name: str, options: CompileOptions | None = None, facts: SourceFacts | None = None
) -> dict[str, tuple[RoleDecision, ...]]:
    """Policy → why its inputs and outputs have their roles, by the source's names. Raises as ``compile_graph``."""
    with np.errstate(all="ignore"):
        joined = _prepare(graph, options or CompileOptions(), facts or SourceFacts())
        graph, options, facts = set_values(joined.graph, joined.options.values), joined.options, joined.facts
        brains = find_brains(graph, options.outputs, facts.outputs, facts.decisions)
        found = {}
        for brain in _chosen_brains(brains, options.brain):
            own = f"{name}-{brain.label}" if len(brains) > 1 and brain.label else name
            told, declared = facts.decisions, bool(facts.outputs)
            inputs = explain_inputs(graph, brain, options.inputs, facts.roles, told, declared=declared)
            decisions = (*inputs, *explain_outputs(brain, told))
            found[own] = tuple(replace(d, tensor=_tensor_text(graph, d.tensor)) for d in decisions)
    return found


def _tensor_text(graph: Graph, reference: str) -> str:
    """The source's name for a tensor, or the node's."""
    origin = _source_of(graph, reference)
    return origin if isinstance(origin, str) else ", ".join(origin) if origin else reference


def _prepare(graph: Graph, options: CompileOptions, facts: SourceFacts) -> Joined:
    """A source's graph with one memory, any number of rows, and inputs of the dtypes that every target has."""
    graph, facts = widen_small_integers(*narrow_doubles(graph, facts))
    options = _by_nodes(graph, options)
    facts = drop_passed_through(graph, options, facts)
    graph, facts = _for_any_number(graph, options, facts)
    return join_memories(graph, options, facts)


def _for_any_number(graph: Graph, options: CompileOptions, facts: SourceFacts) -> tuple[Graph, SourceFacts]:
    """A graph without an axis for the agents gets one, which is said."""
    if facts.rows is not None or not without_agents(graph):
        return graph, facts
    outputs = [*options.outputs, *facts.outputs]
    if not outputs:
        outputs = [reference for brain in find_brains(graph) for _, _, reference in brain.outputs]
    found = for_any_number(graph, list(dict.fromkeys(node_of(o) for o in outputs if node_of(o) in graph)))
    if found is None:
        return graph, facts
    made, rows = found
    said = "one agent" if rows == 1 else f"{rows} agents"
    note = f"the source decides for {said} at a time; an axis for any number is added, and each row is as the source's"
    return made, replace(facts, rows=rows, notes=(*facts.notes, note), memories=facts.memories or None)


def _source_of(graph: Graph, reference: str) -> SourceName:
    """The source's name for a tensor: what its node carries, ``node:k`` for further outputs."""
    name, index = split_ref(reference)
    return graph[name].origin if index == 0 else f"{name}:{index}"


def _by_nodes(graph: Graph, options: CompileOptions) -> CompileOptions:
    """The options with nodes in place of names that only the source has (ONNX values are named more freely)."""
    names = {n.origin: n.name for n in graph.nodes if isinstance(n.origin, str)}

    def rekey(given: Mapping[str, Any]) -> dict[str, Any]:
        return {k if node_of(k) in graph else names.get(k, k): v for k, v in given.items()}

    return replace(options, inputs=rekey(options.inputs), outputs=rekey(options.outputs), values=rekey(options.values))


def _chosen_brains(brains: tuple[GraphBrain, ...], wanted: str | None) -> tuple[GraphBrain, ...]:
    if wanted is None:
        return brains
    chosen = tuple(b for b in brains if b.label == wanted)
    if not chosen:
        names = [b.label for b in brains if b.label]
        raise UsageError(
            f"--brain {wanted}: unknown brain",
            why=None if names else "the policy of this file has no name",
            fix=f"this graph has: {', '.join(names)}" if names else "leave --brain out",
        )
    return chosen


__all__ = ["PASSES", "compilations", "compile_graph", "explanations"]
