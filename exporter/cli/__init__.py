"""The command line, and how it speaks."""

from __future__ import annotations

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from types import TracebackType


def _uncaught(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """An interrupt while the program is still imported is one line, too; Python then ends by the signal."""
    if issubclass(kind, KeyboardInterrupt):
        sys.stderr.write("\nstopped\n")
    else:
        _before(kind, error, trace)


_before, sys.excepthook = sys.excepthook, _uncaught
