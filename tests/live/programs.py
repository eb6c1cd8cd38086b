"""``python -m tests.live.programs FILE …``: one program after the other, in a process whose runtimes start once."""

from __future__ import annotations

import contextlib
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path

from export_model.converters.runtimes import pool as pools


@contextlib.contextmanager
def shared_runtimes() -> Iterator[None]:
    """All exports of this process use the same processes of the runtimes."""
    with pools.RuntimePool() as pool:
        pools.RuntimePool = lambda: contextlib.nullcontext(pool)  # type: ignore[assignment,misc]
        yield


if __name__ == "__main__":
    with shared_runtimes():
        for file in map(Path, sys.argv[1:]):
            runpy.run_path(str(file), run_name="__main__")
