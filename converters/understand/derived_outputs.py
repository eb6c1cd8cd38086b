"""The outputs that stand beside ``action``: the action without chance, and the log-probabilities of a drawn one.

Precondition: straight, folded graph; noise lifted or kept. Postcondition: ``deterministic_action`` exists for every
policy (continuous: the action at zero noise; discrete: int64 [B, branches], the argmax of each branch), and
``action_log_probs`` (float32 [B, ΣB]) for a sampled one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from converters.graph.compilation import Compilation
from converters.graph.editor import Editor
from converters.graph.nodes import Graph, Node
from converters.graph.ops.table import traits
from converters.graph.passes.noise import without_noise
from converters.graph.shapes import infer_types
from converters.graph.types import INT32, INT64, static_shape
from converters.understand.action import ActionMeaning
from converters.understand.brains import Head
from signatures.errors import SignatureError
from signatures.roles import Role

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


def drawn_by(graph: Graph, reference: str) -> list[Node]:
    """The samplers that a tensor depends on."""
    upstream = graph.ancestors([reference])
    return [n for n in graph.nodes if n.name in upstream and traits(n).sampler]


def _check_no_chance(graph: Graph, reference: str, name: str) -> None:
    samplers = drawn_by(graph, reference)
    if samplers:
        raise SignatureError(
            f"{name} would be another one in every run: it depends on {samplers[0].name!r} ({samplers[0].op})",
            why="there is no value of such a draw that stands for no chance, as 0 does for N(0, 1)",
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
            graph, added[name] = without_noise(graph, fetches[head.name], noise, name)
        return graph, added
    scores = list(meaning.branches)
    action = fetches[head.name]
    if name not in fetches:
        for i, branch in enumerate(scores):
            graph, scores[i] = without_noise(graph, branch, noise, name)
        if not scores:
            graph, action = without_noise(graph, action, noise, name)
    editor = Editor(graph)
    for node in graph.nodes:
        editor.keep(node)
    if meaning.role is Role.SAMPLED and LOG_PROBS not in fetches:
        parts = [editor.add("LogSoftmax", [b], f"{LOG_PROBS}/branch_{i}") for i, b in enumerate(meaning.branches)]
        added[LOG_PROBS] = _joined(editor, parts, LOG_PROBS)
    if name not in fetches:
        if scores:
            added[name] = _argmax(editor, graph, scores, name)
        else:
            added[name] = _as_columns(editor, graph, action, name)
    return editor.graph(), added


def _joined(editor: Editor, parts: Sequence[str], name: str) -> str:
    if len(parts) == 1:
        return parts[0]
    axis = editor.const(np.array(1, INT32), f"{name}/axis")
    return editor.add("ConcatV2", [*parts, axis], f"{name}/concat")


def _argmax(editor: Editor, graph: Graph, branches: Sequence[str], name: str) -> str:
    columns, types = [], infer_types(graph)
    for i, branch in enumerate(branches):
        prefix = f"{name}/branch_{i}"
        shape = types[branch].shape or ()
        if len(shape) > 2 and isinstance(shape[-1], int):  # [B, 1, n]
            row = editor.const(np.array([-1, shape[-1]], INT32), f"{prefix}/row_shape")
            branch = editor.add("Reshape", [branch, row], f"{prefix}/row")
        axis = editor.const(np.array(1, INT32), f"{prefix}/axis")
        best = editor.add("ArgMax", [branch, axis], f"{prefix}/argmax", output_type=INT64)
        columns.append(editor.add("Reshape", [best, _column_shape(editor, prefix)], f"{prefix}/column"))
    return _joined(editor, columns, name)


def _as_columns(editor: Editor, graph: Graph, action: str, name: str) -> str:
    """An integer action whose scores are not in the graph: itself, as int64 [B, n]."""
    kind = infer_types(graph)[action]
    value = action
    if kind.dtype != INT64:
        value = editor.add("Cast", [value], f"{name}/int64", DstT=INT64)
    if kind.rank == 1:
        value = editor.add("Reshape", [value, _column_shape(editor, name)], f"{name}/column")
    return value


def _column_shape(editor: Editor, prefix: str) -> str:
    return editor.const(np.array([-1, 1], np.int32), f"{prefix}/column_shape")
