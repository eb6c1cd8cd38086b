"""Outputs that a format declares and that mean nothing to us: kept where they have a row per agent."""

from __future__ import annotations

from dataclasses import replace

from converters.graph.compilation import Compilation
from converters.graph.shapes import infer_types
from signatures.roles import Role


def leave_out_without_rows(c: Compilation) -> Compilation:
    """Outputs of unknown meaning whose first axis is not the agents' go; the signature notes them by name."""
    others = [base for base, role, _ in c.brain.outputs if role is Role.OTHER and base in c.fetches]
    if not others:
        return c
    types = infer_types(c.graph)
    shapes = {name: types[c.fetches[name]].shape for name in others}
    gone = [name for name, shape in shapes.items() if shape is not None and not isinstance((*shape, 0)[0], str)]
    kept = {name: reference for name, reference in c.fetches.items() if name not in gone}
    return replace(c, fetches=kept, brain=replace(c.brain, left_out=(*c.brain.left_out, *gone)))
