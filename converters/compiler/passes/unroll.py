"""Loops into straight lines.

``dynamic_rnn`` is a while loop over time; a policy runs it for one step. With ``sequence_length`` fixed, the number of
turns is known before the graph runs, so the loop is unrolled: each node of the body becomes a node per turn, tensor
arrays become the tensors that were written to them. Nothing is assumed of the cell, so LSTM, GRU and hand-written
cells go the same way, as do ``tf.cond`` branches whose predicate is a constant.

Precondition: normalised graph, ``sequence_length`` constant. Postcondition: no control flow is left. Raises
UnsupportedOpError where a predicate is not constant or a loop runs for more than ``MAX_TURNS``; NotAPolicyError where
the turns are more than ``MAX_POLICY_NODES`` together, or write more than ``MAX_HANDED_ON``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from export_model.converters.graph.editor import Editor
from export_model.converters.graph.nodes import Graph, Node, ref, split_ref
from export_model.converters.graph.ops.table import CONTROL_FLOW, unsupported_error
from export_model.converters.graph.shapes import Types, infer_types
from export_model.converters.graph.types import INT32
from export_model.signatures.errors import GraphError, NotAPolicyError, UnsupportedOpError

MAX_TURNS = 64
#: Of a policy, before its loops are unrolled and after.
MAX_POLICY_NODES = 1 << 14
#: Elements of tensor arrays that may be handed on, from each writing to the next: an array of 64 has 2,080.
MAX_HANDED_ON = 1 << 22


#: How many inputs each has; a Merge has any number.
_INPUTS = {
    **dict.fromkeys(("enter", "exit", "next_iteration", "loop_cond", "array"), 1),
    **dict.fromkeys(("switch", "size"), 2),
    **dict.fromkeys(("gather", "read"), 3),
    **dict.fromkeys(("scatter", "write"), 4),
}


class _Flow(Struct, frozen=True):
    """The content of a tensor array at one point of the program: index → tensor of the new graph."""

    size: int | None
    items: Mapping[int, str] = field(default_factory=dict)
    #: the tensor whose rows are the elements (TensorListFromTensor)
    source: str = ""


class _DeadError(Exception):
    """A tensor on the branch that is not taken."""


def unroll(graph: Graph) -> Graph:
    """See the module."""
    flow = [n for n in graph.nodes if n.op in CONTROL_FLOW]
    for node in flow:
        wanted = _INPUTS.get(CONTROL_FLOW[node.op])
        if not node.inputs or (wanted is not None and len(node.inputs) != wanted):
            raise _malformed_loop(node, f"it has {len(node.inputs)} inputs")
    try:
        return _Unroller(graph).run() if flow else graph
    except RecursionError as error:
        raise _malformed_loop(
            flow[0], "its loop or branch is deeper than any of a policy, or contains itself"
        ) from error


class _Unroller:
    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.types: Types = infer_types(graph, partial=True)
        self.editor = Editor(graph)
        self.frames = _frames(graph)
        self.memo: dict[tuple[str, int | None], str | _Flow | None] = {}
        self.turns: dict[str, int] = {}
        self.handed_on = 0
        self.predicates = {self.frames[n.name]: n for n in graph.nodes if n.op == "LoopCond" and n.name in self.frames}

    def run(self) -> Graph:
        read = {split_ref(r)[0] for n in self.graph.nodes for r in n.inputs}
        for node in self.graph.nodes:
            if node.name in self.frames:  # loop bodies are made on demand, once per turn
                if node.name not in read:  # an output
                    raise _malformed_loop(
                        node, f"the output {node.origin!r} is inside it, and no Exit leads out of there"
                    )
                continue
            try:
                self.tensor(node.name, None)
            except _DeadError:
                if node.name not in read:  # an output
                    raise GraphError(
                        f"the output {node.origin!r} is on the side of a branch that is not taken",
                        fix="the graph is damaged; freeze it again from its checkpoint",
                    ) from None
        return self.editor.graph()

    # ---- one tensor of the old graph, at one turn of its loop

    def tensor(self, reference: str, turn: int | None) -> str | _Flow:
        name, index = split_ref(reference)
        node = self.graph[name]
        if name not in self.frames:
            turn = None
        elif node.op == "Identity":
            return self.tensor(node.inputs[0], turn)  # it may pass on a tensor array, which is no tensor here
        if node.op in CONTROL_FLOW:
            key = (reference, turn)
            if key not in self.memo:
                self.memo[key] = self._control(node, index, turn)
            return _alive(self.memo[key])
        key = (name, turn)
        if key not in self.memo:
            self.memo[key] = self._copy(node, turn)
        made = _alive(self.memo[key])
        assert isinstance(made, str)
        return ref(made, index)

    def plain(self, reference: str, turn: int | None) -> str:
        value = self.tensor(reference, turn)
        if not isinstance(value, str):
            raise unsupported_error([self.graph.producer(reference)])
        return value

    def _copy(self, node: Node, turn: int | None) -> str | None:
        try:
            inputs = tuple(self.plain(r, turn) for r in node.inputs)
        except _DeadError:
            return None
        self._room(1)
        name = node.name if not turn else self.editor.add_name(f"{node.name}/turn_{turn}")
        copy = Node(name, node.op, inputs, node.attrs, node.value, node.origin)
        self.editor.nodes.append(copy)
        return name

    def _control(self, node: Node, index: int, turn: int | None) -> str | _Flow | None:
        try:
            return getattr(self, f"_{CONTROL_FLOW[node.op]}")(node, index, turn)  # type: ignore[no-any-return]
        except _DeadError:
            return None

    # ---- loops and branches

    def _enter(self, node: Node, index: int, turn: int | None) -> str | _Flow:
        return self.tensor(node.inputs[0], None)

    _next_iteration = _enter

    def _merge(self, node: Node, index: int, turn: int | None) -> str | _Flow:
        back = [r for r in node.inputs if self.graph.producer(r).op == "NextIteration"]
        if back and turn is not None:
            if turn == 0:
                return self.tensor(next(r for r in node.inputs if r not in back), 0)
            return self.tensor(self.graph.producer(back[0]).inputs[0], turn - 1)
        for reference in node.inputs:
            try:
                return self.tensor(reference, turn)
            except _DeadError:
                continue
        raise _DeadError

    def _switch(self, node: Node, index: int, turn: int | None) -> str | _Flow:
        if self.graph.producer(node.inputs[1]).op == "LoopCond":
            return self.tensor(node.inputs[0], turn)
        predicate = self._number(node, node.inputs[1], turn)
        if predicate is None:
            raise _undecided_loop(node, "the condition of a branch")
        if bool(predicate) != bool(index):
            raise _DeadError
        return self.tensor(node.inputs[0], turn)

    def _exit(self, node: Node, index: int, turn: int | None) -> str | _Flow:
        switch = self.graph.producer(node.inputs[0])
        return self.tensor(switch.inputs[0], self._turns(self.frames[switch.name]))

    def _loop_cond(self, node: Node, index: int, turn: int | None) -> str | _Flow:
        return self.tensor(node.inputs[0], turn)

    def _turns(self, frame: str) -> int:
        """How often the body of a loop runs."""
        if frame not in self.turns:
            condition = self.predicates.get(frame)
            if condition is None:
                raise unsupported_error([n for n in self.graph.nodes if self.frames.get(n.name) == frame][:1])
            variables = self._variables(frame)
            for turn in range(MAX_TURNS + 1):
                for variable in variables:  # turn by turn: no chain of calls is longer than a body
                    self.tensor(variable, turn)
                predicate = self._number(condition, condition.inputs[0], turn)
                if predicate is None:
                    raise _undecided_loop(condition, "a loop's condition")
                if not bool(predicate):
                    self.turns[frame] = turn
                    break
            else:
                raise _undecided_loop(condition, f"more than {MAX_TURNS} turns of a loop, or a number of them")
        return self.turns[frame]

    def _variables(self, frame: str) -> list[str]:
        """The Merges of a loop that take a value from turn to turn."""
        merges = [n for n in self.graph.nodes if n.op == "Merge" and self.frames.get(n.name) == frame]
        return [n.name for n in merges if any(self.graph.producer(r).op == "NextIteration" for r in n.inputs)]

    # ---- tensor arrays

    def _array(self, node: Node, index: int, turn: int | None) -> _Flow:
        return _Flow(self._number(node, node.inputs[0], turn))

    def _flow(self, reference: str, turn: int | None) -> _Flow:
        flow = self.tensor(reference, turn)
        if not isinstance(flow, _Flow):
            raise unsupported_error([self.graph.producer(reference)])
        return flow

    def _number(self, node: Node, reference: str, turn: int | None) -> int | None:
        """A condition, a size; None where it is not known. Raises GraphError where it is not a whole number."""
        value = self.editor.constant(self.plain(reference, turn))
        if value is None:
            return None
        if value.size != 1 or value.dtype.kind not in "biu":
            raise _malformed_loop(node, f"{reference!r} is {value.dtype} {list(value.shape)}, no single whole number")
        return int(value.item())

    def _indices(self, node: Node, reference: str, turn: int | None) -> list[int]:
        value = self.editor.constant(self.plain(reference, turn))
        if value is None:
            raise _undecided_loop(node, "the indices of a tensor array")
        self._room(value.size)  # each becomes nodes
        if value.ndim > 1 or value.dtype.kind not in "iu":
            raise _malformed_loop(node, f"{reference!r} is {value.dtype} {list(value.shape)}, no row of indices")
        return [int(i) for i in np.atleast_1d(value)]

    def _index(self, node: Node, turn: int | None) -> int:
        found = self._indices(node, node.inputs[1], turn)
        if len(found) != 1:
            raise _malformed_loop(node, f"its index is {len(found)} numbers")
        return found[0]

    def _scatter(self, node: Node, index: int, turn: int | None) -> _Flow:
        _, indices, value, flow_in = node.inputs
        flow, source = self._flow(flow_in, turn), self.plain(value, turn)
        for position, i in enumerate(self._indices(node, indices, turn)):
            flow = self._with(flow, i, self._element(source, position, f"{node.name}/{i}"))
        return flow

    def _element(self, source: str, position: int, name: str) -> str:
        bounds = [
            self._const(np.array([v], np.int32), f"{name}/{k}")
            for k, v in (("begin", position), ("end", position + 1), ("strides", 1))
        ]
        return self._add("StridedSlice", [source, *bounds], name, shrink_axis_mask=1)

    def _read(self, node: Node, index: int, turn: int | None) -> str:
        return self._item(node, self._flow(node.inputs[2], turn), self._index(node, turn))

    def _write(self, node: Node, index: int, turn: int | None) -> _Flow:
        position = self._index(node, turn)
        flow = self._flow(node.inputs[3], turn)
        value = self.plain(node.inputs[2], turn)
        return self._with(flow, position, value)

    def _gather(self, node: Node, index: int, turn: int | None) -> str:
        flow = self._flow(node.inputs[2], turn)
        parts = [self._item(node, flow, i) for i in self._indices(node, node.inputs[1], turn)]
        return self._add("Pack", parts, f"{node.name}/pack", axis=0)

    def _size(self, node: Node, index: int, turn: int | None) -> str:
        flow = self._flow(node.inputs[1], turn)
        if flow.size is None:
            raise _undecided_loop(node, "the size of a tensor array")
        return self._const(np.array(flow.size, INT32), f"{node.name}/size")

    def _with(self, flow: _Flow, index: int, value: str) -> _Flow:
        """The array with one more element. Raises NotAPolicyError."""
        self.handed_on += len(flow.items) + 1
        if self.handed_on > MAX_HANDED_ON:
            raise NotAPolicyError(
                f"the graph's tensor arrays hand on more than {MAX_HANDED_ON} elements",
                why="each writing hands on what was written before; a policy's arrays have a row for each turn",
                fix="give the policy alone",
            )
        return replace(flow, items={**flow.items, index: value})

    def _item(self, node: Node, flow: _Flow, index: int) -> str:
        """An element of an array, which was written, or is a row of what the array was made of."""
        item = flow.items.get(index)
        if item is None and flow.source and index >= 0:
            key = (f"{flow.source}[{index}]", None)
            if key not in self.memo:
                self.memo[key] = self._element(flow.source, index, f"{node.name}/{index}")
            item = self.memo[key]  # type: ignore[assignment]
        if item is None:
            raise _malformed_loop(node, f"element {index} of its tensor array was never written")
        return item

    # ---- tensor lists, the arrays of TensorFlow 2: values, where a tensor array is a resource with a flow

    def _list_reserve(self, node: Node, index: int, turn: int | None) -> _Flow:
        return _Flow(self._number(node, node.inputs[1], turn))

    def _list_fromtensor(self, node: Node, index: int, turn: int | None) -> _Flow:
        known = self.types.get(node.inputs[0])
        length = known.shape[0] if known is not None and known.shape else None
        return _Flow(length if isinstance(length, int) else None, source=self.plain(node.inputs[0], turn))

    def _list_getitem(self, node: Node, index: int, turn: int | None) -> str:
        return self._item(node, self._flow(node.inputs[0], turn), self._index(node, turn))

    def _list_setitem(self, node: Node, index: int, turn: int | None) -> _Flow:
        flow = self._flow(node.inputs[0], turn)
        return self._with(flow, self._index(node, turn), self.plain(node.inputs[2], turn))

    def _list_stack(self, node: Node, index: int, turn: int | None) -> str:
        flow = self._flow(node.inputs[0], turn)
        if flow.source and not flow.items:
            return flow.source
        size = len(flow.items) if flow.size is None else flow.size
        if size > MAX_TURNS:
            raise _undecided_loop(node, f"the number of elements, or one above {MAX_TURNS},")
        return self._add("Pack", [self._item(node, flow, i) for i in range(size)], f"{node.name}/pack", axis=0)

    def _list_length(self, node: Node, index: int, turn: int | None) -> str:
        size = self._flow(node.inputs[0], turn).size
        if size is None:
            raise _undecided_loop(node, "the length of a tensor list")
        return self._const(np.array(size, INT32), f"{node.name}/length")

    # ---- new nodes

    def _room(self, count: int) -> None:
        """Raise NotAPolicyError where so many more nodes would be too many."""
        if len(self.editor.nodes) + count > MAX_POLICY_NODES:
            raise NotAPolicyError(
                f"the graph's loops unroll to more than {MAX_POLICY_NODES} nodes",
                why="no more are converted; a policy has some hundreds",
                fix="give the policy alone; where a placeholder decides the number of turns, set it: --set NAME=VALUE",
            )

    def _add(self, op: str, inputs: list[str], name: str, **attrs: Any) -> str:
        self._room(1)
        return self.editor.add(op, inputs, name, **attrs)

    def _const(self, array: np.ndarray, name: str) -> str:
        self._room(1)
        return self.editor.const(array, name)


def _alive(value: str | _Flow | None) -> str | _Flow:
    if value is None:
        raise _DeadError
    return value


def _frames(graph: Graph) -> dict[str, str]:
    """Node name → the frame (loop) it runs in; nodes outside of loops are left out."""
    frames: dict[str, str] = {}
    for node in graph.nodes:
        inside = [frames[n] for n in (split_ref(r)[0] for r in node.inputs) if n in frames]
        if CONTROL_FLOW.get(node.op) == "enter":
            if inside:
                raise UnsupportedOpError(
                    f"cannot convert Enter (node {node.name!r}): a loop inside a loop",
                    issues=[(node.name, node.op)],
                    why="nested loops do not occur in policies and are not unrolled",
                    fix="please open an issue with the graph",
                )
            frames[node.name] = str(node.attrs.get("frame_name", ""))
        elif inside and CONTROL_FLOW.get(node.op) != "exit":
            frames[node.name] = inside[0]
    return frames


def _malformed_loop(node: Node, why: str) -> GraphError:
    return GraphError(
        f"node {node.name!r} ({node.op}) does not belong to a loop or branch as TensorFlow writes them",
        why=why,
        fix="the graph is damaged; freeze it again from its checkpoint",
    )


def _undecided_loop(node: Node, meaning: str) -> UnsupportedOpError:
    return UnsupportedOpError(
        f"cannot convert {node.op} (node {node.name!r}): {meaning} is not known before the graph runs",
        issues=[(node.name, node.op)],
        why="it depends on an input of the graph",
        fix="if a placeholder decides it (sequence_length, is_training), give it a value: --set NAME=VALUE",
    )
