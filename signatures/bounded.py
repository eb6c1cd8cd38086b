"""JSON that anyone may have written: its values are counted before any is made."""

from __future__ import annotations

import json
from typing import Any

#: Objects, lists, and what stands in them: an empty list has three bytes, and takes sixty-four in memory; a name and a
#: number have six, and take a hundred.
MAX_VALUES = 1 << 22


def loads(text: str | bytes, **how: Any) -> Any:
    """As ``json.loads``. Raises ValueError, too where there are more than MAX_VALUES values; RecursionError."""
    signs = (b"[", b"{", b",") if isinstance(text, bytes) else ("[", "{", ",")
    if len(text) > MAX_VALUES and sum(map(text.count, signs)) > MAX_VALUES:  # type: ignore[arg-type]
        raise ValueError(f"it has more than {MAX_VALUES} values")
    return json.loads(text, **how)
