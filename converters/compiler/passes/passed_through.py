"""Leaves out inputs that a policy hands back as they came: Godot RL Agents' ``state_ins`` and ``state_outs``."""

from __future__ import annotations

from collections.abc import Mapping

from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.nodes import Graph, node_of, normal_ref
from export_model.converters.graph.ops.table import is_fed
from export_model.converters.policy.brains import depends_on_input, fed_through
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.policy.inputs import placeholder_rank
from export_model.converters.policy.memories import looks_like_state, stem_of
from export_model.signatures.roles import Role

_MATRIX = 2


def drop_passed_through(graph: Graph, options: CompileOptions, facts: SourceFacts) -> SourceFacts:
    """Return the facts without the outputs that only hand on an input that nothing else reads, with a note on each.

    Every file of godot_rl (wrappers/onnx/stable_baselines_export.py, examples/clean_rl_*.py) has such a pair: its
    exporter returns ``state_ins`` as ``state_outs``. What the user or the format gives a role is left alone, but for
    the roles that say that nothing is known of it.
    """
    named = {normal_ref(n) for n in options.outputs} | {m.output for m in facts.memories or ()}
    known = (n for n, role in facts.roles.items() if role is not Role.PARAMETER)
    taken = {node_of(n) for n in (*options.inputs, *options.values, *known)}
    open_outputs = [n for n, role in facts.outputs.items() if role in (None, Role.OTHER) and n not in named]
    echoes = {n: source for n in open_outputs if (source := fed_through(graph, n)) is not None and source not in taken}
    rest = [n for n in facts.outputs if n not in echoes]
    if not echoes or not any(n in depends_on_input(graph) for n in rest):
        return facts
    read = graph.ancestors(rest)
    dropped = {output: source for output, source in echoes.items() if source not in read}
    notes = [
        f"the input {graph[source].origin or source} is only handed on to the output {graph[output].origin or output}: "
        "the policy keeps no memory in it, and both are left out"
        for output, source in dropped.items()
    ]
    return replace(
        facts,
        outputs={n: role for n, role in facts.outputs.items() if n not in dropped},
        roles={**facts.roles, **_misnamed_observations(graph, dropped, read)},
        notes=(*facts.notes, *notes),
    )


def _misnamed_observations(graph: Graph, dropped: Mapping[str, str], read: set[str]) -> dict[str, Role]:
    """Observations that bear the name of the state that was dropped.

    With two observations, the two names that godot_rl gives, ``obs`` and ``state_ins``, fall on these.
    """
    stems = {stem_of(output) for output in dropped if looks_like_state(output)}
    inputs = [n for n in graph.nodes if is_fed(n) and n.name in read and stem_of(n.name) in stems]
    return {n.name: Role.VECTOR for n in inputs if placeholder_rank(n) == _MATRIX}
