"""``inspect --unity --svg``: *Behavior Parameters* as the Inspector shows them for a file, with Unity's own messages.

Drawn here from the verdict, in the order of Unity's fields; it is no photograph of the Editor, which was not run.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

from export_model.converters.consumers.unity.checker import UnityVerdict
from export_model.converters.consumers.unity.findings import Thrown
from export_model.converters.consumers.unity.players import PlayOutcome
from export_model.exporter.markup import Markup, el, svg_file

_WIDTH, _LINE, _MARGIN, _VALUE = 560, 22, 16, 250
_LETTERS = 78
_STYLE = Path(__file__).with_name("behavior_parameters.css")

#: (indentation, label, value; None for a heading)
Row = tuple[int, str, str | None]


def behavior_parameters(verdict: UnityVerdict) -> str:
    """The picture as an SVG file of its own, light or dark as the reader's system is."""
    parts = []
    y = _MARGIN + _LINE
    for indent, label, value in _rows(verdict):
        kind = "head" if value is None and indent == 0 else "soft" if value is None else "label"
        parts.append(el("text", label, class_=kind, x=_MARGIN + 16 * indent, y=y))
        if value is not None:
            box = {"x": _VALUE, "y": y - 15, "width": _WIDTH - _VALUE - _MARGIN, "height": 19, "rx": 3}
            parts += [el("rect", class_="field", **box), el("text", value, x=_VALUE + 8, y=y)]
        y += _LINE
    for message, fine in _messages(verdict):
        lines = [line for part in message.strip().split("\n") for line in textwrap.wrap(part, _LETTERS)]
        height = 18 * len(lines) + 12
        box = {"x": _MARGIN, "y": y - 14, "width": _WIDTH - 2 * _MARGIN, "height": height, "rx": 3}
        parts.append(el("rect", class_="fine" if fine else "message", **box))
        parts += [el("text", line, x=_MARGIN + 10, y=y + 5 + 18 * i) for i, line in enumerate(lines)]
        y += height + 8
    title = f"Behavior Parameters for {verdict.path.name}, {verdict.consumer.title}"
    return svg_file(
        el("title", title),
        el("style", Markup(f"\n{_STYLE.read_text(encoding='utf-8')}")),
        el("rect", class_="paper", x=1, y=1, width=_WIDTH - 2, height=y - 2, rx=6),
        *parts,
        width=_WIDTH,
        height=y,
    )


def _rows(verdict: UnityVerdict) -> list[Row]:
    brain = verdict.brain
    vector = next((s.shape[0] for s in reversed(brain.sensors) if len(s.shape) == 1), 0)
    modes = [mode for mode, said in verdict.accepted.items() if said]
    rows: list[Row] = [
        (0, f"Behavior Parameters (Script)        {verdict.consumer.package}", None),
        (0, "Behavior Name", verdict.path.stem),
        (0, "Vector Observation", None),
        (1, "Space Size", str(brain.vector_observation_size or vector)),
        (1, "Stacked Vectors", str(brain.stacked)),
        (0, "Actions", None),
        (1, "Continuous Actions", str(brain.continuous)),
        (1, "Discrete Branches", str(len(brain.branches))),
        *((2, f"Branch {i} Size", str(size)) for i, size in enumerate(brain.branches)),
        (0, "Model", verdict.path.name),
        (1, "Deterministic Inference", "off or on" if len(modes) == 2 else "on" if "deterministic" in modes else "off"),
        (0, "Behavior Type", "Inference Only"),
    ]
    others = [(i, s) for i, s in enumerate(brain.sensors) if len(s.shape) > 1]
    if others:
        rows.append((0, "Sensor components, in the order of their names", None))
        rows += [(1, f"{i} {s.name}", "×".join(map(str, s.shape))) for i, s in others]
    return rows


def _messages(verdict: UnityVerdict) -> list[tuple[str, bool]]:
    """(text, whether it is good news), each once."""
    if verdict.refused is not None:
        return [(_exception_text("Importing it", verdict.refused), False)]
    found: list[tuple[str, bool]] = []
    chosen = next((m for m in verdict.modes.values() if m.accepted), next(iter(verdict.modes.values()), None))
    if chosen is not None:
        found += [(f.message, False) for f in chosen.checks]
        found += [(_exception_text("In the console", chosen.load), False)] if chosen.load is not None else []
    found += [(f"In play: {f.message}", False) for f in verdict.played if f.outcome is not PlayOutcome.LOADING]
    return list(dict.fromkeys(found)) or [("No message: the model is accepted.", True)]


def _exception_text(where: str, thrown: Thrown) -> str:
    return f"{where}: {thrown.exception}: {thrown.message}"
