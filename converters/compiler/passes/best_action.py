"""Makes the best of the values of actions (Q-values) the action, and keeps the values beside it."""

from __future__ import annotations

from msgspec.structs import replace

from export_model.converters.compiler.compilation import Compilation
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import node_of
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import INT64
from export_model.converters.policy.action import action_meaning
from export_model.converters.policy.action_values import (
    EVIDENCE,
    OutputCandidate,
    evidence_of,
    is_q_name,
    is_scores,
    is_state_value,
    last_layer,
    may_be_values,
    says_action,
)
from export_model.signatures.errors import NotAPolicyError, SignatureError
from export_model.signatures.roles import CANONICAL, Role

_VALUES = CANONICAL[Role.Q_VALUES]
_ACTION = "action"
#: What a reader says of a file that no trainer is known to write.
_UNKNOWN_FAMILY = "own model"


def rank_actions(c: Compilation) -> Compilation:
    """Tell values of actions from a continuous action, and add their argmax as the action.

    Raises SignatureError where what was said to be values is no row of them per agent, NotAPolicyError where the only
    output is the value of a state.
    """
    if _VALUES in c.fetches:
        if any(role is Role.ACTION for _, role, _ in c.brain.outputs):
            return c if _width(c, _VALUES) is not None else _without_role(c)
        return _with_best(c)
    if not _is_open(c):
        return c
    width = _width(c, _ACTION)
    given = _candidate(c)
    if width == 1 and len(c.brain.outputs) == 1 and is_state_value(given):
        raise NotAPolicyError(
            f"the only output, {given.name!r}, is a value: one number a row",
            why="a value network says how good a state (or a given action) is, and chooses no action",
            fix=f"give the policy that was trained beside it; if this is an action: --output {given.name}=action",
        )
    if width is None or width == 1:
        return c
    if is_scores(given.name):
        return _add_note(
            c,
            f"{given.name} are scores of a choice by their name, not normalised, and nothing tells how many branches "
            "they are of; they are exported as they are, as continuous actions; if the largest is the action: "
            f"--output {given.name}=q_values",
        )
    evidence = evidence_of(given)
    if evidence is None:
        return _add_note(
            c,
            f"nothing says whether {given.name} holds continuous actions or values of discrete ones (Q-values, "
            "scores); it is exported as continuous actions; if the largest is the action: "
            f"--output {given.name}=q_values",
        )
    if evidence is not EVIDENCE[0]:
        c = _add_note(
            c,
            f"{given.name} is taken for values of discrete actions (Q-values), since {evidence.said}; the action is "
            f"the largest; if it is a continuous action: --output {given.name}=action",
        )
    head = c.brain.heads[0].base
    outputs = tuple((base, Role.Q_VALUES if base == head else role, ref) for base, role, ref in c.brain.outputs)
    moved = {_VALUES if name == _ACTION else name: ref for name, ref in c.fetches.items()}
    sources = {_VALUES if name == _ACTION else name: source for name, source in c.sources.items()}
    return _with_best(replace(c, brain=replace(c.brain, outputs=outputs), fetches=moved, sources=sources))


def _is_open(c: Compilation) -> bool:
    """Whether it is not known what the one action is: neither from the user nor from the trainer nor by its name."""
    facts, heads = c.facts, [o for o in c.brain.outputs if o[1] is Role.ACTION]
    if len(heads) != 1 or facts.algorithm is not None or facts.family not in (None, _UNKNOWN_FAMILY):
        return False
    if node_of(heads[0][2]) in {node_of(n) for n in c.options.outputs}:
        return False
    tensor, dtype = c.fetches[_ACTION], infer_types(c.graph)[c.fetches[_ACTION]].dtype
    if dtype.kind != "f" or action_meaning(c.graph, tensor, dtype, has_masks=False).role is not Role.CONTINUOUS:
        return False
    name = _candidate(c).name
    if is_q_name(name):
        return True
    masked = Role.MASKS in c.roles.values()
    return (is_scores(name) or not says_action(name)) and not masked and may_be_values(c.graph, tensor)


def _candidate(c: Compilation) -> OutputCandidate:
    reference = next(ref for _, role, ref in c.brain.outputs if role is Role.ACTION)
    source = c.sources.get(_ACTION)
    name = (source if isinstance(source, str) else reference).removesuffix(":0")
    layer = last_layer(c.source, reference)
    return OutputCandidate(c.graph, c.fetches[_ACTION], name, layer, c.facts.model_name, c.facts.loss)


def _width(c: Compilation, output: str) -> int | None:
    """Numbers a row of a float output [B, n], [B, 1, n] or [B]; None where it is of another shape."""
    kind = infer_types(c.graph)[c.fetches[output]]
    shape = kind.shape or ()
    if kind.dtype.kind != "f" or not shape:
        return None
    if len(shape) == 1:
        return 1
    flat = len(shape) == 2 or (len(shape) == 3 and shape[1] == 1)
    return shape[-1] if flat and isinstance(shape[-1], int) else None


def _with_best(c: Compilation) -> Compilation:
    """The index of the largest value as the action, int64 [B, 1]."""
    values = c.fetches[_VALUES]
    width, shape = _width(c, _VALUES), infer_types(c.graph)[values].shape or ()
    if width is None or width < 2:
        raise SignatureError(
            f"{c.sources.get(_VALUES)!r} cannot be values of actions: its shape is [{', '.join(map(str, shape))}]",
            why="a value of each action is wanted, float32 [B, actions]",
            fix="export the network with one number per action, or give the output another role",
        )
    editor = Editor(c.graph)
    editor.keep_all()
    axis, column = editor.ints(len(shape) - 1, "best/axis"), editor.ints([-1, 1], "best/column")
    best = editor.add("ArgMax", [values, axis], "best/argmax", output_type=INT64)
    action = editor.add("Reshape", [best, column], "best/action")
    outputs = ((_ACTION, Role.ACTION, action), *(o for o in c.brain.outputs if o[1] is not Role.ACTION))
    return replace(
        c,
        graph=editor.graph(),
        brain=replace(c.brain, outputs=outputs),
        fetches={_ACTION: action, **c.fetches},
        sources={**c.sources, _ACTION: None},
    )


def _without_role(c: Compilation) -> Compilation:
    """Values of another shape than a number per action (quantiles, say) are one more output."""
    outputs = tuple((b, Role.OTHER if role is Role.Q_VALUES else role, ref) for b, role, ref in c.brain.outputs)
    return replace(c, brain=replace(c.brain, outputs=outputs))


def _add_note(c: Compilation, note: str) -> Compilation:
    return replace(c, facts=replace(c.facts, notes=(*c.facts.notes, note)))
