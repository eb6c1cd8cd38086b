"""A process that a child starts, such as a compiler: memory, time and system calls are bounded. POSIX only."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from export_model.converters.files.children import confinement


def bounds(folder: Path, memory: int, seconds: int, *, starts: bool) -> Callable[[], None]:
    """What a forked process does before it becomes a program: it bounds itself, for good, and ends with this one.

    Bytes of memory, seconds of processor time, system calls, and what it reads and, but in ``folder``, writes;
    ``starts``: it may start processes.
    """
    parent = os.getpid()

    def bound() -> None:
        import resource

        confinement.end_with(parent)
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        confinement.confine_started(str(folder), starts=starts)

    return bound


def run_bounded(command: Sequence[str], folder: Path, memory: int, seconds: int) -> subprocess.CompletedProcess[str]:
    """Run a compiler whose every process has so many bytes of memory and seconds of processor time at most."""
    # one thread, so nothing can hold a lock across the fork
    bound = bounds(folder, memory, seconds, starts=True)
    return subprocess.run(
        command, capture_output=True, encoding="utf-8", errors="replace", check=False, cwd=folder, preexec_fn=bound
    )
