"""Which op of a TorchScript program is translated by which function. To add an op is to add a line in its file.

Names and operands: aten/src/ATen/native/native_functions.yaml, torch/csrc/jit/runtime/register_prim_ops.cpp.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from export_model.converters.formats.torchscript.ops import (
    choosing,
    elementwise,
    images,
    layers,
    recurrent,
    reduction,
    scalars,
    shaping,
)

#: The machine, then the operands.
Translate = Callable[..., Any]


def _table() -> Mapping[str, Translate]:
    table: dict[str, Translate] = {}
    for module in (elementwise, layers, images, choosing, recurrent, reduction, scalars, shaping):
        for name, function in module.OPS.items():
            dotted = name if "." in name or name in scalars.BARE else f"torch.{name}"
            if dotted in table:
                raise ValueError(f"{dotted} is in the table twice")
            table[dotted] = function
    return table


OPS = _table()
