"""Faults of exporters that a file itself shows: a row each, reproduced with the versions that it names."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from msgspec import Struct

from export_model.converters.formats.onnx.functions import all_nodes
from export_model.signatures.errors import UsageError


class ExporterFault(Struct, frozen=True):
    """One fault: ``name`` is what ``--repair`` takes, ``op`` the operator that shows it.

    ``ran`` are the versions that it was reproduced with, ``evidence`` where it is reported; ``shows`` says whether a
    node of that operator has it, ``mend`` takes it out.
    """

    name: str
    producer: str
    op: str
    says: str
    ran: str
    evidence: str
    shows: Callable[[Any], bool]
    mend: Callable[[Any], None]


def _resets_before(node: Any) -> bool:
    return not any(a.name == "linear_before_reset" and a.i for a in node.attribute)


def _reset_after(node: Any) -> None:
    kept = [a for a in node.attribute if a.name != "linear_before_reset"]
    del node.attribute[:]
    node.attribute.extend(kept)
    node.attribute.add(name="linear_before_reset", i=1, type=2)


#: How the note on a fault that was not mended begins.
FAULT_NOTE = "fault of the exporter"
FAULTS = (
    ExporterFault(
        name="gru-reset",
        producer="pytorch",
        op="GRU",
        says="PyTorch's GRU resets after the product with its state, and the file says before: other actions",
        ran="torch 2.14.1 with onnxscript 0.6.2: actions off by 0.12; right by its own GRU",
        evidence="pytorch#189225, onnxscript#2852; right from onnxscript 0.7.2 on",
        shows=_resets_before,
        mend=_reset_after,
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
            for node in nodes:
                fault.mend(node)
            notes.append(f"repaired, {fault.name}: {fault.says} ({fault.evidence})")
        elif nodes:
            where = nodes[0].name or nodes[0].output[0]
            notes.append(f"{FAULT_NOTE} at {where}: {fault.says} ({fault.evidence}); --repair {fault.name} mends it")
    return tuple(notes)
