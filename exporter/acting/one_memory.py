"""A policy whose memory is several tensors (``h_in``, ``c_in``), as one with a single row of memory for each agent."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from export_model.signatures.batches import Arrays, Run
from export_model.signatures.memories import SourcePart, join_memory, split_memory
from export_model.signatures.roles import CANONICAL, Role
from export_model.signatures.spec import PolicySignature, TensorSpec

TAKEN, GIVEN = CANONICAL[Role.MEMORY_IN], CANONICAL[Role.MEMORY_OUT]


def with_one_memory(signature: PolicySignature, run: Run) -> tuple[PolicySignature, Run]:
    """The signature with ``recurrent_in`` and ``recurrent_out`` [agents, size], and ``run`` for it.

    Both are as they were where the memory is a single tensor.
    """
    memory = signature.memory
    if memory is None or not memory.others:
        return signature, run
    taken = [SourcePart(name, signature.input(name).shape) for name, _ in signature.recurrences]
    given = [SourcePart(name, signature.output(name).shape) for _, name in signature.recurrences]

    def run_with_parts(feeds: Arrays, fetch: Sequence[str]) -> Arrays:
        parts = split_memory(taken, feeds[TAKEN])
        wanted = [n for name in fetch for n in ([p.tensor for p in given] if name == GIVEN else [name])]
        answers = run({**{n: a for n, a in feeds.items() if n != TAKEN}, **parts}, wanted)
        return {name: join_memory(given, answers) if name == GIVEN else answers[name] for name in fetch}

    joined = replace(
        signature,
        inputs=_with_one(signature.inputs, TAKEN, [p.tensor for p in taken], memory.size),
        outputs=_with_one(signature.outputs, GIVEN, [p.tensor for p in given], memory.size),
        memory=replace(memory, input=TAKEN, output=GIVEN, others=()),
    )
    return joined, lambda feeds, fetch: dict(run_with_parts(feeds, fetch))


def _with_one(specs: Sequence[TensorSpec], name: str, parts: Sequence[str], size: int) -> tuple[TensorSpec, ...]:
    """The specs with one of [agents, size] in place of the first of ``parts``, and none of the others."""
    one = [replace(s, name=name, shape=(None, size)) if s.name == parts[0] else s for s in specs]
    return tuple(s for s in one if s.name not in parts)
