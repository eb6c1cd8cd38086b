"""Several memories become one: ``recurrent_in`` [B, n] is split into them, ``recurrent_out`` [B, n] joins them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.compiler.options import CompileOptions
from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, TensorShape, joined_name, node_of, normal_ref, split_ref
from export_model.converters.graph.shapes import infer_types
from export_model.converters.graph.types import FLOAT32, static_shape
from export_model.converters.policy.facts import SourceFacts
from export_model.converters.policy.inputs import role_by_name
from export_model.converters.policy.memories import paired_memories
from export_model.converters.policy.rules import RoleDecision
from export_model.signatures.errors import SignatureError
from export_model.signatures.memories import SeparateMemory, SourcePart
from export_model.signatures.roles import ACTING, CANONICAL, Role


class Joined(Struct, frozen=True):
    """A graph with one memory, what is then said of it, and the source's tensors that it stands for, by role."""

    graph: Graph
    options: CompileOptions
    facts: SourceFacts
    parts: Mapping[Role, tuple[SourcePart, ...]] = field(default_factory=dict)


def join_memories(graph: Graph, options: CompileOptions, facts: SourceFacts) -> Joined:
    """Join the memories that the format tells of, or that the user names: inputs and outputs in the source's order.

    Raises SignatureError where the named ones do not belong together.
    """
    memories = _memories(graph, options, facts)
    if not memories:
        return Joined(graph, options, facts)
    origins = {m.input: _origin(graph, m.input) for m in memories} | {
        m.output: _origin(graph, m.output) for m in memories
    }
    joined, taken, given = _rewrite(graph, memories, origins)
    inputs, outputs = {m.input for m in memories}, {m.output for m in memories}
    wanted = {n: r for n, r in options.outputs.items() if normal_ref(n) not in outputs}
    if not {*wanted.values()}.isdisjoint(
        ACTING
    ):  # naming the action says that the rest is left out; a memory belongs to it
        wanted[given] = Role.MEMORY_OUT
    declared = {n: r for n, r in facts.outputs.items() if n not in outputs}
    return Joined(
        joined,
        replace(options, inputs={n: r for n, r in options.inputs.items() if node_of(n) not in inputs}, outputs=wanted),
        replace(
            facts,
            roles={**facts.roles, taken: Role.MEMORY_IN},
            outputs={**declared, given: Role.MEMORY_OUT},
            memory_layout=tuple(m.part for m in memories) if all(m.part for m in memories) else (),
            decisions={**facts.decisions, **_reasons(memories, options, facts, (taken, given), origins)},
        ),
        {
            Role.MEMORY_IN: tuple(SourcePart(origins[m.input], m.taken) for m in memories),
            Role.MEMORY_OUT: tuple(SourcePart(origins[m.output], m.given) for m in memories),
        },
    )


def _reasons(
    memories: Sequence[SeparateMemory],
    options: CompileOptions,
    facts: SourceFacts,
    made: tuple[str, str],
    origins: Mapping[str, str],
) -> dict[str, RoleDecision]:
    """Why the inputs and outputs that were joined are the memory."""
    said = []
    for memory in memories:
        known = facts.decisions.get(memory.input)
        why = "its name and shape agree with those of {}" if known is None or known.role is None else known.says
        why = "the user says so" if options.inputs.get(memory.input) is Role.MEMORY_IN else why
        said.append(f"{origins[memory.input]}: {why.format(origins[memory.output])}")
    text = f"it is made of {'; '.join(said)}"
    taken, given = made
    return {
        taken: RoleDecision(taken, Role.MEMORY_IN, text),
        given: RoleDecision(
            given, Role.MEMORY_OUT, f"it is fed back to {', '.join(origins[m.input] for m in memories)}"
        ),
    }


def _memories(graph: Graph, options: CompileOptions, facts: SourceFacts) -> tuple[SeparateMemory, ...]:
    given_in = {node_of(n): r for n, r in options.inputs.items()}
    given_out = {normal_ref(n): r for n, r in options.outputs.items()}
    told = tuple(
        m
        for m in (_pair_by_name(graph, facts) if facts.memories is None else facts.memories)
        if m.input not in options.values
        and given_in.get(m.input) in (None, Role.MEMORY_IN)
        and given_out.get(m.output) in (None, Role.MEMORY_OUT)
    )
    inputs = [n.name for n in graph.nodes if given_in.get(n.name) is Role.MEMORY_IN]
    named = [n for n, role in given_out.items() if role is Role.MEMORY_OUT]
    outputs = [n for n in facts.outputs if n in named] + [n for n in named if n not in facts.outputs]
    if {*inputs} <= {m.input for m in told} and {*outputs} <= {m.output for m in told}:
        return told
    # A format that declares no outputs has several brains in one graph, each with a memory of its own.
    if not facts.outputs or (max(len(inputs), len(outputs)) < 2 and all(_has_rows_first(graph[n]) for n in inputs)):
        return ()
    return _memories_from_user(graph, inputs, outputs)


def _pair_by_name(graph: Graph, facts: SourceFacts) -> tuple[SeparateMemory, ...]:
    """The memories that names and shapes tell, of inputs that nothing else is known of."""
    named = (n for n in graph.nodes if n.op == "Placeholder" and n.name not in facts.roles)
    unknown = [n.name for n in named if role_by_name(n.name.rsplit("/", 1)[-1], n) is None]
    outputs = [n for n, role in facts.outputs.items() if role is None]
    return paired_memories(unknown, outputs, lambda: infer_types(graph, partial=True))


def _memories_from_user(graph: Graph, inputs: Sequence[str], outputs: Sequence[str]) -> tuple[SeparateMemory, ...]:
    """The memories that the user names, the first output fed back to the first input."""
    if len(inputs) != len(outputs):
        raise SignatureError(
            f"{len(inputs)} inputs are memories ({', '.join(inputs) or 'none'}), and {len(outputs)} outputs "
            f"({', '.join(outputs) or 'none'})",
            why="each memory needs its own output to be fed back from",
            fix="name as many of both: --input NAME=memory_in, --output NAME=memory_out",
        )
    types = infer_types(graph, partial=True)
    memories = []
    for name, tensor in zip(inputs, outputs, strict=True):
        shapes: list[tuple[int | None, ...]] = []
        for reference in (name, tensor):
            kind = types.get(reference)
            shape = None if kind is None else static_shape(kind.shape)
            if kind is None or shape is None or kind.dtype != FLOAT32 or shape.count(None) != 1:
                raise SignatureError(
                    f"{reference!r} cannot be a part of the memory",
                    why="a memory is float32 with one free axis, the batch; it is "
                    + ("not in the graph" if kind is None else f"{kind.dtype.name} {list(shape or ())}"),
                    fix="export the model with the batch axis of its memories free (dynamic_axes)",
                )
            shapes.append(shape)
        memories.append(SeparateMemory(name, tensor, shapes[0], shapes[1]))
        sizes = [_size(shape) for shape in shapes]
        if sizes[0] != sizes[1]:
            raise SignatureError(
                f"the memory {name!r} takes {sizes[0]} numbers a row, and {tensor!r} gives {sizes[1]}",
                why="memories are put together in the order of the file: the first output is fed to the first input",
                fix="give the role memory_in, memory_out to those alone that belong together",
            )
    return tuple(memories)


def _rewrite(graph: Graph, memories: Sequence[SeparateMemory], origins: Mapping[str, str]) -> tuple[Graph, str, str]:
    """(the graph with one memory, its placeholder, the node that gives it)."""
    editor = Editor(graph)
    taken = editor.add_name(CANONICAL[Role.MEMORY_IN])
    attrs = {"dtype": FLOAT32, "shape": TensorShape((None, sum(_size(m.taken) for m in memories)))}
    editor.keep(Node(taken, "Placeholder", attrs=attrs, origin=joined_name([origins[m.input] for m in memories])))
    bounds = itertools.pairwise(itertools.accumulate((_size(m.taken) for m in memories), initial=0))
    for memory, ends in zip(memories, bounds, strict=True):
        editor.redirect(memory.input, _split(editor, taken, memory, ends, origins[memory.input], len(memories)))
    gone = {m.input for m in memories}
    for node in graph.nodes:
        if node.name not in gone:
            editor.keep(node)
    columns = [_columns(editor, memory) for memory in memories]
    name, origin = CANONICAL[Role.MEMORY_OUT], joined_name([origins[m.output] for m in memories])
    editor.prefix = ""
    if len(columns) > 1:
        given = editor.add("ConcatV2", [*columns, editor.ints(1, f"{name}/axis")], name, origin)
    else:
        given = editor.add("Identity", columns, name, origin)
    return editor.graph(), taken, given


def _split(editor: Editor, taken: str, memory: SeparateMemory, bounds: tuple[int, int], origin: str, count: int) -> str:
    """A memory's columns of ``recurrent_in``, in the shape that the source takes it in."""
    editor.prefix, shape = memory.input, memory.taken
    part = taken if count == 1 else editor.slice(taken, 1, *bounds, name="columns")
    axis = shape.index(None)
    rest = [d for d in shape if d is not None]
    before = math.prod(rest[:axis])
    if len(shape) > 2:
        dims = [-1 if d is None else d for d in shape] if before == 1 else [-1, *rest]
        part = editor.add("Reshape", [part, editor.ints(dims, "shape")], "rows")
    if before != 1:
        order = [*range(1, axis + 1), 0, *range(axis + 1, len(shape))]
        part = editor.add("Transpose", [part, editor.ints(order, "order")], "part")
    return editor.add("Identity", [part], "given", origin)


def _columns(editor: Editor, memory: SeparateMemory) -> str:
    """A memory as the source gives it, [B, n]."""
    part, shape = memory.output, memory.given
    editor.prefix = f"{split_ref(part)[0]}/fed_back"
    axis = shape.index(None)
    rest = [d for d in shape if d is not None]
    if math.prod(rest[:axis]) != 1:
        order = [axis, *(i for i in range(len(shape)) if i != axis)]
        part = editor.add("Transpose", [part, editor.ints(order, "order")], "rows")
    if shape[1:] == (_size(shape),):
        return part
    return editor.add("Reshape", [part, editor.ints([-1, _size(shape)], "shape")], "columns")


def _has_rows_first(node: Node) -> bool:
    """Whether a placeholder's batch is its first axis, as a memory's is."""
    return not node.dims or node.dims[0] is None


def _size(shape: Sequence[int | None]) -> int:
    return math.prod(d for d in shape if d is not None)


def _origin(graph: Graph, reference: str) -> str:
    """The source's name for a tensor."""
    name, index = split_ref(reference)
    origin = graph[name].origin
    return origin if index == 0 and isinstance(origin, str) else f"{name}:{index}"
