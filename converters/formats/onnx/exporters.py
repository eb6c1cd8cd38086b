"""Faults of exporters that a file itself shows: a row each, reproduced with the versions that it names.

318 modules were exported by torch 2.14.1, with onnxscript 0.6.2 and without dynamo, and run in onnxruntime 1.32; with
onnxscript 0.7.2 14 of them were. Exports by tf2onnx, skl2onnx and Keras, and to older opsets, were not tried.

- Reproduced, and the file does not show it: without dynamo, ``avg_pool2d`` with a divisor, a Softplus with a threshold
  below 20, ``//`` (rounds to 0), ``index_add`` and ``index_put(accumulate=True)`` of an index given twice,
  ``repeat_interleave`` by a tensor; at far inputs, ``logcumsumexp`` (−∞), attention whose mask forbids all.
- No runtime loads it: an LSTM with projections.
- Not reproduced: bidirectional LSTM, Softplus by dynamo, Resize without antialias, int64 masks. External data left
  behind is refused where it is missing; a normaliser left out shows nowhere.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from msgspec import Struct

from export_model.converters.formats.onnx.functions import all_nodes
from export_model.signatures.errors import UsageError

#: Value → its shape, as far as the file says it.
Shapes = Mapping[str, tuple[int, ...]]


class ExporterFault(Struct, frozen=True):
    """One fault: ``name`` is what ``--repair`` takes, ``op`` the operator that shows it.

    ``ran`` are the versions that it was reproduced with, ``evidence`` where it is reported; ``shows`` says whether a
    node of that operator has it. ``mend`` takes it out, given the nodes by their outputs, and returns the nodes that
    are to stand behind it.
    """

    name: str
    producer: str
    op: str
    says: str
    ran: str
    evidence: str
    shows: Callable[[Any, Shapes], bool]
    mend: Callable[[Mapping[str, Any], Any, Shapes], Sequence[Any]]


def _call_of(node: Any) -> str:
    """What of the module the exporter notes that it made a node of; empty where it notes nothing."""
    return next((p.value for p in node.metadata_props if p.key == "pkg.torch.onnx.fx_node"), "")


def _integer(node: Any, name: str, default: int = 0) -> int:
    return next((int(a.i) for a in node.attribute if a.name == name), default)


def _set(node: Any, name: str, **value: Any) -> None:
    kept = [a for a in node.attribute if a.name != name]
    del node.attribute[:]
    node.attribute.extend(kept)
    node.attribute.add(name=name, **value)


def _move(node: Any, op: str, *operands: str) -> Any:
    """A node of ``op`` that makes the output of ``node`` of what that gave so far, which gets a name of its own."""
    made = type(node)(op_type=op, name=f"{node.output[0]}/repaired", output=[node.output[0]])
    node.output[0] = f"{node.output[0]}/as_exported"
    made.input.extend([node.output[0], *operands])
    return made


def _constant(node: Any, **value: Any) -> Any:
    """A node with numbers for the repair of ``node``."""
    made = type(node)(op_type="Constant", output=[f"{node.output[0]}/repair"])
    made.attribute.add(**value)
    return made


def _resets_before(node: Any, shapes: Shapes) -> bool:
    return not any(a.name == "linear_before_reset" and a.i for a in node.attribute)


def _reset_after(nodes: Mapping[str, Any], node: Any, shapes: Shapes) -> Sequence[Any]:
    _set(node, "linear_before_reset", i=1, type=_INT)
    return ()


def _is_log_sigmoid(node: Any, shapes: Shapes) -> bool:
    """Whether PyTorch's exporter notes that it made a Log of LogSigmoid, and not of what a module computes."""
    return "aten.log_sigmoid.default" in _call_of(node)


def _subtract_softplus(nodes: Mapping[str, Any], node: Any, shapes: Shapes) -> Sequence[Any]:
    """Make log(sigmoid(x)) x − softplus(x), which is no −∞."""
    sigmoid = nodes[node.input[0]]
    sigmoid.op_type, node.op_type = "Softplus", "Sub"
    node.input[:] = [sigmoid.input[0], sigmoid.output[0]]
    return ()


def _divisor(node: Any) -> int:
    """The divisor that a pool was called with; 0: the size of its window."""
    call = re.search(r"aten\.avg_pool[23]d\.default\]\(args = \((.*?)\), kwargs", _call_of(node))
    arguments = re.sub(r"\[[^\]]*\]", "", call[1]).split(", ") if call else []
    return int(arguments[_DIVISOR]) if len(arguments) > _DIVISOR and arguments[_DIVISOR].isdecimal() else 0


def _loses_divisor(node: Any, shapes: Shapes) -> bool:
    return _divisor(node) not in (0, _window(node))


def _window(node: Any) -> int:
    return math.prod(n for a in node.attribute if a.name == "kernel_shape" for n in a.ints)


def _divide(nodes: Mapping[str, Any], node: Any, shapes: Shapes) -> Sequence[Any]:
    """Make of means over the window the sums over it, padding included, by the divisor."""
    if _integer(node, "ceil_mode"):
        raise UsageError(
            f"--repair pool-divisor: {node.name} rounds its size up", why="ONNX has no sums of such windows"
        )
    _set(node, "count_include_pad", i=1, type=_INT)
    factor = _constant(node, name="value_float", f=_window(node) / _divisor(node), type=_FLOAT)
    return factor, _move(node, "Mul", factor.output[0])


def _mixes_channels(node: Any, shapes: Shapes) -> bool:
    """Whether a block's place stands before several channels, where PyTorch has it behind."""
    return "aten.pixel_unshuffle.default" in _call_of(node) and shapes.get(node.input[0], (0, 0))[1] > 1


def _order_channels(nodes: Mapping[str, Any], node: Any, shapes: Shapes) -> Sequence[Any]:
    channels, places = shapes[node.input[0]][1], _integer(node, "blocksize", 1) ** 2
    order = [place * channels + channel for channel in range(channels) for place in range(places)]
    table = _constant(node, name="value_ints", ints=order, type=_INTS)
    gather = _move(node, "Gather", table.output[0])
    gather.attribute.add(name="axis", i=1, type=_INT)
    return table, gather


def _counts_beyond_edges(node: Any, shapes: Shapes) -> bool:
    """Whether a filter with antialias takes the edge again for what lies beyond, and reaches there."""
    before, after = (shapes.get(name, ()) for name in (node.input[0], node.output[0]))
    cubic = any(a.name == "mode" and a.s == b"cubic" for a in node.attribute)
    shrinks = len(before) == len(after) and any(b > a for b, a in zip(before, after, strict=True) if a)
    made_here = re.search(r"aten\._upsample_\w+2d_aa\b", _call_of(node)) is not None
    return made_here and _integer(node, "exclude_outside") == 0 and (cubic or shrinks)


def _leave_edges_out(nodes: Mapping[str, Any], node: Any, shapes: Shapes) -> Sequence[Any]:
    _set(node, "exclude_outside", i=1, type=_INT)
    _set(node, "cubic_coeff_a", f=-0.5, type=_FLOAT)
    return ()


#: Types of attributes (AttributeProto), and the place of a pool's divisor among its arguments.
_FLOAT, _INT, _INTS = 1, 2, 7
_DIVISOR = 6
#: How the note on a fault that was not mended begins.
FAULT_NOTE = "fault of the exporter"
FAULTS = (
    ExporterFault(
        name="gru-reset",
        producer="pytorch",
        op="GRU",
        says="PyTorch's GRU resets after the product with its state, and the file says before: other actions",
        ran="torch 2.14.1 and 2.13.0 with onnxscript 0.6.2: actions off by 0.12; right with 0.7.2 and by its own GRU",
        evidence="pytorch#189225, onnxscript#2852; right from onnxscript 0.7.2 on",
        shows=_resets_before,
        mend=_reset_after,
    ),
    ExporterFault(
        name="log-sigmoid",
        producer="pytorch",
        op="Log",
        says="PyTorch's LogSigmoid is written as the logarithm of a sigmoid, which is −∞ where the sigmoid is 0",
        ran="torch 2.13.0 with onnxscript 0.7.2: −∞ in place of −200; right by LogSigmoid itself",
        evidence="reproduced with torch 2.13.0, onnxscript 0.6.2 and 0.7.2",
        shows=_is_log_sigmoid,
        mend=_subtract_softplus,
    ),
    ExporterFault(
        name="pool-divisor",
        producer="pytorch",
        op="AveragePool",
        says="PyTorch's avg_pool2d divides by divisor_override, and the file by the size of the window",
        ran="torch 2.14.1 with onnxscript 0.6.2 and 0.7.2: all numbers by 4/3 too small with a divisor of 3",
        evidence="reproduced with torch 2.14.1, onnxscript 0.6.2 and 0.7.2",
        shows=_loses_divisor,
        mend=_divide,
    ),
    ExporterFault(
        name="pixel-unshuffle",
        producer="pytorch",
        op="SpaceToDepth",
        says="PyTorch's pixel_unshuffle has each channel's pixels side by side, and the file all channels of a pixel",
        ran="torch 2.14.1 with onnxscript 0.6.2: channels exchanged; right with 0.7.2, and by one channel",
        evidence="reproduced with torch 2.14.1 and onnxscript 0.6.2; right with 0.7.2",
        shows=_mixes_channels,
        mend=_order_channels,
    ),
    ExporterFault(
        name="antialias",
        producer="pytorch",
        op="Resize",
        says="PyTorch's interpolate(antialias=True) leaves out what is beyond the edges, the file repeats the edge",
        ran="torch 2.14.1 with onnxscript 0.6.2: off by 0.25, cubic by another curve, too; right with 0.7.2",
        evidence="reproduced with torch 2.14.1 and onnxscript 0.6.2; right with 0.7.2",
        shows=_counts_beyond_edges,
        mend=_leave_edges_out,
    ),
)


def faulty_nodes(model: Any) -> Iterator[tuple[ExporterFault, Any]]:
    """Yield each fault of the table that a ModelProto shows, with the node that shows it."""
    shapes = _shapes(model.graph) if any(model.producer_name == f.producer for f in FAULTS) else {}
    for fault in FAULTS:
        if model.producer_name == fault.producer:
            nodes = (n for n in all_nodes(model.graph) if n.op_type == fault.op)
            yield from ((fault, n) for n in nodes if fault.shows(n, shapes))


def _shapes(graph: Any) -> Shapes:
    """The shapes that a graph states; an axis of any length is 0."""
    values = ((v.name, v.type.tensor_type.shape.dim) for v in (*graph.input, *graph.value_info, *graph.output))
    return {name: tuple(int(d.dim_value) for d in dims) for name, dims in values}


def repair_model(model: Any, name: str | None) -> tuple[str, ...]:
    """Mend the fault called ``name`` in place; return a note for each fault that the model has, or had.

    Raises UsageError where ``name`` is unknown, or a fault that the model does not show.
    """
    found: dict[str, list[Any]] = {}
    for fault, node in faulty_nodes(model):
        found.setdefault(fault.name, []).append(node)
    if name is not None and name not in found:
        shown = f"it shows {', '.join(found)}" if found else "it shows none of the faults that are known"
        raise UsageError(f"--repair {name}: the file does not have this fault", why=shown, fix="leave --repair out")
    notes = []
    for fault in FAULTS:
        nodes = found.get(fault.name, [])
        if nodes and fault.name == name:
            by_output = {output: node for node in all_nodes(model.graph) for output in node.output}
            shapes = _shapes(model.graph)
            for node in nodes:
                ends = node.output[0]
                behind = fault.mend(by_output, node, shapes)
                _insert(model.graph, node, behind, ends)
            notes.append(f"repaired, {fault.name}: {fault.says} ({fault.evidence})")
        elif nodes:
            where = nodes[0].name or nodes[0].output[0]
            notes.append(f"{FAULT_NOTE} at {where}: {fault.says} ({fault.evidence}); --repair {fault.name} mends it")
    return tuple(notes)


def _insert(graph: Any, node: Any, behind: Sequence[Any], name: str) -> None:
    """Put nodes behind one of a graph. Raises UsageError where it is inside a branch or a loop."""
    if not behind:
        return
    place = next((i for i, n in enumerate(graph.node) if n.output[:1] == node.output[:1]), None)
    if place is None:
        raise UsageError(f"--repair: {name} is inside a branch or a loop", fix="export the model again")
    for each in reversed(behind):
        graph.node.insert(place + 1, each)
