"""A policy's graph as the layers that a person would draw: "dense 64, swish", "LSTM 16", "conv 3×3 → 32, elu".

Nodes are joined to blocks: a matrix product or a convolution starts one, and what follows it (bias, activation, the
cell of an LSTM) belongs to it as long as no circle of blocks arises. It is a picture: nothing is computed from it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence

from msgspec import Struct, field

from export_model.converters.graph.nodes import Graph, Node, node_of
from export_model.converters.graph.ops.table import traits

#: A box that normalises has no more nodes.
_NORMALISER = 6
#: The activations of an LSTM's gates.
_GATES = ("sigmoid", "tanh")


class Block(Struct):
    """Nodes that are drawn as one box. ``kind`` is ``input``, ``layer`` or ``output``."""

    kind: str
    nodes: list[Node] = field(default_factory=list)
    before: set[int] = field(default_factory=set)
    title: str = ""
    detail: str = ""


def blocks_of(graph: Graph, outputs: Iterable[str]) -> list[Block]:
    """Blocks in topological order; ``before`` holds the places of those that a block reads from."""
    wanted = [o for o in outputs if o in graph]
    needed = graph.ancestors(wanted)
    blocks: list[Block] = []
    home: dict[str, int] = {}
    reach: list[set[int]] = []  # every block that comes before, directly or not
    for node in graph.nodes:
        if node.name not in needed or node.value is not None:
            continue
        sources = {home[n] for n in map(node_of, node.inputs) if n in home}
        place = _home(node, sources, blocks, reach)
        if place is None:
            place = len(blocks)
            blocks.append(Block("input" if node.op == "Placeholder" else "layer", before=set(sources)))
            reach.append(set().union(*(reach[s] | {s} for s in sources)) if sources else set())
        else:
            new = sources - {place}
            blocks[place].before |= new
            added = set().union(*(reach[s] | {s} for s in new)) if new else set()
            for i, r in enumerate(reach):
                if i == place or place in r:
                    r |= added
        blocks[place].nodes.append(node)
        home[node.name] = place
    for block in blocks:
        block.title, block.detail = _describe(block, graph)
    blocks += [Block("output", [], {home[name]}, name) for name in wanted if name in home]
    while _join_pair(blocks, graph):
        pass
    return _topological_order(blocks)


def chain(blocks: Sequence[Block], output: str) -> list[str]:
    """The way with the most layers from an input to ``output``, in a few words each: "normalise", "32 swish", "2"."""
    best: list[tuple[int, int | None]] = []
    for block in blocks:
        before = max(block.before, key=lambda i: best[i][0], default=None)
        best.append(((0 if before is None else best[before][0]) + _starts(block), before))
    place = next((i for i, b in enumerate(blocks) if b.kind == "output" and b.title == output), None)
    words: list[str] = []
    while place is not None:
        block = blocks[place]
        if block.kind == "input":
            words.append(block.title)
        elif _starts(block) or block.title.startswith(("normalise", "draw")):
            title, *rest = block.title.split(", ")
            words.append(" ".join([title.removeprefix("dense "), *(w for w in rest if w != "clip")]))
        place = best[place][1]
    return words[::-1]


def _join_pair(blocks: list[Block], graph: Graph) -> bool:
    """Join one pair of boxes that say little apart; False where there is none left.

    Twins (the same sources, the same ops) and a small box with the only reader it has: neither can make a circle.
    """
    live = [i for i, b in enumerate(blocks) if b.kind == "layer" and b.nodes]
    twins = ((i, j) for i in live for j in live if i < j and _twins(blocks[i], blocks[j]))
    pair = next(twins, None) or next(_followers(blocks, live), None)
    if pair is None:
        return False
    gone, kept = blocks[pair[0]], blocks[pair[1]]
    kept.nodes = [*gone.nodes, *kept.nodes]
    kept.before = (kept.before | gone.before) - set(pair)
    gone.nodes, gone.before = [], set()
    for block in blocks:
        if pair[0] in block.before:
            block.before = (block.before - {pair[0]}) | {pair[1]}
    kept.title, kept.detail = _describe(kept, graph)
    return True


def _followers(blocks: list[Block], live: list[int]) -> Iterator[tuple[int, int]]:
    """Boxes with the only box that reads them, one of the two being small and neither starting with weights."""
    readers: dict[int, list[int]] = {i: [] for i in range(len(blocks))}
    for j, block in enumerate(blocks):
        for i in block.before:
            readers[i].append(j)
    for i in live:
        if len(readers[i]) == 1 and blocks[readers[i][0]].kind == "layer":
            a, b = blocks[i], blocks[readers[i][0]]
            if (_small(a) or _small(b)) and not _starts(a) and not _starts(b):
                yield i, readers[i][0]


def _starts(block: Block) -> bool:
    return any(_has_weights(n) for n in block.nodes)


def _has_weights(node: Node) -> bool:
    return traits(node).layer in ("dense", "convolution")


def _draws(node: Node) -> bool:
    return bool(traits(node).sampler)


def _small(block: Block) -> bool:
    """Whether a box only moves elements, or takes numbers to another scale or dtype."""
    return all(map(_is_small, block.nodes))


def _is_small(node: Node) -> bool:
    entry = traits(node)
    arithmetic = entry.elementwise and not entry.activation and entry.precision != "approximate"
    return bool(entry.moves) or arithmetic or node.op == "OneHot"


def _twins(a: Block, b: Block) -> bool:
    return a.before == b.before and {n.op for n in a.nodes} == {n.op for n in b.nodes} and not _starts(a)


def _topological_order(blocks: list[Block]) -> list[Block]:
    """The boxes that are left, sources before their readers, ``before`` renumbered."""
    places: dict[int, int] = {}
    left = [i for i, b in enumerate(blocks) if b.nodes or b.kind == "output"]
    while len(places) < len(left):
        for i in left:
            if i not in places and blocks[i].before <= set(places):
                places[i] = len(places)
    for i in left:
        blocks[i].before = {places[j] for j in blocks[i].before}
    return [blocks[i] for i in sorted(left, key=places.__getitem__)]


def _home(node: Node, sources: set[int], blocks: list[Block], reach: list[set[int]]) -> int | None:
    """The block that takes ``node`` in: the last of its sources that nothing else it reads comes after."""
    if node.op == "Placeholder" or _has_weights(node) or _draws(node):
        return None
    for place in sorted(sources, reverse=True):
        others = sources - {place}
        if blocks[place].kind == "layer" and not any(place in reach[o] for o in others):
            # A box that only prepares (normalises, joins) does not take in what several layers lead to.
            if len(others) and not _starts(blocks[place]) and _layers(others, blocks):
                continue
            return None if node.op == "ConcatV2" and _layers(others, blocks) else place
    return None


def _layers(places: Iterable[int], blocks: list[Block]) -> bool:
    return any(blocks[p].kind == "layer" for p in places)


def _describe(block: Block, graph: Graph) -> tuple[str, str]:
    ops = Counter(n.op for n in block.nodes)
    if block.kind == "input":
        return block.nodes[0].name, ""
    title = _layer_title(block.nodes[0], graph, ops)
    if title is None and "Sub" in ops and ("RealDiv" in ops or "Mul" in ops) and sum(ops.values()) <= _NORMALISER:
        title = "normalise"
    elif title is None and any(map(_draws, block.nodes)):
        title = "draw"
    words = [] if title is None else [title]
    words += _activations(block.nodes, ops, lstm=title is not None and title.startswith("LSTM"))
    if not words:
        words = [_plain_title(block.nodes)]
    return ", ".join(words), " · ".join(op if n == 1 else f"{op} ×{n}" for op, n in ops.items())


def _layer_title(first: Node, graph: Graph, ops: Mapping[str, int]) -> str | None:
    """What a box that begins with weights is called, with its sizes where they are known; None for others."""
    if not _has_weights(first):
        return None
    weights = graph.constant(first.inputs[1]) if len(first.inputs) > 1 else None
    if weights is not None and first.op == "Conv2D" and weights.ndim == 4:
        strides = first.attrs.get("strides")
        step = f" /{strides[1]}" if isinstance(strides, tuple) and strides[1] != 1 else ""
        return f"conv {weights.shape[0]}×{weights.shape[1]} → {weights.shape[3]}{step}"
    if weights is not None and first.op == "MatMul":
        width = weights.shape[0 if first.attrs.get("transpose_b") else -1]
        return f"LSTM {width // 4}" if ops["Sigmoid"] >= 3 and ops["Tanh"] >= 2 else f"dense {width}"
    return "matrix product" if traits(first).layer == "dense" else "convolution"


def _activations(nodes: Iterable[Node], ops: Mapping[str, int], *, lstm: bool) -> list[str]:
    names = sorted({traits(n).activation for n in nodes} - {""}, key=lambda name: (name == "softmax", name))
    if lstm:
        names = [n for n in names if n not in _GATES]
    words = ["swish" if n == "sigmoid" and ops.get("Mul") else n for n in names]
    if ops.get("MaxPool"):
        words.append("max pool")
    if ops.get("Minimum") and ops.get("Maximum"):
        words.append("clip")
    if ops.get("Sum") and ops.get("Log") and ops.get("RealDiv"):
        words.append("log-probabilities")
    if ops.get("ArgMax"):
        words.append("argmax")
    return words


def _plain_title(nodes: Sequence[Node]) -> str:
    """Of a box that says little: what it does with elements, else its first op."""
    if all(traits(n).moves == "pick" for n in nodes):
        return "slice"
    words = list(dict.fromkeys(word for n in nodes if (word := _plain_word(n))))
    return ", ".join(words) if words and all(map(_is_small, nodes)) else nodes[0].op


def _plain_word(node: Node) -> str:
    if node.op == "OneHot":
        return "one-hot"
    return "scale" if node.op == "Mul" else {"view": "reshape", "join": "join"}.get(traits(node).moves, "")
