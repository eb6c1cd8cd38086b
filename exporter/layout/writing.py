"""``--write FILE``: a layout in the form of Isaac Lab's IO descriptors, which the readers of interfaces know."""

from __future__ import annotations

import json
from pathlib import Path

from export_model.converters.formats.bundle.bundle import writing
from export_model.converters.layouts.conventions import BY_TERM
from export_model.converters.layouts.layouts import Layout, term_size
from export_model.converters.layouts.stated import frame_name
from export_model.converters.layouts.terms import PER_JOINT, TERMS
from export_model.exporter.layout.telling import Told, closed_facts, decided_facts, open_facts
from export_model.exporter.layout.wording import verdict_text
from export_model.signatures.errors import UsageError


def write_layout(told: Told, path: Path) -> None:
    """Write what is decided. Raises UsageError where nothing is, and what cannot be written."""
    layout = told.layout
    if layout is None:
        raise UsageError(
            f"nothing is written to {path}: the layout of {told.policy!r} is not decided",
            why=told.ranking.why_open or (told.stated.says if told.stated else None),
            fix="name the robot, --robot, or state the layout, --check FILE",
        )
    with writing(path):
        path.write_text(_text(told, layout), encoding="utf-8")


def _text(told: Told, layout: Layout) -> str:
    """YAML whose values are JSON; comments say what was seen, and what no mirror tells."""
    named = told.stated is not None or len(told.ranking.classes[0].says("order")) == 1
    elements = {"joint_names": list(layout.joints)} if named else {}
    lines = [f"# export-model layout {told.policy}: {verdict_text(told)}"]
    lines += [f"# decided, {what}: {said}" for what, said in decided_facts(told).items()]
    lines += [f"# by its evidence, {fact['term']}: {fact['says']}" for fact in closed_facts(told)]
    for fact in open_facts(told):
        lines.append("# " + "; ".join(["open, " + fact["what"], ", ".join(fact["members"]), *fact["evidence"]]))
    lines += ["observations:", "  policy:"]
    joints = len(layout.joints)
    apart = layout.frames > 1 and layout.stacked != BY_TERM
    for frame in range(1, layout.frames + 1) if apart else (0,):
        for name in layout.terms:
            row = {
                "name": frame_name(name, frame, layout.frames) if frame else name,
                "shape": [term_size(name, joints)],
                **(elements if TERMS[name].signs == PER_JOINT else {}),
                **({} if apart else {"overloads": {"history_length": layout.frames}}),
            }
            lines.append(f"  - {json.dumps(row)}")
    lines += ["actions:", f"- {json.dumps({'name': 'action', 'shape': [joints], **elements})}"]
    return "\n".join(line.replace("\r", " ") for line in lines) + "\n"
