"""Memories: inputs and outputs that belong together by their names; the parts of one, cell states and hidden ones."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from export_model.converters.graph.nodes import Graph, Node, node_of, ref
from export_model.converters.graph.ops.table import op_of
from export_model.converters.graph.shapes import elements_of, infer_types, run_kernel
from export_model.converters.graph.size_limits import Allowance
from export_model.converters.graph.types import FLOAT32, TensorType, static_shape
from export_model.signatures.errors import GraphError
from export_model.signatures.memories import SeparateMemory

Shape = tuple[int | None, ...]
#: Numbers of a memory whose parts are told apart, and those of all that is made of it on the way.
_MOST_COLUMNS, _MOST_FOLLOWED = 1 << 16, 1 << 21


def paired_memories(
    inputs: Iterable[str], outputs: Iterable[str], types: Callable[[], Mapping[str, TensorType]]
) -> tuple[SeparateMemory, ...]:
    """Inputs that are fed what an output gave, in the order of ``inputs``: they agree in name and shape.

    ``h_in`` and ``h_out``, ``hx`` and ``new_hx``, ``h0`` and ``hn``, ``state_in_0`` and ``state_out_0``: names that are
    the same once the words for the step's two ends are left out, one of them the word of a memory. What is not plain is
    no pair: the output that is left over then asks. ``types`` gives what is known of all of them.
    """
    ends: dict[tuple[str, ...], list[str]] = {}
    for name in outputs:
        if looks_like_state(name):
            ends.setdefault(stem_of(name), []).append(name)
    pairs = [(name, ends[stem]) for name in inputs if (stem := stem_of(name)) in ends]
    if not pairs:
        return ()
    kinds = types()
    found = []
    for name, candidates in pairs:
        taken = float_rows(kinds.get(name))
        fitting = [(o, given) for o in candidates if (given := float_rows(kinds.get(o))) is not None]
        fitting = [(o, given) for o, given in fitting if taken is not None and _numbers(taken) == _numbers(given)]
        if taken is not None and len(fitting) == 1:
            output, given = fitting[0]
            found.append(SeparateMemory(name, output, taken, given, part_of(stem_of(name))))
    outputs_taken = [m.output for m in found]
    return tuple(m for m in found if outputs_taken.count(m.output) == 1)


def float_rows(kind: TensorType | None) -> Shape | None:
    """The shape of a float32 tensor with one free axis, the batch."""
    shape = None if kind is None or kind.dtype != FLOAT32 else static_shape(kind.shape)
    return shape if shape is not None and shape.count(None) == 1 else None


def _numbers(shape: Shape) -> list[int]:
    return [d for d in shape if d is not None]


def memory_layout(graph: Graph, name: str) -> tuple[str, ...]:
    """The parts of the memory in order: ``("c", "h")`` for one LSTM, twice that for two; empty where it is unknown.

    A part that is joined to the cell's input is a hidden state h; one that is only multiplied by a gate is a cell
    state c. Parts are followed through slices of slices and repetitions by their columns.
    """
    types = infer_types(graph)
    shape = types[name].shape
    if not shape or not isinstance(shape[-1], int) or shape[-1] > _MOST_COLUMNS:
        return ()
    # tensor → the columns of the memory that it shows, as one row of it
    shown = {name: np.arange(shape[-1]).reshape((1,) * (len(shape) - 1) + (shape[-1],))}
    parts: dict[tuple[int, ...], str] = {}
    allowance = Allowance(_MOST_FOLLOWED)
    for node in graph.nodes:
        read = [shown[r] for r in node.inputs if r in shown]
        operands = [shown.get(r, types[r].constant) for r in node.inputs]
        known = [o for o in operands if o is not None]
        joined = op_of(node).moves == "join"
        if read and not allowance.take(sum(r.size for r in read) + elements_of(types[node.name])):
            return ()
        if read and op_of(node).moves and len(known) == len(operands):
            for index, columns in enumerate(_move_row(node, known)):
                shown[ref(node.name, index)] = columns
        elif joined or node.op == "Mul":
            for columns in read:
                part = tuple(columns.reshape(-1).tolist())
                parts[part] = "h" if joined else parts.get(part, "c")
    ordered = sorted(parts)
    whole = [column for part in ordered for column in part] == list(range(shape[-1]))
    return tuple(parts[part] for part in ordered) if whole else ()


def _move_row(node: Node, row: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """The results of a node that moves elements, of one row; nothing where it takes several apart."""
    try:
        return run_kernel(op_of(node), node, row)
    except GraphError:
        return ()


#: Words of a tensor's name that say that it is a memory.
_STATE_WORDS = frozenset(
    (
        *("h", "c", "hx", "cx", "hn", "cn", "hidden", "hiddens", "cell", "cells", "state", "states", "carry"),
        *("memory", "memories", "recurrent", "rnn", "lstm", "gru"),
    )
)
#: Words that say no more than which end of the step it is.
_ENDS = frozenset(
    (
        *("in", "out", "ins", "outs", "input", "output", "inputs", "outputs"),
        *("next", "new", "prev", "previous", "last", "old", "initial", "init"),
    )
)
_CELL_WORDS, _HIDDEN_WORDS = frozenset(("c", "cx", "cell", "cells")), frozenset(("h", "hx", "hidden", "hiddens"))


def looks_like_state(name: str) -> bool:
    """Whether an output's name says that it is fed back at the next step."""
    return bool(_STATE_WORDS & {w.rstrip("0123456789") for w in _words(name)})


def _words(name: str) -> list[str]:
    """The words of a name: ``"stateOut_0"`` is state, out, 0.

    ``"h0"`` and ``"hn"`` are h (PyTorch's names for a step's two ends), but ``"h1_in"`` is h1, in: the first of
    several.
    """
    base = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", node_of(name).rsplit("/", 1)[-1])
    words = [w for w in re.split(r"[^a-z0-9]+", base.lower()) if w]
    if _ENDS & {*words}:
        return words
    return [w[0] if w in ("h0", "c0", "hn", "cn", "h1", "c1", "ht", "ct") else w for w in words]


def stem_of(name: str) -> tuple[str, ...]:
    """What is left of a name without the words for a step's two ends: the same for both tensors of a memory."""
    return tuple(w for w in _words(name) if w not in _ENDS)


def part_of(stem: Sequence[str]) -> str:
    """``c`` or ``h``, where the words say which; else empty."""
    return "c" if _CELL_WORDS & {*stem} else "h" if _HIDDEN_WORDS & {*stem} else ""
