"""Which ONNX op is raised by which function: (domain, op) → function. To add an op is to add a line in its file."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from converters.onnx.importer import arrays, cutting, elementwise, flow, images, linear, normalisation, recurrent
from converters.onnx.importer import samplers as chance
from converters.onnx.importer.node import Raise


def _table() -> Mapping[tuple[str, str], Raise]:
    table: dict[tuple[str, str], Raise] = {}
    for module in (elementwise, linear, arrays, cutting, images, normalisation, recurrent, chance, flow):
        for kind, function in module.OPS.items():
            if ("", kind) in table:
                raise ValueError(f"{kind} stands twice in the table")
            table["", kind] = function
    return MappingProxyType(table)


TABLE = _table()
