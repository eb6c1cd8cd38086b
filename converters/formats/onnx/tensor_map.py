"""Which value of an ONNX model is which tensor of the graph that it was written from.

A value is called as the tensor is. What differs stands in ``metadata_props`` under ``export_model_tensors``, as JSON:
``values`` maps a tensor to the value's name, to ``[name, axes]`` where the value is the tensor with its axes in another
order (a kernel: OIHW here, HWIO there), or to null where the name is another value's; ``sources`` maps a tensor to the
source's, where that one is called otherwise.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from msgspec import Struct, field

from export_model.converters.formats.intermediate_tensors import View
from export_model.signatures import bounded

TENSORS_KEY = "export_model_tensors"


class TensorMap(Struct, frozen=True):
    """What is called otherwise; see the module."""

    values: Mapping[str, View | None] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)

    def view(self, tensor: str) -> View | None:
        """How the model has ``tensor``, None where it has it not."""
        return self.values.get(tensor, View(tensor))

    def dumps(self) -> str:
        """As JSON; empty where everything is called as it was."""
        values = {t: v if v is None else v.name if v.axes is None else [v.name, v.axes] for t, v in self.values.items()}
        content = {key: entry for key, entry in (("values", values), ("sources", dict(self.sources))) if entry}
        return json.dumps(content, separators=(",", ":"), ensure_ascii=True) if content else ""


def loads(text: str) -> TensorMap:
    """The inverse. What is not understood is left out: a map is a help for reports, nothing depends on it."""
    try:
        content = bounded.loads(text)
    except (ValueError, RecursionError):
        return TensorMap()
    values, sources = (content.get(k) if isinstance(content, dict) else None for k in ("values", "sources"))
    return TensorMap(
        {tensor: _view(entry) for tensor, entry in values.items()} if isinstance(values, dict) else {},
        {t: s for t, s in sources.items() if isinstance(s, str)} if isinstance(sources, dict) else {},
    )


def _view(entry: Any) -> View | None:
    if isinstance(entry, str):
        return View(entry)
    if isinstance(entry, list) and len(entry) == 2 and isinstance(entry[0], str) and isinstance(entry[1], list):
        axes = tuple(entry[1])
        if all(isinstance(a, int) for a in axes) and sorted(axes) == list(range(len(axes))):
            return View(entry[0], axes)
    return None
