"""An operator as the translating functions see it: operands as tensors of the new graph, and its options."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import Struct

from export_model.signatures.errors import UnsupportedOpError

if TYPE_CHECKING:
    from export_model.converters.formats.litert.importer.importer import LiteRTImporter


class LiteRTOp(Struct, frozen=True):
    """One operator. ``inputs`` are references into the new graph, None for an operand that is left out.

    ``name`` is its first result's, ``options`` the fields that the file says, ``dtypes`` those of its results.
    """

    kind: str
    name: str
    inputs: tuple[str | None, ...]
    options: Mapping[str, Any]
    dtypes: tuple[np.dtype, ...]

    def get(self, position: int) -> str | None:
        """An optional operand."""
        return self.inputs[position] if position < len(self.inputs) else None

    def need(self, position: int) -> str:
        """A required operand. Raises UnsupportedOpError."""
        found = self.get(position)
        if found is None:
            raise self.refusal(f"operand {position} is missing", "the operator cannot be computed without it")
        return found

    def operands(self) -> list[str]:
        """All operands. Raises UnsupportedOpError where one is left out."""
        return [self.need(i) for i in range(len(self.inputs))]

    def integer(self, option: str, default: int = 0) -> int:
        """An option that is a number or a flag; a file leaves out what is as by default."""
        return int(self.options.get(option, default))

    def flag(self, option: str) -> bool:
        """An option that is true or false."""
        return bool(self.options.get(option, False))

    def number(self, option: str) -> float:
        """An option that is a float."""
        return float(self.options.get(option, 0.0))

    def integers(self, option: str) -> list[int]:
        """An option that is a vector of integers."""
        return [int(n) for n in self.options.get(option, ())]

    def refusal(self, what: str, why: str | None = None, fix: str | None = None) -> UnsupportedOpError:
        """The error that this operator is not converted."""
        return UnsupportedOpError(
            f"cannot convert {self.kind} (tensor {self.name!r}): {what}",
            issues=[(self.name, self.kind)],
            why=why,
            fix=fix or "give the graph it was converted from; if the policy needs it, please open an issue",
        )


#: Makes the operator's results in the new graph: the reference of the only one, or one per result.
Translate = Callable[[LiteRTOp, "LiteRTImporter"], "str | Sequence[str]"]
