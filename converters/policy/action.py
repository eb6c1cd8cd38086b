"""What an action is: judged by its dtype and ancestors alone, never by its name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from msgspec import Struct

from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.ops.table import passes_on, traits
from export_model.converters.graph.shapes import infer_types
from export_model.signatures.roles import Role

_MAX_LEAVES = 1024
#: Clips of classes one after the other that are looked through: each asks what lies behind it anew.
_MAX_CLIPS = 4


class ActionMeaning(Struct, frozen=True):
    """What ``action`` is. ``draws`` are the samplers' logits per branch, ``sizes`` the branch sizes' tensors."""

    role: Role
    #: per branch: the tensor whose last axis is the branch (logits, log-probabilities or scores)
    branches: tuple[str, ...] = ()
    #: per branch: the sampler node, for sampled actions
    samplers: tuple[str, ...] = ()


def action_meaning(graph: Graph, reference: str, dtype: np.dtype, has_masks: bool) -> ActionMeaning:
    """Decide from dtype and ancestors whether an action is continuous, sampled, log-probabilities or an argmax.

    ``graph`` must be free of loops (after the unroll pass).
    """
    leaves = _leaves(graph, reference)
    producers = [graph.producer(leaf) for leaf in leaves]
    if dtype.kind in "iu":
        if all(traits(p).sampler == "categorical" for p in producers):
            return ActionMeaning(Role.SAMPLED, tuple(p.inputs[0] for p in producers), tuple(p.name for p in producers))
        if all(p.op == "ArgMax" or traits(p).sampler == "categorical" for p in producers):
            logits = [_without_gumbel(graph, p.inputs[0]) if p.op == "ArgMax" else p.inputs[0] for p in producers]
            # beside draws, an ArgMax is a branch of one action (``settle_single_draws`` writes it so)
            drawn = all(logits) or any(p.op != "ArgMax" for p in producers)
            branches = tuple(r if r and drawn else p.inputs[0] for r, p in zip(logits, producers, strict=True))
            return ActionMeaning(Role.SAMPLED if drawn else Role.DETERMINISTIC, branches)
        return ActionMeaning(Role.DETERMINISTIC)
    if all(p.op == "Log" or p.op == "LogSoftmax" for p in producers):
        return ActionMeaning(Role.LOG_PROBS, tuple(leaves))
    if all(p.op == "Softmax" for p in producers):
        return ActionMeaning(Role.PROBS, tuple(leaves))
    if has_masks:
        return ActionMeaning(Role.LOG_PROBS, tuple(leaves))
    return ActionMeaning(Role.CONTINUOUS)


def _without_gumbel(graph: Graph, scores: str) -> str | None:
    """The logits, where ``scores`` are logits − log(−log(u)) of a uniform u; None where they are not.

    The argmax of such scores is a draw (OpenAI Baselines, CategoricalPd.sample).
    """
    node = graph.producer(scores)
    if node.op == "Sub":
        pairs = [(node.inputs[0], node.inputs[1])]
    elif node.op == "Add":
        pairs = [
            (logits, graph.producer(noise).inputs[0])
            for logits, noise in (node.inputs, node.inputs[::-1])
            if graph.producer(noise).op == "Neg"
        ]
    else:
        return None
    return next((logits for logits, noise in pairs if _is_gumbel(graph, noise)), None)


def _is_gumbel(graph: Graph, reference: str) -> bool:
    """Whether a tensor is log(−log(u)), u drawn from 0 to 1."""
    drawn = _inside(graph, _inside(graph, _inside(graph, reference, "Log"), "Neg"), "Log")
    return drawn is not None and traits(graph.producer(drawn)).sampler == "uniform"


def _inside(graph: Graph, reference: str | None, op: str) -> str | None:
    """The operand of ``op``, where that makes a tensor."""
    node = None if reference is None else graph.producer(reference)
    return node.inputs[0] if node is not None and node.op == op else None


def _leaves(graph: Graph, reference: str) -> list[str]:
    """The tensors that are joined along the last axis to make ``reference``, in order.

    A join of a join of itself doubles with every step; what is made of more than ``_MAX_LEAVES`` is no action with
    branches, and stands for itself.
    """
    leaves: list[str] = []
    stack = [reference]
    while stack:
        if len(leaves) + len(stack) > _MAX_LEAVES:
            return [reference]
        tensor = stack.pop()
        parts = _parts(graph, graph.producer(tensor))
        if parts:
            stack.extend(reversed(parts))
        else:
            leaves.append(tensor)
    return leaves


def _clips_until(graph: Graph) -> Mapping[str, int]:
    """How many times classes are clipped one after the other until a node, by its name."""
    if _clips_until not in graph.cache:
        found: dict[str, int] = {}
        for node in graph.nodes:
            bound = graph.constant(node.inputs[1]) if node.op == "Minimum" else None
            clips = bound is not None and bound.dtype.kind in "iu"
            found[node.name] = max((found.get(node_of(r), 0) for r in node.inputs), default=0) + clips
        graph.cache[_clips_until] = found
    known: Mapping[str, int] = graph.cache[_clips_until]
    return known


def clips_nothing(graph: Graph, node: Node, width: Callable[[Graph, str], int | None]) -> bool:
    """Whether a node holds classes within bounds that they cannot leave (TF-Agents clips to the action's space).

    ``width`` says how many classes a tensor has.
    """
    bound = graph.constant(node.inputs[1]) if node.op == "Minimum" or node.op == "Maximum" else None
    if bound is None or bound.dtype.kind not in "iu":
        return False
    if node.op == "Maximum":
        return bool((bound <= 0).all())
    if _clips_until(graph)[node.name] > _MAX_CLIPS:
        return False
    widths = [width(graph, leaf) for leaf in _leaves(graph, node.inputs[0])]
    return all(w is not None and bool((bound >= w - 1).all()) for w in widths)


def _width(graph: Graph, reference: str) -> int | None:
    """The number of classes of a draw or an ArgMax."""
    node = graph.producer(reference)
    if not node.inputs or not (traits(node).sampler == "categorical" or node.op == "ArgMax"):
        return None
    width = (infer_types(graph)[node.inputs[0]].shape or (None,))[-1]
    return width if isinstance(width, int) else None


def _parts(graph: Graph, node: Node) -> Sequence[str]:
    """What a node passes on or joins along the last axis; empty where it computes."""
    if passes_on(node) or node.op == "Cast" or clips_nothing(graph, node, _width):
        return node.inputs[:1]
    if node.op == "ConcatV2":
        axis = graph.constant(node.inputs[-1])
        if axis is not None and int(axis) in (1, -1):
            return node.inputs[:-1]
    if node.op == "Pack" and node.attrs.get("axis", 0) in (1, -1):
        return node.inputs
    return ()
