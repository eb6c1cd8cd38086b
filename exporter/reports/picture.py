"""A policy's picture as an SVG file of its own: light or dark as the reader's system is, nothing outside of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from export_model.converters.policy.policy import Policy
from export_model.exporter.markup import Markup, el, svg_file
from export_model.exporter.reports.charts import diagram_parts
from export_model.exporter.reports.layers import Block, blocks_of
from export_model.signatures.errors import UsageError
from export_model.signatures.spec import TensorSpec

_MARGIN, _HEAD = 24, 78
#: More would be no picture.
_MOST_NODES, _MOST_BLOCKS = 1500, 120
#: Width of a letter of the title and of the line under it, in pixels, on the wide side.
_TITLE, _LINE = 11.5, 7.2
_STYLE = Path(__file__).with_name("picture.css")


def picture(policy: Policy) -> str:
    """The layers of ``policy`` from its inputs to its outputs, with its name and what it is. Raises UsageError."""
    signature = policy.signature
    specs = {s.name: s for s in (*signature.inputs, *signature.outputs)}
    nodes = sum(node.value is None for node in policy.graph.nodes)
    blocks = blocks_of(policy.graph, [s.name for s in signature.outputs]) if nodes <= _MOST_NODES else []
    if not 0 < len(blocks) <= _MOST_BLOCKS:
        raise UsageError(
            f"--svg: the policy {policy.name!r} is too large for a picture ({nodes} nodes)",
            fix="look at it in TensorBoard: --logdir DIR",
        )
    parts, inner, height, described = diagram_parts(
        [_with_size(b, specs, signature.labels) if b.kind != "layer" else b for b in blocks]
    )
    line = f"{signature.family}, {signature.action_space} actions"
    width = max(inner, _TITLE * len(policy.name), _LINE * len(line)) + 2 * _MARGIN
    height += _HEAD + _MARGIN
    return svg_file(
        el("title", f"{policy.name}: {line}"),
        el("desc", described),
        el("style", Markup(f"\n{_STYLE.read_text(encoding='utf-8')}")),
        el("rect", class_="paper", width=width, height=height),
        el("text", policy.name, class_="name", x=_MARGIN, y=34),
        el("text", line, class_="line", x=_MARGIN, y=55),
        el("g", parts, transform=f"translate({(width - inner) / 2:g} {_HEAD})"),
        width=width,
        height=height,
    )


def _with_size(block: Block, specs: Mapping[str, TensorSpec], labels: Mapping[str, Any]) -> Block:
    """An input or output with its size beside its name, and its role and labels where the pointer rests on it."""
    spec = specs[block.title]
    size = "×".join("any" if n is None else str(n) for n in spec.shape[1:]) or "1"
    detail = f"{spec.name}: {spec.role.value.replace('_', ' ')}, {spec.dtype}, {size} per agent"
    names = labels.get("observations", {}).get(spec.name, [])
    detail += ": " + ", ".join(names) if names else ""
    return replace(block, title=f"{spec.name} · {size}", detail=detail)
