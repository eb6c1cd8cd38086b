"""Which ONNX op is translated by which function: (domain, op) → function. To add an op is to add a line in its file."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.formats.onnx.importer import (
    arrays,
    choosing,
    control_flow,
    convolution,
    elementwise,
    linear,
    normalisation,
    recurrent,
    resizing,
    samplers,
    slicing,
)
from export_model.converters.formats.onnx.importer.node import Translate

_MODULES = (
    *(arrays, choosing, control_flow, convolution, elementwise, linear),
    *(normalisation, recurrent, resizing, samplers, slicing),
)


def _table() -> Mapping[tuple[str, str], Translate]:
    table: dict[tuple[str, str], Translate] = {}
    for module in _MODULES:
        for kind, function in module.OPS.items():
            if ("", kind) in table:
                raise ValueError(f"{kind} is in the table twice")
            table["", kind] = function
    return table


TABLE = _table()
