"""A size budget as a gate: ``--max-size tfjs=60kB``. A format that is larger is a finding that failed."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from export_model.signatures.errors import UsageError

if TYPE_CHECKING:
    from export_model.exporter.verify.findings import Finding

#: All formats of the bundle together.
TOTAL = "total"
_UNITS = {"": 1, "b": 1, "kb": 1000, "mb": 1000**2, "gb": 1000**3, "kib": 1 << 10, "mib": 1 << 20, "gib": 1 << 30}
_SIZE = re.compile(r"(\d+(?:\.\d+)?)\s*([a-z]*)")


def parse_budget(values: Sequence[str]) -> dict[str, int]:
    """``["tfjs=60kB", "1MB"]`` as bytes by format; a size alone is that of the whole bundle. Raises UsageError."""
    budget: dict[str, int] = {}
    for value in values:
        name, equals, size = value.rpartition("=")
        found = _SIZE.fullmatch(size.strip().lower())
        unit = None if found is None else _UNITS.get(found[2])
        if found is None or unit is None or (equals and not name):
            raise UsageError(
                f"--max-size {value}: FORMAT=SIZE or SIZE is expected", fix="for example tfjs=60kB, or 1.5MB for all"
            )
        budget[name.strip() or TOTAL] = int(float(found[1]) * unit)
    return budget


def check_budget(budget: Mapping[str, int], sizes: Mapping[str, int]) -> None:
    """Raise UsageError where a format in ``budget`` is none of those that were written."""
    for name in budget:
        if name not in (*sizes, TOTAL):
            known = ", ".join((*sizes, TOTAL))
            raise UsageError(f"--max-size {name}=…: unknown format here", fix=f"there are {known}")


def sizes(budget: Mapping[str, int], written: Mapping[str, int]) -> Iterator[Finding]:
    """What each budget says of the bytes that were written."""
    from export_model.exporter.tables import size_text  # a budget is parsed where nothing is verified, too
    from export_model.exporter.verify.findings import Size
    from export_model.exporter.verify.tolerances import Tolerance

    found = {**written, TOTAL: sum(written.values())}
    for name, most in budget.items():
        over = found[name] - most
        reason = "" if over <= 0 else f"{size_text(found[name])}, and the budget is {size_text(most)}"
        excess = float(max(over, 0))
        relative = excess / most if most else math.inf if excess else 0.0
        yield Size(
            format=name,
            runtime="file",
            output="size",
            max_abs_diff=excess,
            max_rel_diff=relative,
            tolerance=Tolerance(0.0, 0.0),
            passed=over <= 0,
            worst_input=None,
            reason=reason,
        )
