"""Outputs that a format declares and that mean nothing to us: kept where they have a row per agent."""

from __future__ import annotations

from dataclasses import replace

from converters.graph.compilation import Compilation
from converters.graph.nodes import normal_ref
from converters.graph.passes.normalise import normalise
from converters.graph.shapes import infer_types
from converters.graph.types import FLOAT32, static_shape
from signatures.errors import GraphError, SignatureError, UnsupportedOpError
from signatures.roles import OBSERVATIONS, Role


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
    """An output that is made of an input and has its shape is fed back to it, for all that is known: where another
    input is the observation, and nobody said what the output is. One that is left out is looked at in the source.
    """
    fed = [n for n, r in c.roles.items() if r in OBSERVATIONS or r is Role.PARAMETER]
    named = {normal_ref(n) for n in c.options.outputs} | {r for _, role, r in c.brain.outputs if role is not Role.OTHER}
    for name in (n for n, role in c.facts.outputs.items() if role is None and len(fed) > 1 and n not in named):
        try:
            graph = normalise(c.original.pruned([name]), [name])
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
