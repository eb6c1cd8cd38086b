"""The outputs beside ``action``: the action without chance, the log-probabilities of a drawn one, further ones.

Precondition: straight, folded graph; noise lifted or kept. Postcondition: ``deterministic_action`` exists for every
policy (continuous: the action at zero noise; discrete: int64 [B, branches], the argmax of each branch), and
``action_log_probs`` (float32 [B, ΣB]) for a sampled one. Outputs that a format declares and that mean nothing to us are
kept where they have a row per agent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from msgspec.structs import replace

from export_model.converters.compiler.compilation import Compilation
from export_model.converters.compiler.passes.noise import without_noise
from export_model.converters.compiler.passes.normalise import normalise
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, normal_ref
from export_model.converters.graph.ops.table import traits
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import FLOAT32, INT64, static_shape
from export_model.converters.policy.action import ActionMeaning
from export_model.converters.policy.brains import Head
from export_model.signatures.errors import GraphError, SignatureError, UnsupportedOpError
from export_model.signatures.roles import OBSERVATIONS, Role

LOG_PROBS = "action_log_probs"


def derive_outputs(c: Compilation) -> Compilation:
    """Every action's companions. Raises SignatureError where an output without chance is drawn after all."""
    graph, fetches = c.graph, dict(c.fetches)
    truncated = [n.name for n in graph.nodes if traits(n).sampler == "truncated normal"]
    types = infer_types(graph) if truncated else {}
    noise = {**c.draws, **c.fed, **{n: static_shape(types[n].shape) or () for n in truncated}}
    for head in c.brain.heads:
        graph, fetches = add_companions(graph, fetches, head, c.meanings[head.name], noise)
    for head in c.brain.heads:
        _check_no_chance(graph, fetches[head.deterministic], head.deterministic)
        if c.meanings[head.name].role is Role.DETERMINISTIC:
            _check_no_chance(graph, fetches[head.name], head.name)
    return replace(c, graph=graph, fetches=fetches)


def _check_no_chance(graph: Graph, reference: str, name: str) -> None:
    upstream = graph.ancestors([reference])
    samplers = [n for n in graph.nodes if n.name in upstream and traits(n).sampler]
    if samplers:
        raise SignatureError(
            f"{name} would be another one in every run: it depends on {samplers[0].name!r} ({samplers[0].op})",
            why="no value of such a draw means no chance, as 0 does for N(0, 1)",
            fix="give the tensor before the draw as the action: --output NAME=action",
        )


def without_chance(c: Compilation) -> Compilation:
    """``--deterministic``: the actions are the ones without chance. A discrete one is then made here."""
    if not c.options.deterministic:
        return c
    fetches, meanings, sources = dict(c.fetches), dict(c.meanings), dict(c.sources)
    for head in c.brain.heads:
        meaning = meanings[head.name]
        if meaning.role is Role.DETERMINISTIC:
            continue
        fetches[head.name] = fetches[head.deterministic]
        if meaning.role is not Role.CONTINUOUS:
            meanings[head.name] = ActionMeaning(Role.DETERMINISTIC, meaning.branches)
            sources[head.name] = None
    fetches.pop(LOG_PROBS, None)
    return replace(c, fetches=fetches, meanings=meanings, sources=sources)


def add_companions(
    graph: Graph,
    fetches: Mapping[str, str],
    head: Head,
    meaning: ActionMeaning,
    noise: Mapping[str, tuple[int | None, ...]],
) -> tuple[Graph, dict[str, str]]:
    """The graph with an action's companions, and the fetches with their tensors added.

    A companion that the source has itself is left as it is.
    """
    added, name = dict(fetches), head.deterministic
    if meaning.role is Role.CONTINUOUS:
        if name not in fetches:
            graph, (added[name],) = without_noise(graph, [fetches[head.name]], noise, name)
        return graph, added
    scores = list(meaning.branches)
    action = fetches[head.name]
    if name not in fetches:
        graph, quiet = without_noise(graph, scores or [action], noise, name)
        scores, action = (quiet, action) if scores else (scores, quiet[0])
    editor = Editor(graph)
    editor.keep_all()
    if meaning.role is Role.SAMPLED and LOG_PROBS not in fetches:
        editor.prefix = LOG_PROBS
        parts = [editor.add("LogSoftmax", [b], f"branch_{i}") for i, b in enumerate(meaning.branches)]
        added[LOG_PROBS] = editor.concat(parts, 1, "concat")
    if name not in fetches:
        added[name] = _argmax(editor, scores, name) if scores else _as_columns(editor, action, name)
    return editor.graph(), added


def _argmax(editor: Editor, branches: Sequence[str], name: str) -> str:
    columns = []
    for i, branch in enumerate(branches):
        editor.prefix = f"{name}/branch_{i}"
        shape = editor.type_of(branch).shape or ()
        if len(shape) > 2 and isinstance(shape[-1], int):  # [B, 1, n]
            branch = editor.reshape(branch, (-1, shape[-1]), "row")
        columns.append(editor.reshape(editor.argmax(branch, 1, "argmax"), (-1, 1), "column"))
    editor.prefix = name
    return editor.concat(columns, 1, "concat")


def _as_columns(editor: Editor, action: str, name: str) -> str:
    """An integer action whose scores are not in the graph: itself, as int64 [B, n]."""
    editor.prefix = name
    value = editor.cast(action, INT64, "int64")
    return editor.reshape(value, (-1, 1), "column") if editor.rank(action) == 1 else value


def leave_out_without_rows(c: Compilation) -> Compilation:
    """Outputs of unknown meaning whose first axis is not the agents' go; the signature notes them by name.

    Raises SignatureError where one may be a memory: a policy that forgets is another policy.
    """
    others = [base for base, role, _ in c.brain.outputs if role is Role.OTHER and base in c.fetches]
    _check_memories(c)
    if not others:
        return c
    types = infer_types(c.graph)
    shapes = {name: types[c.fetches[name]].shape for name in others}
    gone = [name for name, shape in shapes.items() if shape is not None and not isinstance((*shape, 0)[0], str)]
    kept = {name: reference for name, reference in c.fetches.items() if name not in gone}
    return replace(c, fetches=kept, brain=replace(c.brain, left_out=(*c.brain.left_out, *gone)))


def _check_memories(c: Compilation) -> None:
    """Raise SignatureError for an unnamed output that may be a memory.

    An output that is made of an input and has its shape is fed back to it, for all that is known: where another input
    is the observation, and nobody said what the output is. One that is left out is looked at in the source.
    """
    fed = [n for n, r in c.roles.items() if r in OBSERVATIONS or r is Role.PARAMETER]
    named = {normal_ref(n) for n in c.options.outputs} | {r for _, role, r in c.brain.outputs if role is not Role.OTHER}
    for name in (n for n, role in c.facts.outputs.items() if role is None and len(fed) > 1 and n not in named):
        try:
            graph = normalise(c.original.prune([name]), [name])
            types = infer_types(graph, partial=True)
        except (UnsupportedOpError, GraphError):  # it cannot be converted at all
            continue
        shape = static_shape(types[name].shape)
        alike = [n for n in fed if n in graph and static_shape(types[n].shape) == shape and types[n].dtype == FLOAT32]
        if alike and shape and None in shape and types[name].dtype == FLOAT32:
            taken = alike[0] if len(alike) == 1 else "NAME"
            raise SignatureError(
                f"the output {name!r} may be a memory: it is made of an input of its shape ({', '.join(alike)})",
                why="without its memory the policy would act otherwise, and no name says what it is",
                fix=f"--input {taken}=memory_in --output {name}=memory_out, or --output {name}=other if it is none",
            )
