"""Python looks for cycles of objects that nothing else holds; this program's own processes make hardly any."""

from __future__ import annotations

import gc

#: New objects after which it looks (700 is Python's own): a policy makes some ten thousand, and imports as many.
_OBJECTS = 20_000


def look_seldom() -> None:
    """For a whole process of ours: to look took a tenth of its time."""
    gc.set_threshold(_OBJECTS, 20, 20)
