"""Collect garbage less often: an export creates almost no reference cycles."""

from __future__ import annotations

import atexit
import gc

#: New objects between two collections (Python's default is 700): a policy makes some ten thousand, imports as many.
_OBJECTS = 20_000


def raise_gc_threshold() -> None:
    """Collect less often in a whole process of ours, which took a tenth of its time, and not at its end."""
    gc.set_threshold(_OBJECTS, 20, 20)
    atexit.unregister(gc.freeze)
    atexit.register(gc.freeze)  # Python's end looks through all that is left, twice: 10 ms of a cold export
