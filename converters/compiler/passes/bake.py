"""``--bake actions``: scale, offset and clip of the continuous action in the graph, so that no caller applies them.

What is baked moves within the interface, from ``actions`` (and the limit of the raw action) to ``baked``: it is said
once, and a second bake has nothing left to do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from msgspec.structs import replace

from export_model.converters.graph.nodes import Graph, NameScope, Node, topological
from export_model.converters.interfaces.isaac_lab import RAW_ACTION
from export_model.converters.interfaces.registry import LEFT_OUT
from export_model.converters.policy.policy import Policy
from export_model.signatures.errors import UsageError
from export_model.signatures.interface import Interface, Range, Term
from export_model.signatures.roles import Role
from export_model.signatures.spec import PolicySignature

NOTE = "the graph computes scale, offset and clip of the action (--bake actions); apply nothing to it"
ALREADY = "--bake actions had nothing to do: the source's graph computes scale, offset and clip of the action already"
_GIVE = "state them beside the source, or in an interface with --labels"
_Entry = TypeVar("_Entry")
_MOST = float(np.finfo(np.float32).max)


def bake_actions(policy: Policy) -> Policy:
    """Return the policy with what is stated of its action computed by the graph. Raises UsageError."""
    signature, interface = policy.signature, policy.signature.interface
    head = next((h for h in signature.heads if h.is_continuous), None)
    if head is None:
        raise UsageError("--bake actions: the policy has no continuous action", fix="leave --bake out")
    raw = () if interface is None else tuple(q for q in interface.limits if q.name == RAW_ACTION)
    if interface is None or not (raw or any(term.changes for term in interface.actions)):
        if interface is not None and interface.baked:
            return replace(policy, signature=replace(signature, notes=(*signature.notes, ALREADY)))
        unread = "\n".join(note for note in signature.notes if LEFT_OUT in note)
        raise UsageError(
            "--bake actions: nothing that was read states a scale, an offset or a clip of the action",
            why=unread or None,
            fix=f"read what was left out, or {_GIVE}" if unread else _GIVE,
        )
    width = head.spec.shape[-1] or 0
    steps = [_Step(raw[0].clip * width if len(raw[0].clip) == 1 else raw[0].clip)] if raw else []
    steps.append(_whole(interface.actions, width))
    graph = policy.graph
    for name in (head.name, *([] if head.plain is None else [head.plain.name])):
        graph = _behind(graph, policy.fetches[name], steps)
    left_over = [o.name for o in signature.outputs if o.role in (Role.STD, Role.LOG_STD, Role.LOG_PROB)]
    notes = [NOTE, *([f"{', '.join(left_over)}: of the action before that"] if left_over else [])]
    return replace(policy, graph=graph, signature=_signature(signature, interface, notes))


class _Step:
    """A clip, or a scale, an offset and a clip, one entry for each number of the action."""

    def __init__(self, clip: Sequence[Range], scale: Sequence[float] = (), offset: Sequence[float] = ()) -> None:
        self.scale, self.offset, self.clip = scale, offset, clip


def _whole(terms: Sequence[Term], width: int) -> _Step:
    """The terms as one, side by side. Raises UsageError where a size is not stated."""
    sizes = [width] if len(terms) == 1 else [term.size or 0 for term in terms]
    if terms and (sum(sizes) != width or 0 in sizes):
        raise UsageError("--bake actions: the sizes of the action's terms are not stated", fix=_GIVE)
    scale, offset, clip = list[float](), list[float](), list[Range]()
    for term, size in zip(terms, sizes, strict=True):
        for found, values, neutral in ((scale, term.scale, 1.0), (offset, term.offset, 0.0)):
            found += _each(values or (neutral,), size)
        clip += _each(term.clip or ((None, None),), size)
    return _Step(clip, scale, offset)


def _each(values: Sequence[_Entry], size: int) -> list[_Entry]:
    if len(values) not in (1, size):
        raise UsageError(f"--bake actions: {len(values)} values are stated of {size} actions", fix=_GIVE)
    return list(values) * (size if len(values) == 1 else 1)


def _behind(graph: Graph, tensor: str, steps: Sequence[_Step]) -> Graph:
    """The graph with ``steps`` behind the node ``tensor``, whose name the last of them gets."""
    names = NameScope(n.name for n in graph.nodes)
    inner = names.fresh(f"{tensor}/raw")
    graph = graph.rename({tensor: inner})
    made: list[Node] = []

    def add(op: str, values: Sequence[float], neutral: float) -> None:
        if any(v != neutral for v in values):
            constant = names.fresh(f"{tensor}/{op}/value")
            made.append(Node(constant, "Const", value=np.array(values, np.float32)))
            before = next((n.name for n in reversed(made) if n.value is None), inner)
            made.append(Node(names.fresh(f"{tensor}/{op}"), op, (before, constant)))

    for step in steps:
        add("Mul", step.scale, 1.0)
        add("Add", step.offset, 0.0)
        add("Maximum", [-_MOST if low is None else low for low, _ in step.clip], -_MOST)
        add("Minimum", [_MOST if high is None else high for _, high in step.clip], _MOST)
    last = next((n.name for n in reversed(made) if n.value is None), inner)
    made.append(Node(tensor, "Identity", (last,), origin=graph[inner].origin))
    return Graph(topological([*graph.nodes, *made]))


def _signature(signature: PolicySignature, interface: Interface, notes: Sequence[str]) -> PolicySignature:
    raw = [Term(name=q.name, source=q.source, clip=q.clip) for q in interface.limits if q.name == RAW_ACTION]
    stripped = tuple(replace(t, scale=(), offset=(), clip=()) for t in interface.actions)
    moved = replace(
        interface,
        actions=stripped,
        baked=(*interface.baked, *raw, *(t for t in interface.actions if t.changes)),
        limits=tuple(q for q in interface.limits if q.name != RAW_ACTION),
    )
    return replace(signature, interface=moved, notes=(*signature.notes, *notes))


#: What ``--bake`` takes → the pass.
BAKED: dict[str, Callable[[Policy], Policy]] = {"actions": bake_actions}
