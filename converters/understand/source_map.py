"""How to run the source beside its export: what becomes of its placeholders, samplers and branches."""

from __future__ import annotations

from collections.abc import Sequence

from converters.graph.compilation import Compilation
from converters.graph.nodes import split_ref
from converters.graph.passes.inputs import batch_size_rank, constant_value
from converters.graph.passes.noise import tensor_of
from signatures.roles import Role
from signatures.spec import SourceMap, sources


def branch_origins(c: Compilation, branches: Sequence[str]) -> tuple[str | None, ...]:
    """The source's tensors that a sampled action is drawn from."""
    known = {n.origin for n in c.source.nodes}
    found: list[str | None] = []
    for branch in branches:
        origin = c.graph.producer(branch).origin if split_ref(branch)[1] == 0 else None
        found.append(origin if isinstance(origin, str) and origin in known else None)
    return tuple(found)


def source_map(c: Compilation) -> SourceMap:
    """The map of a compilation that is signed."""
    assert c.signature is not None
    inputs, outputs, source = c.signature.inputs, c.signature.outputs, c.source
    fixed = {
        tensor_of(source[n]): constant_value(source[n], 1) for n, r in c.roles.items() if r is Role.SEQUENCE_LENGTH
    }
    given = {tensor_of(c.original[n]): constant_value(c.original[n], v) for n, v in c.options.values.items()}
    parts = {s.name: c.parts[s.role] for s in (*inputs, *outputs) if s.role in c.parts}
    return SourceMap(
        feeds=sources(inputs, parts),
        fetches=sources(outputs, parts),
        fixed={**fixed, **given},
        batch_sizes={
            tensor_of(source[n]): batch_size_rank(source, source[n]) for n, r in c.roles.items() if r is Role.BATCH_SIZE
        },
        noise=dict(c.noise),
        noise_kept=c.options.noise == "keep" and not c.options.deterministic,
        branches=c.branch_origins,
        rows=c.facts.rows,
        parts=parts,
    )
