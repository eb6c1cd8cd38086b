"""``python resident.py MODULE FUNCTION``: a program that is imported once, and run for each line of stdin.

A line has the program's arguments, as a list in JSON; the answer is a line with its status and what it said. Run by the
peers' own Python: imports the standard library only.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import sys


def main() -> None:
    """Until stdin ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # TensorFlow writes past Python
    program = getattr(importlib.import_module(sys.argv[1]), sys.argv[2])
    for line in sys.stdin:
        sys.argv[1:] = json.loads(line)
        said, status = io.StringIO(), 0
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            try:
                status = program() or 0
            except SystemExit as stop:
                status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        print(json.dumps([status, said.getvalue()[-3000:]]), file=answers, flush=True)


if __name__ == "__main__":
    main()
