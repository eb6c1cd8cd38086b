"""Which layout Barracuda 1.4 and later takes each value of an ONNX file for, and so the layout that inputs are kept in.

A file of TensorFlow's is channels last but for its convolutions, which stand between Transposes. To find out, the
importer floods the graph from the convolutions, which are channels first, along all edges, up and down; a Transpose
between the layouts, or a Reshape or Squeeze that comes to one, turns the order around. Where any value comes out
channels last, the inputs that do are kept as they are declared, of any rank: a list of entities, too
(../shared/unity/r4, ``cam_buffer``: [N, E, F] is laid out as [N, 1, E, F], without a camera as [N, 1, F, E]). Read in
Barracuda 3.0.0 (LayoutTransposesRemovalHelper of its compiler's passes); that of 2.0.0 differs by Flatten.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from enum import Enum
from typing import Any

from export_model.converters.consumers.unity.onnx_file import OnnxFile, attributes

_TO_LAST, _TO_FIRST = (0, 2, 3, 1), (0, 3, 1, 2)
#: Operators that take channels first alone.
_NATIVE = frozenset({"Conv", "ConvTranspose", "DepthToSpace", "SpaceToDepth"})
#: Operators whose constants stay layers, which the flood passes where several nodes read one.
_COMPARISONS = ("Less", "LessOrEqual", "Greater", "GreaterOrEqual", "Equal", "And", "Or", "Xor")
_READ_CONSTANTS = frozenset((*_COMPARISONS, "Min", "Max", "Pow", "Where", "MatMul", "Concat", "Gather", "PRelu"))


class Order(Enum):
    """What a value is taken for; of a node between the layouts, which way it goes. NATIVE goes before all others."""

    LAST = "channels last"
    FIRST = "channels first"
    TO_LAST = "to channels last"
    TO_FIRST = "to channels first"
    NATIVE = "channels first, by a convolution"


_FIRSTS = (Order.FIRST, Order.NATIVE)


def keeps_last(file: OnnxFile) -> frozenset[str] | None:
    """Return the inputs that are kept as they are declared; None where the whole file is taken for channels first."""
    orders = channel_orders(file)
    if Order.LAST not in orders.values():
        return None
    return frozenset(i.name for i in file.inputs if orders.get(i.name) is Order.LAST)


def channel_orders(file: OnnxFile) -> Mapping[str, Order]:
    """Return the order of each value that hangs together with a convolution."""
    nodes = {n: node for n, node in file.producers.items() if not file.is_constant(n)}
    edges = {n: [g for g in node.input if g and _is_edge(file, node, g)] for n, node in nodes.items()}
    readers: dict[str, list[str]] = {}
    for name, given in edges.items():
        for source in dict.fromkeys(given):
            readers.setdefault(source, []).append(name)
    declared = {i.name for i in file.inputs}
    orders: dict[str, Order] = {}
    waiting = deque((n, Order.NATIVE, False) for n, node in nodes.items() if node.op_type in _NATIVE)
    steps = _MOST_STEPS * len(nodes)
    while waiting and (steps := steps - 1):
        name, order, downstream = waiting.popleft()
        known = orders.get(name)
        if known in (order, Order.NATIVE) or (known is Order.LAST and order is not Order.NATIVE):
            continue
        order = _order_at(file, nodes.get(name), order, downstream=downstream)
        if order in (Order.TO_LAST, Order.TO_FIRST) and order is known:
            continue
        orders[name] = order
        waiting.extend((source, _BEHIND.get(order, order), False) for source in edges.get(name, ()))
        # nothing flows down from an input, which is no layer
        below = () if name in declared else readers.get(name, ())
        waiting.extend((reader, _AHEAD.get(order, order), True) for reader in below)
    return orders


#: Of a node between the layouts, the order of what it reads and of what it makes.
_BEHIND = {Order.TO_LAST: Order.FIRST, Order.TO_FIRST: Order.LAST}
_AHEAD = {Order.TO_LAST: Order.LAST, Order.TO_FIRST: Order.FIRST}
#: Visits of a node, on the average, after which the flood is given up.
_MOST_STEPS = 1 << 7


def _order_at(file: OnnxFile, node: Any, order: Order, *, downstream: bool) -> Order:
    """What a node is taken for that is reached with an order, from above or from below."""
    if node is None:
        return order
    if _moves(file, node, _TO_LAST) and ((order in _FIRSTS) if downstream else (order is Order.LAST)):
        return Order.TO_LAST
    if _moves(file, node, _TO_FIRST) and ((order is Order.LAST) if downstream else (order in _FIRSTS)):
        return Order.TO_FIRST
    return order


def _moves(file: OnnxFile, node: Any, order: tuple[int, ...]) -> bool:
    """Whether a node changes the layout that way: a Transpose, or what gives the same shape, whatever it is for."""
    before = file.shapes.get(node.input[0]) if node.input else None
    if node.op_type == "Transpose":
        perm = attributes(node).get("perm")
        return perm is not None and tuple(perm.ints) == order
    if before is None or None in before:
        return False
    if node.op_type == "Squeeze":
        return order == _TO_LAST and len(before) == 4 and len(file.shapes.get(node.output[0], before)) <= 2
    target = file.value(node.input[1]) if node.op_type == "Reshape" and len(node.input) > 1 else None
    if target is None or target.size != 4 or not 1 <= len(before) <= 4:
        return False
    lengths = (*before, 1, 1, 1)
    batch, *rest = (int(n) for n in target.ravel())
    return batch in (-1, 0, lengths[0]) and tuple(rest) == tuple(lengths[axis] for axis in order[1:])


def _is_edge(file: OnnxFile, node: Any, name: str) -> bool:
    """Whether the flood goes from a node to what it reads; a constant is a layer for few operators alone."""
    return not file.is_constant(name) or node.op_type in _READ_CONSTANTS
