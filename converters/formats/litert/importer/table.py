"""Which of LiteRT's operators is translated by which function. To add one is to add a line in its file."""

from __future__ import annotations

from collections.abc import Mapping

from export_model.converters.formats.litert.importer import arrays, elementwise, layers
from export_model.converters.formats.litert.importer.operator import Translate

TABLE: Mapping[str, Translate] = {**elementwise.OPS, **arrays.OPS, **layers.OPS}
