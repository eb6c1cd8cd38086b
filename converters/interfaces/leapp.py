"""LEAPP's YAML beside the models of a pipeline: names of elements, the control rate, what is fed back.

Source: leapp 0.7 (leapp.py ``compile_graph``; utils/tensor_description.py): ``models`` by node, each with ``inputs``
and ``outputs``; ``pipeline`` with ``configs``, ``feedback_flow`` and ``initial_values``.
"""

from __future__ import annotations

from pathlib import PurePosixPath

from export_model.converters.interfaces.table import Table, cut_text
from export_model.signatures.interface import Interface, Period, Statement, Term

_TARGETS = "target/"


def read_pipeline(table: Table, model: str) -> Interface:
    """Return what it states of the node whose model is the file ``model``, or of the only node."""
    nodes = table.below("models")
    names = [n for n in nodes if _file_of(nodes.below(n)) == model]
    names = names or ([*nodes] if len([*nodes]) == 1 else [])
    observations: dict[str, tuple[Term, ...]] = {}
    acted: list[Term] = []
    if names:
        node = nodes.below(names[0])
        for row in node.rows("inputs"):
            term = _tensor(row)
            observations[term.name] = (term,)
        outputs = node.rows("outputs")
        targets = [r for r in outputs if str(r.value("kind")).startswith(_TARGETS)] or outputs[:1]
        acted = [_tensor(row) for row in targets]
    pipeline = table.below("pipeline")
    configs = pipeline.below("configs")
    rate = configs.number("frequency")
    resets = [
        Statement(f"{what}: {cut_text(pipeline.value(key))}", pipeline.where(key))
        for key, what in (("initial_values", "begins with"), ("feedback_flow", "fed back"))
        if pipeline.value(key)
    ]
    pipeline.take("initial_values", "feedback_flow", "inputs", "outputs", "data_flow")
    table.take("system information")
    return Interface(
        observations=observations,
        actions=tuple(acted),
        period=Period(1 / rate, configs.where("frequency")) if rate and 1e-9 < rate < 1e9 else None,
        resets=tuple(resets),
        kept=tuple(table.rest()),
    )


def _file_of(node: Table) -> str:
    path = node.below("parameters").value("model_path")
    return PurePosixPath(path.replace("\\", "/")).name if isinstance(path, str) else ""


def _tensor(row: Table) -> Term:
    """A tensor: the names of its last axis, where they are listed."""
    shape = row.numbers("shape")
    size = int(shape[-1]) if len(shape) > 1 and 0 < shape[-1] < 1 << 24 and shape[-1] == int(shape[-1]) else None
    axes = row.value("element_names")
    last = axes[-1] if isinstance(axes, list) and axes and isinstance(axes[-1], list) else axes
    names = Table({"names": last}, "").texts("names")
    if names:
        row.take("element_names")
    row.take("dtype", "type")
    return Term(
        name=row.text("name") or "tensor", source=row.where(), size=size, elements=names if len(names) == size else ()
    )
