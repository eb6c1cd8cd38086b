"""A choice between two choices by chance (an epsilon-greedy policy) as one draw of the same distribution.

``where(u < ε, draw, best)`` of a uniform u is a class whose probabilities are ε·p + (1 − ε)·[best]: one Multinomial of
their logarithm, so that it has log-probabilities and a likeliest action as every other draw.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.compiler.compilation import Compilation
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node
from export_model.converters.graph.ops.table import passes_on, traits
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import FLOAT32, INT64
from export_model.converters.policy.action import clips_nothing

#: Stands for probability 0 where its logarithm is taken.
_NEVER = 1e-30
_NAME = "action_of_chance"


class _Choice(Struct, frozen=True):
    """A class [B] out of ``count``: what writes its probabilities [B, count] or [count], and what it draws."""

    count: int
    write: Callable[[Editor], str]
    samplers: frozenset[str] = frozenset()


def settle_mixtures(c: Compilation) -> Compilation:
    """Each action that is such a choice, where nothing else depends on its draws."""
    for head in c.brain.heads:
        reference = c.fetches[head.name]
        shape = infer_types(c.graph)[reference].shape or (None, None)
        choice = _mixture(c.graph, reference) if shape[1:] in ((), (1,)) else None
        others = [r for name, r in c.fetches.items() if name != head.name]
        if choice is None or not choice.samplers.isdisjoint(c.graph.ancestors(others)):
            continue
        editor = Editor(c.graph)
        editor.keep_all()
        kind = editor.type_of(reference)
        tiny = editor.floats(_NEVER, f"{_NAME}/never")
        likely = editor.add("Maximum", [choice.write(editor), tiny], f"{_NAME}/likely")
        one = editor.ints(1, f"{_NAME}/count")
        drawn = editor.add(
            "Multinomial",
            [editor.add("Log", [likely], f"{_NAME}/log"), one],
            _NAME,
            seed=0,
            seed2=0,
            output_dtype=INT64,
        )
        drawn = editor.cast(drawn, kind.dtype, f"{_NAME}/cast")
        if kind.rank == 1:
            drawn = editor.reshape(drawn, (-1,), f"{_NAME}/row")
        note = (
            f"{head.name} is by chance one of two, which the source draws one after the other (epsilon-greedy): it is "
            "drawn at once here, from the same probabilities, which the source has no tensor of to compare with"
        )
        facts = replace(c.facts, notes=(*c.facts.notes, note))
        c = replace(c, graph=editor.graph(), fetches={**c.fetches, head.name: drawn}, facts=facts)
    return c


def _mixture(graph: Graph, reference: str) -> _Choice | None:
    node = _behind(graph, reference)
    if node.op != "Select":
        return None
    share = _share(graph, node.inputs[0])
    sides = [_choice(graph, r) for r in node.inputs[1:]]
    if share is None or None in sides or infer_types(graph)[node.inputs[0]].rank != 1:
        return None
    (rate, uniform), first, second = share, *(s for s in sides if s is not None)
    if first.count != second.count or not (samplers := first.samplers | second.samplers) or uniform in samplers:
        return None

    def write(editor: Editor) -> str:
        parts = []
        for choice, factor in ((first, rate), (second, 1 - rate)):
            weight = editor.floats(factor, f"{_NAME}/share")
            parts.append(editor.add("Mul", [choice.write(editor), weight], f"{_NAME}/part"))
        return editor.add("Add", parts, f"{_NAME}/odds")

    return _Choice(first.count, write, samplers | {uniform})


def _behind(graph: Graph, reference: str) -> Node:
    """What makes a class, behind what shows it, casts it, adds 0 or multiplies it by ones."""
    while True:
        node = graph.producer(reference)
        if passes_on(node) or node.op == "Cast" or clips_nothing(graph, node, _width):
            reference = node.inputs[0]
        elif node.op == "Mul" and (shown := [r for r in node.inputs if not graph.is_full_of(r, 1)]) and len(shown) == 1:
            (reference,) = shown
        elif node.op == "Add" and graph.is_full_of(node.inputs[1], 0):
            reference = node.inputs[0]
        else:
            return node


def _width(graph: Graph, reference: str) -> int | None:
    choice = _mixture(graph, reference) or _choice(graph, reference)
    return None if choice is None else choice.count


def _choice(graph: Graph, reference: str) -> _Choice | None:
    """The best of a row of scores, a class drawn from logits, or one of equally likely ones."""
    node = _behind(graph, reference)
    if node.op == "ArgMax" or traits(node).sampler == "categorical":
        shape, given = infer_types(graph)[node.inputs[0]].shape, graph.constant(node.inputs[1])
        wanted = (1, -1) if node.op == "ArgMax" else (1,)
        if (
            shape is None
            or len(shape) != 2
            or not isinstance(shape[1], int)
            or given is None
            or int(given) not in wanted
        ):
            return None
        count = shape[1]
        if node.op != "ArgMax":
            logits = node.inputs[0]
            return _Choice(
                count, lambda e: e.add("Softmax", [e.resolve(logits)], f"{_NAME}/odds"), frozenset((node.name,))
            )

        def one_hot(editor: Editor) -> str:
            depth, on, off = (
                editor.const(a, f"{_NAME}/{k}")
                for k, a in (("depth", np.array(count, np.int32)), ("on", FLOAT32.type(1)), ("off", FLOAT32.type(0)))
            )
            return editor.add("OneHot", [editor.resolve(node.name), depth, on, off], f"{_NAME}/best", axis=-1)

        return _Choice(count, one_hot)
    return _equally_likely(graph, node)


def _equally_likely(graph: Graph, node: Node) -> _Choice | None:
    """floor(u · n)."""
    found = _scaled_uniform(graph, node.inputs[0]) if node.op == "Floor" else None
    if found is None or not found[0].is_integer() or not 0 < found[0] < 1 << 20:
        return None
    count = int(found[0])
    row = np.full((1, count), 1 / count, FLOAT32)
    return _Choice(count, lambda e: e.const(row, f"{_NAME}/equal"), frozenset((found[1],)))


def _scaled_uniform(graph: Graph, reference: str) -> tuple[float, str] | None:
    """(factor, the sampler) of a uniform number from 0 to 1, times a constant."""
    node, factor = graph.producer(reference), 1.0
    if node.op == "Mul":
        values = [graph.constant(r) for r in node.inputs]
        known = [v for v in values if v is not None and v.size == 1]
        if len(known) != 1:
            return None
        factor = float(known[0].reshape(()))
        node = graph.producer(node.inputs[0 if values[0] is None else 1])
    return (factor, node.name) if traits(node).sampler == "uniform" else None


def _share(graph: Graph, reference: str) -> tuple[float, str] | None:
    """(how often a condition is true, the sampler) of a uniform number that is compared with a constant."""
    node = graph.producer(reference)
    less = node.op.startswith("Less")
    if not less and not node.op.startswith("Greater"):
        return None
    bounds = [graph.constant(r) for r in node.inputs]
    side = 0 if bounds[0] is None else 1
    bound, drawn = bounds[1 - side], _scaled_uniform(graph, node.inputs[side])
    if bound is None or bound.size != 1 or drawn is None or not drawn[0] > 0:
        return None
    below = min(1.0, max(0.0, float(bound.reshape(())) / drawn[0]))
    return (below if less == (side == 0) else 1 - below), drawn[1]
