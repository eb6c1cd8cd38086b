"""``recurrent_in`` and ``recurrent_out``: a policy's memory, and behind it the last action where nothing feeds that.

ML-Agents keeps what ``recurrent_out`` gives for each agent, feeds it at the agent's next step, and feeds zeros in a new
episode. So a last action that a player does not feed (0.1 and 0.2), or cannot (3.0 and 4.0 write integers into what has
to be float32: InvalidCastException at the first decision, ../shared/unity/r3/player.json), is kept there: zeros at the
beginning are what it would have been fed, too.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct
from msgspec.structs import replace

from export_model.converters.consumers.mlagents import input_mapping as feeding
from export_model.converters.consumers.mlagents.names import ACTION, CONTINUOUS, DISCRETE, RECURRENT_IN, RECURRENT_OUT
from export_model.converters.consumers.mlagents.naming import Dressing, row
from export_model.converters.graph.types import FLOAT32
from export_model.signatures.roles import Role
from export_model.signatures.spec import Memory, TensorSpec

#: Of a file with both actions, whose memory can carry one: in a note, in ``inspect --unity`` and in ``snippets``.
DRAWN_KEPT = (
    "the memory keeps the drawn action, and with Deterministic Inference on the other one is played: the next step "
    "is fed another last action than the one that was taken (5 to 20 of 160 decisions differed); export with "
    "--deterministic for that"
)

Shape = Callable[[int], tuple[int | None, ...]]


class RecurrentState(Struct, frozen=True):
    """The memory as the consumer has it: ``size`` numbers for each agent, the last ``columns`` the last action."""

    size: int
    columns: int = 0


def previous_action(dressing: Dressing) -> TensorSpec | None:
    """Return the policy's input for the last action, None where it has none."""
    return next((s for s in dressing.policy.signature.inputs if s.role is Role.PREV_ACTION), None)


def action_columns(previous: TensorSpec) -> int:
    """Return how many numbers the last action has for each agent: one for each branch."""
    return int(previous.shape[1] or 1) if len(previous.shape) > 1 else 1


def take_memory(dressing: Dressing, carried: TensorSpec | None, shape: Shape) -> RecurrentState:
    """Take ``recurrent_in``: the policy's memory, and behind it the last action where that is ``carried``.

    ``shape`` gives the shape of the consumer's input for a number of columns. Raises ProfileError where the source
    takes a memory and does not give it back.
    """
    memory = dressing.policy.signature.memory
    own = None if memory is None or memory.input is None else dressing.policy.signature.input(memory.input)
    if memory is not None and own is not None and memory.output is None:
        feeding.refuse_lost_memory(dressing, own.name)
    kept = memory.size if memory is not None and own is not None else 0
    columns = 0 if carried is None else action_columns(carried)
    size = kept + columns
    if not size:
        return RecurrentState(0)
    spec = own or TensorSpec(RECURRENT_IN, Role.MEMORY_IN, "float32", shape(size), None)
    taken = dressing.take(RECURRENT_IN, spec, shape(size))
    if carried is None:
        dressing.give_in(spec, taken)
        return RecurrentState(size)
    builder = dressing.builder
    flat = row(builder, taken, size)
    if own is not None:
        dressing.give_in(own, builder.slice(flat, 1, 0, kept))
    dressing.give_in(carried, builder.slice(flat, 1, kept, size))
    numbers = "last number" if columns == 1 else f"last {columns} numbers"
    dressing.notes.append(
        f"{dressing.profile} does not feed the last action: it is kept as the {numbers} of the memory, "
        f"so that the memory size is {size} (an old brain's Memory Size); it is the action that the file gives, "
        + ("the deterministic one" if is_deterministic(dressing) else "a drawn one (--deterministic keeps the other)")
    )
    return RecurrentState(size, columns)


def is_deterministic(dressing: Dressing) -> bool:
    """Whether the policy's action is the one without chance."""
    actions = [s.role for s in dressing.policy.signature.outputs if s.name in (ACTION, DISCRETE)]
    return Role.DETERMINISTIC in actions


def give_memory(dressing: Dressing, state: RecurrentState, shape: Shape) -> Memory | None:
    """Give ``recurrent_out`` in ``shape``, the actions given so far behind the policy's memory where they are kept.

    Raises ProfileError where the actions are not as many numbers as the policy takes for its last one.
    """
    if not state.size:
        return None
    memory, builder = dressing.policy.signature.memory, dressing.builder
    parts = []
    if memory is not None and memory.output is not None:
        parts.append(row(builder, dressing.own(memory.output), memory.size))
    if state.columns:
        parts.append(_last_action(dressing, state.columns))
    given = builder.concat(parts, 1)
    wanted = [-1 if d is None else d for d in shape(state.size)]
    if len(wanted) > 2:
        given = builder.add("Reshape", [given, builder.ints(wanted, "memory")], "recurrent_out/rows")
    dressing.give(RECURRENT_OUT, given, Role.MEMORY_OUT)
    layout = () if memory is None or state.columns else memory.layout
    return Memory(state.size, RECURRENT_IN, RECURRENT_OUT, layout)


def _last_action(dressing: Dressing, columns: int) -> str:
    """The action [B, columns] as float32: the discrete one, which ML-Agents feeds as the last, else the continuous."""
    builder = dressing.builder
    names = [n for n in (DISCRETE, ACTION, CONTINUOUS) if n in dressing.fetches]
    width = builder.length(dressing.fetches[names[0]], -1)
    if width != columns:
        dressing.refuse(
            f"its last action has {columns} columns and its action {width}",
            why=f"{dressing.profile} does not feed the last action, so the action itself is kept with the memory",
            fix="say which output is the action: --output NAME=action",
        )
    return row(builder, builder.cast(dressing.fetches[names[0]], FLOAT32), columns)


# ------------------------------------------------------------------ in parts, which Barracuda carries by itself

#: The parts of a memory that does not say of how many it is made; ML-Agents asks for a ``_c`` and a ``_h``.
_HALVES = ("c", "h")


class Part(Struct, frozen=True):
    """A part of a memory: what its input and its output are called, and how many numbers it has."""

    taken: str
    given: str
    size: int


def memory_parts(memory: Memory) -> list[Part]:
    """Return the parts of a memory of more than one number: those that it names, else two halves."""
    layout, size = memory.layout, memory.size
    if len(layout) < 2 or size % len(layout):
        layout, sizes = _HALVES, [size - size // 2, size // 2]
    else:
        sizes = [size // len(layout)] * len(layout)
    groups = [layout[:number].count(part) for number, part in enumerate(layout)]
    ends = [f"_{group}_{part}" if group else f"_{part}" for group, part in zip(groups, layout, strict=True)]
    return [Part(RECURRENT_IN + e, RECURRENT_OUT + e, n) for e, n in zip(ends, sizes, strict=True)]


def take_parts(dressing: Dressing) -> list[Part]:
    """Take the memory in its parts. Raises ProfileError where the source gives none back, or one number."""
    memory = dressing.policy.signature.memory
    if memory is None or memory.input is None:
        return []
    own = dressing.policy.signature.input(memory.input)
    if memory.output is None:
        feeding.refuse_lost_memory(dressing, own.name)
    if memory.size < 2:
        dressing.refuse(
            "its memory is one number",
            why="ML-Agents asks for a memory in two parts",
            fix="write another format: the others hold it",
        )
    parts = memory_parts(memory)
    taken = [dressing.take(p.taken, replace(own, source=None), (None, p.size)) for p in parts]
    dressing.give_in(own, dressing.builder.concat(taken, 1))
    return parts


def give_parts(dressing: Dressing, parts: list[Part]) -> None:
    """Give the memory in its parts, which Barracuda feeds back."""
    memory, builder = dressing.policy.signature.memory, dressing.builder
    if not parts or memory is None or memory.output is None:
        return
    whole = row(builder, dressing.own(memory.output), memory.size)
    start = 0
    for part in parts:
        dressing.give(part.given, builder.slice(whole, 1, start, start + part.size), Role.MEMORY_OUT)
        dressing.kept[part.taken] = part.given
        start += part.size
