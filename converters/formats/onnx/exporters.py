"""Faults of exporters that a file itself shows: a row each, reproduced with the versions that it names."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from msgspec import Struct

from export_model.converters.formats.onnx.functions import all_nodes
from export_model.signatures.errors import UsageError


class ExporterFault(Struct, frozen=True):
    """One fault: ``name`` is what ``--repair`` takes, ``op`` the operator that shows it.

    ``ran`` are the versions that it was reproduced with, ``evidence`` where it is reported; ``shows`` says whether a
    node of that operator has it, ``mend`` takes it out, given the nodes by their outputs.
    """

    name: str
    producer: str
    op: str
    says: str
    ran: str
    evidence: str
    shows: Callable[[Any], bool]
    mend: Callable[[Mapping[str, Any], Any], None]


def _resets_before(node: Any) -> bool:
    return not any(a.name == "linear_before_reset" and a.i for a in node.attribute)


def _reset_after(nodes: Mapping[str, Any], node: Any) -> None:
    kept = [a for a in node.attribute if a.name != "linear_before_reset"]
    del node.attribute[:]
    node.attribute.extend(kept)
    node.attribute.add(name="linear_before_reset", i=1, type=2)


def _is_log_sigmoid(node: Any) -> bool:
    """Whether PyTorch's exporter notes that it made a Log of LogSigmoid, and not of what a module computes."""
    return any("aten.log_sigmoid.default" in p.value for p in node.metadata_props if p.key == "pkg.torch.onnx.fx_node")


def _subtract_softplus(nodes: Mapping[str, Any], node: Any) -> None:
    """Make log(sigmoid(x)) x − softplus(x), which is no −∞."""
    sigmoid = nodes[node.input[0]]
    sigmoid.op_type, node.op_type = "Softplus", "Sub"
    node.input[:] = [sigmoid.input[0], sigmoid.output[0]]


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
)


def faulty_nodes(model: Any) -> Iterator[tuple[ExporterFault, Any]]:
    """Yield each fault of the table that a ModelProto shows, with the node that shows it."""
    for fault in FAULTS:
        if model.producer_name == fault.producer:
            yield from ((fault, n) for n in all_nodes(model.graph) if n.op_type == fault.op and fault.shows(n))


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
            for node in nodes:
                fault.mend(by_output, node)
            notes.append(f"repaired, {fault.name}: {fault.says} ({fault.evidence})")
        elif nodes:
            where = nodes[0].name or nodes[0].output[0]
            notes.append(f"{FAULT_NOTE} at {where}: {fault.says} ({fault.evidence}); --repair {fault.name} mends it")
    return tuple(notes)
