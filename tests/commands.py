"""The command line, run in this process or in one of its own."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from export_model.exporter.cli.main import main

ROOT = Path(__file__).resolve().parent.parent
#: The package's own folder: its three modules, and links to the others' folders.
PACKAGE = ROOT / ".ci/src/export_model"
#: What Python finds the package by, as an install in place does; and these tests.
PLACES = (PACKAGE.parent, ROOT)
PYTHONPATH = os.pathsep.join(map(str, PLACES))


@dataclass(frozen=True)
class Ran:
    """How a command ended, and what it said where."""

    status: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """stdout, which must be one JSON document."""
        return json.loads(self.out)


def export_model(*arguments: object) -> Ran:
    """``export-model ARGUMENTS``, in this process."""
    out, err = io.StringIO(), io.StringIO()
    status: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(a) for a in arguments])
        except SystemExit as stop:
            status = stop.code
    return Ran(status if isinstance(status, int) else 0 if status is None else 1, out.getvalue(), err.getvalue())


def default_signals() -> None:
    """For a child, before it begins: as a terminal starts one. A job in the background, and what nohup starts, has
    signals ignored, and children inherit that.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def python(*arguments: object, environment: Mapping[str, str] | None = None, cwd: Path = ROOT) -> Ran:
    """``python ARGUMENTS`` in a process of its own, in the checkout unless another folder is given."""
    done = subprocess.run(
        [sys.executable, *(str(a) for a in arguments)],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": PYTHONPATH, **(environment or {})},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        check=False,
        preexec_fn=default_signals if os.name == "posix" else None,
    )
    return Ran(done.returncode, done.stdout, done.stderr)


def files_in(folder: Path) -> set[str]:
    """All files and folders, hidden ones too, by their path inside ``folder``; empty where it does not exist."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*")} if folder.exists() else set()


def is_refused(ran: Ran, *words: object, status: int = 2) -> str:
    """Assert one clear message on stderr and nothing on stdout; returns the message."""
    assert ran.status == status, ran
    assert ran.out == ""
    assert ran.err.startswith("error: "), ran.err
    assert ran.err.count("error: ") == 1
    assert "Traceback" not in ran.err
    for word in words:
        assert str(word) in ran.err, (word, ran.err)
    return ran.err
