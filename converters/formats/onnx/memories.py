"""The memories of an ONNX model that are inputs and outputs of their own: ``h_in``, ``c_in`` to ``h_out``, ``c_out``.

rsl_rl's and Isaac Lab's exporters (_OnnxPolicyExporter: [layers, 1, hidden], opset 11, no dynamic axes), recipes for
SB3-contrib's RecurrentPPO and for GRUs write them so. They are told by what they are, not by their names: an input that
reaches the initial state of a recurrent layer, and the output that gives the last state of the same.
Operands and outputs by position: onnx/docs/Operators.md (LSTM, GRU).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from msgspec import Struct, field

from export_model.converters.formats.onnx.importer.node import STANDARD
from export_model.converters.policy.rules import RoleDecision, Rule, always, first
from export_model.signatures.roles import Role

Dims = tuple[int | None, ...] | None

#: op → its states: part, operand of the initial one, output of the last one
_STATES = {"LSTM": (("h", 5, 1), ("c", 6, 2)), "GRU": (("h", 5, 1),)}
#: Ops that pick and move elements, with how many of their operands hold them (None: all).
_MOVES: Mapping[str, int | None] = {
    **dict.fromkeys(("Identity", "Cast", "Slice", "Split", "Squeeze", "Unsqueeze", "Reshape", "Flatten", "Gather"), 1),
    "Transpose": 1,
    "Concat": None,
}
#: Ops by which a state is forgotten where an episode begins (SB3-contrib's ``episode_starts``).
_RESETS: Mapping[str, int | None] = {"Mul": None, "Where": None}
#: Recurrent layers and outputs that are looked through; a policy has a few, a damaged file may have any number.
_MOST = 64


class OnnxMemory(Struct, frozen=True):
    """An input and the output that is fed back to it, ``part`` h or c; the batch is the input's axis ``axis``."""

    input: str
    output: str
    part: str
    axis: int


class Start(Struct, frozen=True):
    """An input that recurrent layers begin with.

    ``states`` are (layer, part) of each, ``ends`` the outputs that give the last of the same states and may have its
    shape, and ``axis`` is its batch axis, where they tell it.
    """

    states: frozenset[tuple[int, str]]
    ends: tuple[str, ...]
    axis: int | None

    @property
    def parts(self) -> set[str]:
        """Which states of a layer it is: h, c, or both."""
        return {part for _, part in self.states}


#: Whether an input is a memory that is fed back from an output.
_RULES: tuple[Rule[Start, Role | None], ...] = (
    Rule(None, lambda s: len(s.parts) != 1, "it begins the hidden and the cell state alike"),
    Rule(
        None, lambda s: not s.ends, "a recurrent layer begins with it, and no output of its shape gives the last state"
    ),
    Rule(None, lambda s: len(s.ends) > 1, "a recurrent layer begins with it, and several outputs give the last state"),
    Rule(
        None, lambda s: s.axis is None, "a recurrent layer begins with it, and several of its axes may be the agents'"
    ),
    Rule(Role.MEMORY_IN, always, "a recurrent layer begins with it, and one output gives the last state"),
)


class FoundMemories(Struct, frozen=True):
    """The memories in the order of the inputs, input → its batch axis, and input → what was decided of it.

    There are no memories where it is not plain for each of them which output belongs to it; the states of several
    layers have a batch axis all the same.
    """

    memories: tuple[OnnxMemory, ...] = ()
    axes: Mapping[str, int] = field(default_factory=dict)
    decisions: Mapping[str, RoleDecision] = field(default_factory=dict)


def separate_memories(
    graph: Any, inputs: Mapping[str, Dims], outputs: Mapping[str, Dims], floats: frozenset[str]
) -> FoundMemories:
    """The memories of a GraphProto that are inputs and outputs of their own.

    ``inputs`` and ``outputs`` have the declared shapes, ``floats`` are the inputs of float32.
    """
    if max(sum(1 for n in graph.node if _states(n)), len(outputs)) > _MOST:
        return FoundMemories()
    starts = _starts(graph, inputs, outputs, floats)
    decisions, memories = {}, []
    for name, start in starts.items():
        rule = first(_RULES, start)
        assert rule is not None
        decisions[name] = RoleDecision(name, rule.role, rule.says)
        if rule.role is not None and start.axis is not None:
            memories.append(OnnxMemory(name, start.ends[0], start.parts.pop(), start.axis))
    axes = {name: start.axis for name, start in starts.items() if start.axis is not None}
    if len(memories) == len(starts):
        return FoundMemories(tuple(memories), axes, decisions)
    axes = {name: axis for name, axis in axes.items() if (inputs[name] or (1,))[0] != 1}
    return FoundMemories((), axes, decisions)


def _starts(
    graph: Any, inputs: Mapping[str, Dims], outputs: Mapping[str, Dims], floats: frozenset[str]
) -> dict[str, Start]:
    """The inputs that recurrent layers begin with, in their order."""
    walk = _Walk(graph)
    states: dict[str, set[tuple[int, str]]] = {}
    turned: set[str] = set()
    for number, node in enumerate(graph.node):
        for part, operand, _ in _states(node):
            hidden = next((int(a.i) for a in node.attribute if a.name == "hidden_size"), None)
            if operand >= len(node.input) or hidden is None:
                continue
            found, transposed = walk.back(node.input[operand], {**_MOVES, **_RESETS})
            batch_first = any(a.name == "layout" and a.i for a in node.attribute)
            for name in found & floats:
                dims = inputs.get(name)
                if dims is None or len(dims) not in (2, 3) or dims[-1] != hidden:
                    continue
                states.setdefault(name, set()).add((number, part))
                if transposed != batch_first:
                    turned.add(name)
    ends = {name: walk.states(name) for name in outputs}
    return {
        name: Start(
            frozenset(states[name]),
            tuple(o for o, found in ends.items() if found == states[name] and _fits(inputs[name], outputs[o])),
            _batch_axis(inputs[name], name in turned),
        )
        for name in inputs
        if name in states
    }


class _Walk:
    """Values of a graph, followed back to where they come from."""

    def __init__(self, graph: Any) -> None:
        self.made = {value: (i, node) for i, node in enumerate(graph.node) for value in node.output if value}

    def back(self, value: str, through: Mapping[str, int | None]) -> tuple[set[str], bool]:
        """The values that ``value`` is made of by moving elements alone, and whether any was transposed."""
        found: set[str] = set()
        seen: set[str] = set()
        transposed = False
        stack = [value]
        while stack:
            name = stack.pop()
            if not name or name in seen:
                continue
            seen.add(name)
            _, node = self.made.get(name, (0, None))
            if node is None or node.domain not in STANDARD or node.op_type not in through:
                found.add(name)
                continue
            transposed = transposed or node.op_type == "Transpose"
            stack.extend(list(node.input)[: through[node.op_type]])
        return found, transposed

    def states(self, value: str) -> set[tuple[int, str]]:
        """The last states that ``value`` is made of; empty where it is made of anything else."""
        states: set[tuple[int, str]] = set()
        for name in self.back(value, _MOVES)[0]:
            number, node = self.made.get(name, (0, None))
            own = [p for p, _, k in _states(node) if k < len(node.output) and node.output[k] == name] if node else []
            if not own:
                return set()
            states.add((number, own[0]))
        return states


def _states(node: Any) -> Sequence[tuple[str, int, int]]:
    return _STATES.get(node.op_type, ()) if node.domain in STANDARD else ()


def _fits(dims: Dims, other: Dims) -> bool:
    """Whether an output may have the shape of an input, as far as the file tells."""
    if dims is None or other is None:
        return dims is not None
    return len(dims) == len(other) and all(a is None or b is None or a == b for a, b in zip(dims, other, strict=True))


def _batch_axis(dims: Dims, batch_first: bool) -> int | None:
    """The free axis; of a shape without one, what the layer takes: [layers, B, hidden]."""
    if dims is None:
        return None
    free = [i for i, d in enumerate(dims) if d is None]
    if free:
        return free[0] if len(free) == 1 else None
    return 0 if batch_first or len(dims) == 2 else 1
