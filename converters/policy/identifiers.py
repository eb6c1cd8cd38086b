"""Which integers a policy takes: ids that it looks up in a table, as far as the graph tells, column by column."""

from __future__ import annotations

import numpy as np

from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.ops.table import traits
from export_model.converters.graph.run import run_graph
from export_model.converters.graph.shapes import Types, numbers_made
from export_model.converters.graph.size_limits import MAX_COMPUTED
from export_model.signatures.errors import GraphError

#: What a free axis behind the batch counts as.
_FREE_AXIS = 8
#: Numbers of a row that are told apart.
_MOST_COLUMNS = 1 << 14


def id_distribution(graph: Graph, types: Types, node: Node, *, from_end: bool = False) -> dict[str, object] | None:
    """Return what ``distribution`` says of an input that holds ids; None where it holds none, or none that are known.

    An id is what picks a row of a table, sets a number of a one-hot, or is compared with 0, 1, 2 …; it may be cast,
    sliced, shifted and scaled on the way, and counted from the end where it is negative, as the graph itself is asked.
    ``from_end``: the remainder by a table's length that is looked up is the reader's (``SourceFacts``). Integers that
    nothing looks up may be any. ``clipped``: the graph itself takes higher ids as the highest, and lower ones not.
    """
    shape = node.dims
    if shape is None:
        return None
    sizes = [1 if i == 0 and n is None else _FREE_AXIS if n is None else n for i, n in enumerate(shape)]
    count = int(np.prod(sizes, dtype=np.int64))
    if not 0 < count <= _MOST_COLUMNS:
        return None
    whole = node.attrs["dtype"].kind in "iu"
    lookups, unknown = _lookups(graph, types, node)
    if from_end:
        lookups = [(_before_remainder(graph, reference, looked), looked) for reference, looked in lookups]
    if unknown and whole:
        return None
    low, high = np.full(count, -np.inf), np.full(count, np.inf)
    clipped = False
    for reference, (first, last) in lookups:
        made = _seen_at(graph, node, reference, sizes, [np.zeros(count), np.ones(count), np.arange(count)])
        if made is None:
            return None
        zero, one, labels = made
        scale = one - zero
        own = scale != 0  # the others are of another input
        column = np.rint(np.divide(labels - zero, scale, out=np.full(zero.shape, -1.0), where=own)).astype(np.int64)
        if not own.any() or (column[own] < 0).any() or (column[own] >= count).any():
            return None
        edges = np.sort([(first - zero[own]) / scale[own], (last - zero[own]) / scale[own]], axis=0)
        np.maximum.at(low, column[own], np.ceil(edges[0]))
        np.minimum.at(high, column[own], np.floor(edges[1]))
        known = np.isfinite(high)
        ends = [np.where(known, bound, 0.0) for bound in (low, high, high + 1, low - 1)]
        seen = _seen_at(graph, node, reference, sizes, ends)
        linear = [(zero + scale * end[column])[own] for end in ends]
        clips = _clips([made[own] for made in seen or ()], linear)
        if clips is None:
            return None
        clipped |= clips
    if not whole and not np.isfinite(high).any():
        return None
    return _entry(low, high, sizes, clipped=clipped)


def _clips(made: list[np.ndarray], linear: list[np.ndarray]) -> bool | None:
    """Whether ids beyond the highest are taken as that, on this side alone; None where they are taken otherwise.

    ``made`` of the lowest ids, the highest, and one beyond either, ``linear`` what would be made without a remainder or
    a clip.
    """
    if not made:
        return None
    lowest, highest, above, below = (np.array_equal(*pair) for pair in zip(made, linear, strict=True))
    if lowest and highest and above:
        return False
    return True if lowest and highest and below and np.array_equal(made[2], made[1]) else None


def _seen_at(
    graph: Graph, node: Node, reference: str, sizes: list[int], rows: list[np.ndarray]
) -> list[np.ndarray] | None:
    """A tensor's numbers for each of ``rows`` of the input, zeros elsewhere; None where they cannot be had."""
    needed = graph.ancestors([reference])
    feeds = {}
    for each in (n for n in graph.nodes if n.name in needed and n.op == "Placeholder"):
        if each.dims is None:
            return None
        shape = [1 if i == 0 and n is None else _FREE_AXIS if n is None else n for i, n in enumerate(each.dims)]
        feeds[each.name] = np.zeros(shape, each.attrs["dtype"])
    if numbers_made(graph.prune([reference]), _FREE_AXIS) > MAX_COMPUTED:
        return None
    kind = np.dtype(np.int64) if node.attrs["dtype"].kind in "iu" else node.attrs["dtype"]
    try:
        made = [
            run_graph(graph, {**feeds, node.name: way.reshape(sizes).astype(kind)}, [reference])[reference]
            for way in rows
        ]
    except GraphError:
        return None
    return [np.asarray(each, np.float64).reshape(-1) for each in made]


def _entry(low: np.ndarray, high: np.ndarray, sizes: list[int], *, clipped: bool) -> dict[str, object] | None:
    """Bounds as policy.json says them: one pair, or one for each number of the last axis; None where some clip."""
    if (low > high).any() or (clipped and not np.isfinite(high).all()):
        return None
    more = {"clipped": True} if clipped else {}
    rows = [bound.reshape(-1, sizes[-1] if len(sizes) > 1 else 1) for bound in (low, high)]
    if any((row != row[:1]).any() for row in rows):
        return None
    pairs = [[None if not np.isfinite(n) else int(n) for n in row[0]] for row in rows]
    if all(len({*values}) == 1 for values in pairs):
        return {"kind": "integer", "low": pairs[0][0], "high": pairs[1][0], **more}
    return {"kind": "integer", "low": pairs[0], "high": pairs[1], **more}


def _lookups(graph: Graph, types: Types, node: Node) -> tuple[list[tuple[str, tuple[int, int]]], bool]:
    """Return tensors of ids that ``node`` makes, with the lowest and the highest, and whether others are unknown."""
    consumers = graph.consumers()
    found: list[tuple[str, tuple[int, int]]] = []
    unknown, seen, stack = False, {node.name}, [node.name]
    while stack:
        name = stack.pop()
        for reader in consumers[name]:
            for place in (i for i, r in enumerate(reader.inputs) if node_of(r) == name):
                looked = _table(graph, types, reader, place)
                if looked is not None:
                    found.append((reader.inputs[place], looked))
                elif _looks_up(reader, place):
                    unknown = True
                elif _by_number(reader) and reader.name not in seen:
                    seen.add(reader.name)
                    stack.append(reader.name)
    return found, unknown


def _before_remainder(graph: Graph, reference: str, looked: tuple[int, int]) -> str:
    """What a remainder by the length of the table is of; any other tensor itself."""
    maker = graph.producer(reference)
    length = graph.constant(maker.inputs[1]) if traits(maker).remainder else None
    wraps = length is not None and length.size == 1 and looked == (0, int(length.reshape(())) - 1)
    return maker.inputs[0] if wraps else reference


def _looks_up(reader: Node, place: int) -> bool:
    return traits(reader).looks_up == place


def _table(graph: Graph, types: Types, reader: Node, place: int) -> tuple[int, int] | None:
    """The lowest and the highest id that ``reader`` looks up; None where it looks up nothing, or of no known size."""
    entry = traits(reader)
    if entry.looks_up == place:
        size = entry.table_size(reader, [types[r] for r in reader.inputs]) if entry.table_size else None
        return None if size is None else (0, size - 1)
    if entry.compares_equal:
        numbers = graph.constant(reader.inputs[1 - place])
        if numbers is not None and numbers.size > 1 and numbers.dtype.kind in "iuf":
            each = np.unique(numbers)
            if np.isfinite(each).all() and (np.diff(each) == 1).all():
                return int(each[0]), int(each[-1])
    return None


def _by_number(node: Node) -> bool:
    """Whether each number of the result hangs on one number of an operand, or is one."""
    entry = traits(node)
    return entry.elementwise or bool(entry.moves) or entry.condition is not None
