"""A process that a child starts, such as a compiler: its memory and its time are bounded. POSIX only."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path


def bound(memory: int, seconds: int) -> None:
    """Bound this process for good: bytes of memory, seconds of processor time."""
    import resource

    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))


def run_bounded(command: Sequence[str], folder: Path, memory: int, seconds: int) -> subprocess.CompletedProcess[str]:
    """Run a command whose every process has so many bytes of memory and seconds of processor time at most."""
    # one thread, so nothing can hold a lock across the fork
    return subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=folder, preexec_fn=lambda: bound(memory, seconds)
    )
